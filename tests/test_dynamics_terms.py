"""Every evidence term alone, against synthetic truth."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from mastd3r.camera.pinhole import Camera
from mastd3r.dynamics.comparison_kernels import flow_log_ratio, grey_differences
from mastd3r.dynamics.config import DynamicsConfig
from mastd3r.dynamics.data import DynamicsInput
from mastd3r.dynamics.depth import depth_log_ratio
from mastd3r.dynamics.motion import (
    flow_covariance,
    noise_inflation,
    pose_jacobian,
    residual_twist,
    rigid_flow,
    texture_information,
)
from mastd3r.dynamics.photometric import photo_variance
from mastd3r.dynamics.regions import guided_coefficients, region_mean
from mastd3r.geometry.se3 import se3_exp, transform

CONFIG = DynamicsConfig()
CAMERA = Camera(210.0, 205.0, 128.0, 95.0, 256, 192, k1=-0.05)
MOTION = se3_exp(np.array([0.1, -0.05, 0.08, 0.02, -0.03, 0.01]))


def rays_of(camera: Camera) -> np.ndarray:
    return np.moveaxis(camera.rays(camera.pixel_grid()), -1, 0).astype(np.float32)


def cov_of(xx: float, xy: float, yy: float) -> np.ndarray:
    return np.array([[[xx, xy, yy]]], np.float32)


def motion_log_ratio(
    residual: np.ndarray, cov: np.ndarray, slope: tuple[float, float] = (0.0, 0.0), inv_depth_sigma: float = 0.0
) -> np.ndarray:
    """log p(residual | moving) - log p(residual | static), where pose and twist explain nothing of it."""
    shape = residual.shape[:2]
    slopes = np.broadcast_to(np.array(slope, np.float32), (*shape, 2)).copy()
    geometry = residual, np.zeros((*shape, 2), np.float32), np.zeros(shape, np.float32), slopes
    noise = np.full(shape, inv_depth_sigma, np.float32), cov, 1.0
    shares = CONFIG.motion.spread_px**2, CONFIG.still_share, CONFIG.outlier_share
    return flow_log_ratio(geometry, np.zeros(6, np.float32), noise, shares)


def test_rigid_flow_is_projection_of_the_moved_points() -> None:
    inv_depth = np.random.default_rng(0).uniform(0.1, 1.0, (192, 256)).astype(np.float32)
    rigid = rigid_flow(CAMERA, rays_of(CAMERA), MOTION, inv_depth)
    points = CAMERA.rays(CAMERA.pixel_grid()) / inv_depth[..., None]
    np.testing.assert_allclose(rigid.target, CAMERA.project(transform(MOTION, points)), atol=2e-3)
    np.testing.assert_allclose(rigid.inv_depth, 1 / transform(MOTION, points)[..., 2], rtol=1e-4)


def test_rigid_flow_slope_is_the_derivative_by_inverse_depth() -> None:
    inv_depth = np.full((192, 256), 0.5, np.float32)
    rays, step = rays_of(CAMERA), 1e-2
    up = rigid_flow(CAMERA, rays, MOTION, inv_depth + step).target
    down = rigid_flow(CAMERA, rays, MOTION, inv_depth - step).target
    rigid = rigid_flow(CAMERA, rays, MOTION, inv_depth)
    np.testing.assert_allclose(rigid.slope, (up - down) / (2 * step), atol=0.05)


def test_points_at_infinity_only_feel_the_rotation() -> None:
    rigid = rigid_flow(CAMERA, rays_of(CAMERA), MOTION, np.zeros((192, 256), np.float32))
    turned = MOTION.copy()
    turned[:3, 3] = 0
    there = CAMERA.project(CAMERA.rays(CAMERA.pixel_grid()) @ turned[:3, :3].T)
    np.testing.assert_allclose(rigid.target, there, atol=2e-3)


def test_what_a_depth_can_explain_does_not_count_as_motion() -> None:
    """The same 4 px: along the epipolar line with unknown depth nothing, across it moving."""
    cov, unknown = cov_of(0.1, 0, 0.1), {"slope": (10.0, 0.0), "inv_depth_sigma": 1.0}
    along = motion_log_ratio(np.array([[[4.0, 0.0]]], np.float32), cov, **unknown)[0, 0]
    across = motion_log_ratio(np.array([[[0.0, 4.0]]], np.float32), cov, **unknown)[0, 0]
    assert along < 0.3
    assert across > 2.0


def test_motion_ratio_is_bounded_by_the_shares_and_silent_without_texture() -> None:
    far = motion_log_ratio(np.array([[[300.0, 0.0]]], np.float32), cov_of(0.1, 0, 0.1))[0, 0]
    near = motion_log_ratio(np.zeros((1, 1, 2), np.float32), cov_of(1e-4, 0, 1e-4))[0, 0]
    blank = motion_log_ratio(np.zeros((1, 1, 2), np.float32), cov_of(400.0, 0, 400.0))[0, 0]
    assert far == pytest.approx(-np.log(CONFIG.outlier_share) + np.log(1 - CONFIG.still_share), abs=0.05)
    assert near == pytest.approx(np.log(CONFIG.still_share) - np.log(1 - CONFIG.outlier_share), abs=0.05)
    assert abs(blank) < 0.1


def test_an_edge_fixes_the_flow_across_it_only() -> None:
    """The aperture problem: a vertical edge leaves vertical flow open."""
    gray = np.zeros((41, 41), np.uint8)
    gray[:, 20:] = 120
    cov = flow_covariance(texture_information(gray, 7, 4.0), 0.25, 8.0)
    assert cov[20, 20, 0] < 0.2
    assert cov[20, 20, 2] > 30
    assert cov[20, 3, 0] > 30  # flat


def test_a_wrong_pose_is_taken_out_though_a_third_of_the_pixels_move() -> None:
    rng = np.random.default_rng(1)
    xy = rng.uniform(-0.5, 0.5, (600, 2))
    inv_depth = rng.uniform(0.3, 0.8, 600)
    jacobian = pose_jacobian(xy, inv_depth, 200.0)
    truth = np.array([0.004, -0.002, 0.003, 0.002, -0.003, 0.001])
    residual = jacobian @ truth + 0.1 * rng.standard_normal((600, 2))
    residual[:200] += np.array([6.0, 1.0])
    twist = residual_twist(jacobian, residual, np.ones(600), 0.25, np.array([0.01] * 3 + [0.005] * 3))
    left = np.linalg.norm(jacobian[200:] @ (twist - truth), axis=-1)
    assert left.max() < 0.3


def test_a_pixel_without_weight_has_no_say_whatever_its_derivative() -> None:
    rng = np.random.default_rng(2)
    jacobian, residual, weight = rng.normal(size=(80, 2, 6)), rng.normal(size=(80, 2)), np.ones(80)
    jacobian[0], weight[0] = np.inf, 0
    found = residual_twist(jacobian, residual, weight, 0.5, np.ones(6))
    np.testing.assert_array_equal(found, residual_twist(jacobian[1:], residual[1:], weight[1:], 0.5, np.ones(6)))


def test_pose_jacobian_is_the_derivative_of_the_projection() -> None:
    camera = Camera.centred(200.0, 256, 192)
    point = np.array([0.3, -0.2, 1.6])
    step = 1e-6
    measured = np.stack(
        [(camera.project(transform(se3_exp(d), point)) - camera.project(point)) / step for d in step * np.eye(6)], -1
    )
    np.testing.assert_allclose(pose_jacobian(point[:2] / point[2], np.array(1 / point[2]), 200.0), measured, atol=1e-2)


def test_depth_in_front_of_the_background_moves_and_equal_depth_does_not() -> None:
    background = np.full((1, 4), 0.5, np.float32)
    own = np.array([[0.5, 1.0, 0.25, 0.0]], np.float32)
    frame = DynamicsInput(
        0, 0.0, np.zeros((1, 4), np.uint8), CAMERA, np.eye(4), background, np.full((1, 4), 0.01, np.float32), own
    )
    ratio = depth_log_ratio(frame, CONFIG)[0]
    assert ratio[0] < -1
    assert ratio[1] > 2
    assert ratio[1] > ratio[2] > 0  # behind: less sure than in front
    assert ratio[3] == 0  # no measurement
    wide = DynamicsInput(0, 0.0, frame.gray, CAMERA, np.eye(4), background, np.full((1, 4), np.inf), own)
    assert (depth_log_ratio(wide, CONFIG) == 0).all()


def test_grey_differences_are_as_wide_as_their_variance_says_for_noise_and_wider_for_another_image() -> None:
    rng = np.random.default_rng(2)
    image = cv2.GaussianBlur(rng.uniform(0, 255, (60, 80)).astype(np.float32), (0, 0), 2)
    variance = photo_variance(texture_information(image.astype(np.uint8), 7, CONFIG.motion.texture_noise), CONFIG)
    noisy = image + CONFIG.photometric.noise * rng.standard_normal(image.shape).astype(np.float32)

    def mismatch(other: np.ndarray) -> float:
        square, still = np.empty(image.shape, np.float32), np.zeros((*image.shape, 2), np.float32)
        pair = (np.rint(i).clip(0, 255).astype(np.uint8) for i in (image, other))
        grey_differences(*pair, np.float32(1), still, square, np.empty_like(square))
        return float(np.median(cv2.blur(square, (3, 3)) / variance))

    assert mismatch(noisy) < 1.3
    assert mismatch(image + 40) > 8


def test_pooling_fills_a_region_and_stops_at_its_edge() -> None:
    guide = np.full((50, 60), 40.0, np.float32)
    guide[10:40, 20:45] = 160
    value, weight = np.full(guide.shape, -2.0, np.float32), np.ones(guide.shape, np.float32)
    inside = np.zeros(guide.shape, bool)
    inside[10:40, 20:45] = True
    value[inside], weight[inside] = 0.0, 0.02
    rim = inside & ~cv2.erode(inside.astype(np.uint8), np.ones((7, 7))).astype(bool)
    value[rim], weight[rim] = 4.0, 1.0
    pooled = region_mean([(guide, 1.0)], value, weight, 20.0, 15.0)
    assert pooled[25, 32] > 3  # the middle, which had no evidence of its own
    assert pooled[25, 15] < -1.5
    with_colour = region_mean([(guide, 1.0), (guide.astype(np.uint8), 1.0)], value, weight, 20.0, 15.0)
    assert with_colour[25, 32] > 3


def test_guided_line_recovers_an_affine_image_exactly() -> None:
    rng = np.random.default_rng(3)
    guide = rng.uniform(0, 255, (40, 50)).astype(np.float32)
    a, b = guided_coefficients(guide, 0.02 * guide - 1, 5, 1.0)
    np.testing.assert_allclose(a * guide + b, 0.02 * guide - 1, atol=0.01)


def test_noise_inflation_is_one_where_the_noise_is_as_claimed_and_grows_with_its_square() -> None:
    rng = np.random.default_rng(4)
    cov = np.zeros((96 * 128, 3), np.float32) + np.array([0.3, 0.1, 0.2], np.float32)
    root = np.linalg.cholesky(np.array([[0.3, 0.1], [0.1, 0.2]]))
    residual = rng.normal(size=(96 * 128, 2)) @ root.T
    everywhere = np.ones(96 * 128, np.float32)
    assert noise_inflation(residual, cov, everywhere) < 1.2
    assert noise_inflation(3 * residual, cov, everywhere) == pytest.approx(9, rel=0.2)
    few = residual.copy()
    few[: 20 * 128] += 30  # a fifth of the image moves: no reason to weaken the rest
    assert noise_inflation(few, cov, everywhere) < 2.0
    assert noise_inflation(3 * residual, cov, 0 * everywhere) == 1.0


def test_evidence_of_a_wrong_pose_is_weak() -> None:
    """The whole image disagrees with the pose: with noise inflation nothing is called moving, without it much is."""
    rng = np.random.default_rng(1)
    cov = np.full((96, 128, 3), 0.0, np.float32) + np.array([0.1, 0.0, 0.1], np.float32)
    residual = (rng.normal(size=(96, 128, 2)) * 3).astype(np.float32)
    plain = motion_log_ratio(residual, cov)
    factor = noise_inflation(residual.reshape(-1, 2), cov.reshape(-1, 3), np.ones(96 * 128, np.float32))
    inflated = motion_log_ratio(residual, cov * np.float32(factor))
    assert (plain > 1).mean() > 0.8 and (inflated > 1).mean() < 0.2
