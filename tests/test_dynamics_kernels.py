"""Each kernel of the mask against the same in plain NumPy and OpenCV."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

import plain_motion
from mastd3r.camera.pinhole import Camera
from mastd3r.dynamics import comparison_kernels, motion
from mastd3r.dynamics.config import DynamicsConfig, PhotometricConfig
from mastd3r.dynamics.fusion import accumulated, carried_along, kept_share
from mastd3r.dynamics.regions import region_mean
from mastd3r.geometry.se3 import se3_exp

H, W = 48, 64
CAMERA = Camera(60.0, 58.0, 31.0, 24.5, W, H, k1=-0.05, k2=0.01)
RAYS = np.moveaxis(CAMERA.rays(CAMERA.pixel_grid()), -1, 0).astype(np.float32)
GRID = np.stack(np.meshgrid(np.arange(W), np.arange(H)), -1).astype(np.float32)
RNG = np.random.default_rng(7)
NEAR = RNG.uniform(0.1, 1.0, (H, W)).astype(np.float32)
MOVED = se3_exp(np.array([0.4, -0.05, 0.3, 0.1, -0.05, 0.02]))  # part of the image leaves the other
PARTS = ("target", "slope", "xy", "inv_depth")


def smooth(*shape: int, size: float = 1.0, blur: float = 4.0) -> np.ndarray:
    noise = cv2.GaussianBlur(RNG.standard_normal(shape).astype(np.float32), (0, 0), blur)
    return np.asarray(size * noise / noise.std(), np.float32)


def image() -> np.ndarray:
    return np.clip(128 + smooth(H, W, size=50, blur=2), 0, 255).astype(np.uint8)


def bilinear(value: np.ndarray, flow: np.ndarray, outside: float) -> np.ndarray:
    """``value`` at grid + flow in float64; ``outside`` beyond the outermost pixels."""
    u, v = (GRID + flow)[..., 0].astype(float), (GRID + flow)[..., 1].astype(float)
    a, b = np.clip(u.astype(int), 0, W - 2), np.clip(v.astype(int), 0, H - 2)
    p, q, f = u - a, v - b, value.astype(float)
    mean = (f[b, a] * (1 - p) + f[b, a + 1] * p) * (1 - q) + (f[b + 1, a] * (1 - p) + f[b + 1, a + 1] * p) * q
    return np.where((u >= 0) & (v >= 0) & (u <= W - 1) & (v <= H - 1), mean, outside)


@pytest.mark.parametrize("behind", [False, True])
def test_rigid_flow(behind: bool) -> None:
    pose = MOVED.copy()
    if behind:
        pose[2, 3] = -2.0
    found = motion.rigid_flow(CAMERA, RAYS, pose, NEAR)
    plain = plain_motion.rigid_flow(CAMERA, RAYS, pose, NEAR)
    for name, expected in zip(PARTS, plain, strict=True):
        np.testing.assert_allclose(getattr(found, name), expected, rtol=2e-3, atol=2e-3, err_msg=name)
    u, v = found.target[..., 0], found.target[..., 1]
    inside = (u > 0) & (v > 0) & (u < W - 1) & (v < H - 1) & (found.inv_depth >= 0)
    np.testing.assert_array_equal(found.inside, inside)
    assert 0 < inside.mean() < 1 or behind


def test_round_trip_confidence() -> None:
    forward, inside = smooth(H, W, 2, size=4), (RNG.uniform(size=(H, W)) > 0.1).astype(np.float32)
    backward = -forward + smooth(H, W, 2, size=1)
    found = comparison_kernels.round_trip_confidence(forward, backward, inside, 1.5)
    plain = plain_motion.confidence(GRID, forward, backward, inside, 1.5)
    assert np.abs(found - plain).max() < 0.06  # OpenCV reads between pixels to 1/32
    assert np.abs(found - plain).mean() < 0.003 and 0.1 < plain.mean() < 0.9


def test_residual_twist() -> None:
    jacobian = motion.pose_jacobian(RNG.uniform(-0.5, 0.5, (300, 2)), RNG.uniform(0.3, 0.8, 300), 200.0)
    residual, weight = RNG.standard_normal((300, 2)), RNG.uniform(size=300)
    given = jacobian, residual, weight, 0.25, np.array([0.01] * 3 + [0.005] * 3)
    np.testing.assert_allclose(motion.residual_twist(*given), plain_motion.residual_twist(*given), rtol=1e-6)


def test_flow_log_ratio_and_noise_inflation() -> None:
    rigid = motion.rigid_flow(CAMERA, RAYS, MOVED, NEAR)
    left, twist = smooth(H, W, 2, size=3), RNG.standard_normal(6).astype(np.float32)
    sigma = RNG.uniform(0, 0.1, (H, W)).astype(np.float32)
    sigma[0, :9], left[5, 5] = 5.0, np.nan
    root = RNG.uniform(0.3, 1.0, (H, W, 2))
    cov = np.stack([root[..., 0] ** 2, 0.3 * root.prod(-1), root[..., 1] ** 2], -1).astype(np.float32)
    residual = left - plain_motion.pose_error(rigid.xy, rigid.inv_depth, twist)
    wide = plain_motion.along_epipolar(cov, rigid.slope, sigma)
    factor = plain_motion.noise_inflation(residual, wide, rigid.inside)
    geometry = left, rigid.xy, rigid.inv_depth, rigid.slope
    every = comparison_kernels.unexplained_every(*geometry[:3], twist, rigid.slope, sigma, cov, 4)
    found_factor = motion.noise_inflation(*every, rigid.inside[2::4, 2::4].ravel())
    assert found_factor == pytest.approx(factor, rel=1e-4) and factor > 1.2
    found = comparison_kernels.flow_log_ratio(geometry, twist, (sigma, cov, found_factor), (16.0, 0.1, 0.03))
    plain = plain_motion.motion_log_ratio(residual, wide * factor, 16.0, 0.1, 0.03)
    np.testing.assert_allclose(found, plain, atol=3e-3)
    assert found[5, 5] == 0 and plain.std() > 0.5


def test_grey_evidence() -> None:
    gray, stable, left = image(), image(), smooth(H, W, 2, size=3)
    inside = (RNG.uniform(size=(H, W)) > 0.2).astype(np.float32)
    confidence, covered = (RNG.uniform(size=(H, W)).astype(np.float32) for _ in range(2))
    gain = comparison_kernels.mean_ratio(gray, stable, inside)
    assert gain == pytest.approx((gray * inside).mean() / (stable * inside).mean(), rel=1e-4)
    squares = np.empty((H, W), np.float32), np.empty((H, W), np.float32)
    comparison_kernels.grey_differences(gray, stable, gain, left, *squares)
    far = np.clip(GRID + left, 0, [W - 1, H - 1]) - GRID
    expected = (gray - gain * stable.astype(float)) ** 2, (gray - gain * bilinear(stable, far, 0)) ** 2
    for one, plain in zip(squares, expected, strict=True):
        np.testing.assert_allclose(one, plain, rtol=1e-3, atol=0.5)
    ratio, variance = smooth(H, W), RNG.uniform(200, 900, (H, W)).astype(np.float32)
    as_static, as_flow = (plain_motion.mismatch(s, variance) for s in squares)
    unexplained = (1 - np.exp(-0.5 * np.maximum(as_static - 2, 0))) * (1 - confidence) * (1 - covered)
    plain = ratio * confidence + inside * (1.5 * unexplained + np.clip(0.3 * (as_static - as_flow), -3, 0))
    grey = cv2.blur(squares[0], (3, 3)), cv2.blur(squares[1], (3, 3)), variance
    comparison_kernels.add_grey_evidence(ratio, (confidence, inside, covered), grey, (0.3, 1.5))
    np.testing.assert_allclose(ratio, plain, atol=1e-4)


def test_confident_share() -> None:
    maps = [RNG.uniform(size=(H, W)).astype(np.float32) for _ in range(4)]
    confidence, inside, static, covered = maps
    scene = inside * static * (1 - covered)
    assert comparison_kernels.confident_share(*maps) == pytest.approx(
        (confidence * scene).sum() / scene.sum(), rel=1e-5
    )


def test_log_odds_are_carried_along_the_flow() -> None:
    log_odds, flow, kept = smooth(H, W), smooth(H, W, 2, size=4), RNG.uniform(size=(H, W)).astype(np.float32)
    plain = 0.85 * bilinear(log_odds, flow, 0)
    np.testing.assert_allclose(carried_along(log_odds, flow, None, 0.85), plain, atol=1e-5)
    np.testing.assert_allclose(carried_along(log_odds, flow, kept, 0.85), plain * kept, atol=1e-5)


def test_kept_share_fades_where_grey_values_belie_the_flow() -> None:
    config = DynamicsConfig(photometric=PhotometricConfig())
    small, other, flow = image(), image(), smooth(H, W, 2, size=2)
    variance = RNG.uniform(50, 400, (H, W)).astype(np.float32)
    square = ((small - bilinear(other, flow, -100.0)) ** 2).astype(np.float32)
    plain = np.exp(-0.5 * np.maximum(plain_motion.mismatch(square, variance) - config.temporal.carry_mismatch, 0))
    found = kept_share(config, small, other, flow, variance)
    np.testing.assert_allclose(found, plain, atol=2e-3)
    assert 0.05 < plain.mean() < 0.95


@pytest.mark.parametrize("known", [False, True])
def test_accumulated_holds_what_moved_and_looks_like_it(known: bool) -> None:
    config = DynamicsConfig()
    carried, fresh = smooth(H, W, size=3), smooth(H, W, size=3)
    like = RNG.uniform(size=(H, W)).astype(np.float32) if known else None
    hold = np.clip(carried / 2, 0, 1) * (0 if like is None else like)
    held = carried * (1 + hold * (1 / config.temporal.memory - 1))
    added = np.maximum(fresh, 0) + (1 - hold) * np.minimum(fresh, 0)
    plain = np.clip(held + config.evidence_gain * added, -config.max_log_odds, config.max_log_odds)
    np.testing.assert_allclose(accumulated(carried, fresh, like, config), plain, atol=1e-5)


def test_region_mean() -> None:
    layers = [(image(), 1.0), (smooth(H, W, size=20), 1.5)]
    guide = np.stack([layer * gain for layer, gain in layers], -1)
    value, weight = smooth(H, W), RNG.uniform(0.05, 1, (H, W)).astype(np.float32)
    for given in (weight, None):
        plain = plain_motion.region_mean(guide, value, np.ones_like(value) if given is None else given, 20.0, 15.0)
        np.testing.assert_allclose(region_mean(layers, value, given, 20.0, 15.0), plain, atol=2e-5)
