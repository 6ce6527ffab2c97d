"""The camera: projection against rays, half pixels, padding; the solver's lens as a camera and back."""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from mastd3r.camera.pinhole import Camera
from mastd3r.config import CameraConfig
from mastd3r.graph.intrinsics import Intrinsics, camera_of, intrinsics_for, inverse_radial

Array = NDArray[Any]

QUICK = settings(max_examples=40, deadline=None)
cameras = st.builds(
    lambda f, w, h, k1, dx, dy, k2, k3: Camera(f * w, f * w * 1.03, w / 2 + dx, h / 2 + dy, w, h, k1, k2, k3),
    st.floats(0.7, 2.0),
    st.integers(64, 640),
    st.integers(64, 480),
    st.floats(-0.1, 0.15),
    st.floats(-8, 8),
    st.floats(-8, 8),
    st.floats(-0.06, 0.1),
    st.floats(-0.04, 0.06),
)


def sample_px(camera: Camera, count: int = 50) -> np.ndarray:
    rng = np.random.default_rng(0)
    return rng.uniform([-0.5, -0.5], [camera.width - 0.5, camera.height - 0.5], (count, 2))


@QUICK
@given(cameras)
def test_project_and_rays_are_inverse(camera: Camera) -> None:
    px = sample_px(camera)
    px = px[np.hypot(*((px - [camera.cx_px, camera.cy_px]) / camera.fx_px).T) < 0.8]
    rays = camera.rays(px)
    assert (rays[:, 2] == 1).all()
    depth = np.linspace(0.1, 50, len(px))[:, None]
    np.testing.assert_allclose(camera.project(rays * depth), px, atol=1e-3)
    np.testing.assert_allclose(camera.unproject(px, 1 / depth[:, 0]), rays * depth, rtol=1e-12)
    assert camera.unproject(px[0], np.float64(0.5)).shape == (3,)


@QUICK
@given(cameras, st.booleans())
def test_the_kernels_are_numpy_to_the_last_bit(camera: Camera, bent: bool) -> None:
    camera = camera if bent else camera.pinhole
    px, (k1, k2, k3) = sample_px(camera), (camera.k1, camera.k2, camera.k3)
    focal, centre = np.array([camera.fx_px, camera.fy_px]), np.array([camera.cx_px, camera.cy_px])
    x = seen = (px - centre) / focal
    for _ in range(10 if bent else 0):
        r2 = (x**2).sum(-1, keepdims=True)
        x = seen / (1 + r2 * (k1 + r2 * (k2 + k3 * r2)))
    rays = camera.rays(px.reshape(5, 10, 2))
    np.testing.assert_array_equal(rays, np.concatenate([x, np.ones((50, 1))], -1).reshape(5, 10, 3))
    points = rays * np.random.default_rng(1).uniform(0.5, 9, (5, 10, 1))
    xy = points[..., :2] / points[..., 2:]
    r2 = (xy**2).sum(-1, keepdims=True)
    np.testing.assert_array_equal(camera.project(points), xy * (1 + r2 * (k1 + r2 * (k2 + k3 * r2))) * focal + centre)
    assert camera.rays(px[0]).shape == (3,) and camera.project(points[0, 0]).shape == (2,)


@QUICK
@given(cameras, st.floats(0.2, 3))
def test_resizing_keeps_every_ray(camera: Camera, scale: float) -> None:
    """A point of the picture at pixel p (centres at integers) is at (p + 1/2) s - 1/2 of the scaled picture."""
    small = camera.resized(max(8, round(camera.width * scale)), max(8, round(camera.height * scale)))
    s = np.array([small.width / camera.width, small.height / camera.height])
    px = sample_px(camera)
    np.testing.assert_allclose(small.rays((px + 0.5) * s - 0.5), camera.rays(px), atol=1e-9)
    back = small.resized(camera.width, camera.height)
    np.testing.assert_allclose(
        [back.fx_px, back.fy_px, back.cx_px, back.cy_px],
        [camera.fx_px, camera.fy_px, camera.cx_px, camera.cy_px],
        atol=1e-8,
    )


@QUICK
@given(cameras, st.integers(0, 40))
def test_padding_shifts_pixels_and_keeps_rays(camera: Camera, pad_px: int) -> None:
    wide = camera.padded(pad_px)
    px = sample_px(camera)
    np.testing.assert_allclose(wide.rays(px + pad_px), camera.rays(px), atol=1e-12)
    assert (wide.width, wide.height) == (camera.width + 2 * pad_px, camera.height + 2 * pad_px)


def test_centred_halves_to_centred() -> None:
    camera = Camera.centred(300, 320, 240, k1=-0.05)
    assert (camera.cx_px, camera.cy_px) == (159.5, 119.5)
    half = camera.resized(160, 120)
    assert half == Camera.centred(150, 160, 120, k1=-0.05)
    np.testing.assert_allclose(camera.rays(np.array([159.5, 119.5])), [0, 0, 1])


def test_the_radial_terms_are_those_of_the_definition() -> None:
    camera = Camera(100, 200, 10, 20, 64, 48, k1=0.5, k2=-0.7, k3=0.9)
    x, y = 0.3, -0.2
    r2 = x * x + y * y
    s = 1 + 0.5 * r2 - 0.7 * r2**2 + 0.9 * r2**3
    np.testing.assert_allclose(camera.project(np.array([2 * x, 2 * y, 2])), [10 + 100 * x * s, 20 + 200 * y * s])
    np.testing.assert_allclose(camera.matrix @ [x, y, 1], [*camera.pinhole.project(np.array([x, y, 1])), 1])


@pytest.mark.parametrize("terms", [(0.1, 0, 0), (0, 0.1, 0), (0, 0, 0.1)])
def test_any_radial_term_bends_and_pinhole_has_none(terms: tuple[float, float, float]) -> None:
    camera = Camera(300, 300, 150, 120, 320, 240, *terms)
    assert camera.distorted and not camera.pinhole.distorted
    corner = np.array([0.5, 0.4, 1.0])
    assert np.abs(camera.project(corner) - camera.pinhole.project(corner)).max() > 0.5
    assert camera.resized(160, 120).pinhole == camera.pinhole.resized(160, 120)
    for other in (camera.resized(160, 120), camera.padded(7)):
        assert (other.k1, other.k2, other.k3) == terms


def test_opencv_projects_the_same() -> None:
    camera = Camera(310, 305, 161, 118, 320, 240, k1=-0.12, k2=0.05, k3=-0.01)
    points = np.random.default_rng(0).uniform([-1, -1, 2], [1, 1, 3], (40, 3))
    terms = np.array([camera.k1, camera.k2, 0, 0, camera.k3])
    theirs, _ = cv2.projectPoints(points, np.zeros(3), np.zeros(3), camera.matrix, terms)
    np.testing.assert_allclose(camera.project(points), theirs[:, 0], atol=1e-9)


def test_pixel_grid_is_x_then_y() -> None:
    grid = Camera.centred(10, 5, 3).pixel_grid()
    assert grid.shape == (3, 5, 2)
    assert tuple(grid[2, 4]) == (4.0, 2.0)


def test_k1_zero_is_exact() -> None:
    camera = Camera.centred(37.0, 64, 48)
    px = sample_px(camera)
    assert np.abs(camera.project(camera.rays(px)) - px).max() == pytest.approx(0, abs=1e-12)


# -- the solver's lens ---------------------------------------------------------------------------------------------


def bent_lens(terms: tuple[float, ...], focal_px: float, size: tuple[int, int]) -> Intrinsics:
    lens = intrinsics_for(CameraConfig(), *size, size)
    lens.values[[0, 1, 4, 5]] = np.log(focal_px), *terms
    return lens


def undistorted(lens: Intrinsics, px: Array) -> Array:
    """(p, 3) rays by the solver's own formula."""
    x = (px - lens.values[2:4]) / np.exp(lens.values[0])
    r2 = (x**2).sum(1, keepdims=True)
    u = x * (1 + lens.values[1] * r2 + lens.values[4] * r2**2 + lens.values[5] * r2**3)
    return np.concatenate([u, np.ones((len(u), 1))], 1)


@pytest.mark.parametrize("k", [-0.12, -0.03, 0.0, 0.05, 0.1])
def test_the_camera_inverts_the_solvers_undistortion(k: float) -> None:
    """u = x (1 + k x²) there, x = u (1 + k1 u²) here: the fitted k1 undoes it to a fraction of a pixel."""
    size, focal_px = (320, 240), 260.0
    k1, k2, k3 = inverse_radial(focal_px, (k, 0.0, 0.0), size)
    assert np.sign(k1) == -np.sign(k) and k2 == k3 == 0.0  # a lens of one term stays one
    lens = bent_lens((k, 0.0, 0.0), focal_px, size)
    camera = camera_of(lens, size)
    assert camera.k1 == pytest.approx(k1) and camera.fx_px == pytest.approx(focal_px)
    assert (camera.k2, camera.k3) == (0.0, 0.0)
    px = camera.pixel_grid()[::16, ::16].reshape(-1, 2)
    back = camera.project(undistorted(lens, px))
    assert np.abs(back - px).max() < 1.0 and np.sqrt(((back - px) ** 2).sum(1).mean()) < 0.4


@pytest.mark.parametrize(
    "terms",
    [(-0.12, 0.03, 0.001), (-0.03, -0.02, 0.01), (0.05, 0.04, -0.02), (0.1, -0.05, 0.03), (0.0, 0.0, 0.05)],
)
def test_three_terms_go_from_solver_to_camera_and_back(terms: tuple[float, float, float]) -> None:
    """With three terms on both sides the picture agrees to 0.05 px, and so do the rays both ways."""
    size, focal_px = (320, 240), 260.0
    lens = bent_lens(terms, focal_px, size)
    lens.values[2:4] += 4.0, -3.0
    camera = camera_of(lens, size)
    assert (camera.cx_px, camera.cy_px) == (163.5, 116.5) and camera.distorted
    np.testing.assert_allclose((camera.k1, camera.k2, camera.k3), inverse_radial(focal_px, terms, size), rtol=1e-9)
    px = camera.pixel_grid()[::8, ::8].reshape(-1, 2)
    rays = undistorted(lens, px)
    assert np.abs(camera.project(rays) - px).max() < 0.05
    assert np.abs(camera.rays(px) - rays).max() * focal_px < 0.1
    again = bent_lens(inverse_radial(focal_px, (camera.k1, camera.k2, camera.k3), size), focal_px, size)
    again.values[2:4] = lens.values[2:4]
    assert np.abs(undistorted(again, px) - rays).max() * focal_px < 0.1


def test_given_intrinsics_are_scaled_and_fixed() -> None:
    lens = intrinsics_for(CameraConfig(intrinsics=(600.0, 610.0, 320.0, 239.0)), 320, 240, (640, 480))
    assert np.exp(lens.values[0]) == pytest.approx(np.sqrt(300 * 305))
    np.testing.assert_allclose(lens.values[2:4], [(320.5) / 2 - 0.5, (239.5) / 2 - 0.5])
    assert lens.values.shape == (6,) and (lens.values[[1, 4, 5]] == 0).all()
    assert not lens.free.any()
    unknown = intrinsics_for(CameraConfig(estimate_radial=False), 320, 240, (640, 480))
    np.testing.assert_array_equal(unknown.free, [True] + [False] * 5)
    assert intrinsics_for(CameraConfig(), 320, 240, (640, 480)).free.all()


def test_a_given_radial_term_reaches_the_solver_and_comes_back() -> None:
    size = (320, 240)
    for k1 in (-0.1, 0.04):
        lens = intrinsics_for(CameraConfig(intrinsics=(260.0, 260.0, 159.5, 119.5, k1)), *size, size)
        assert lens.values[1] == inverse_radial(260.0, (k1, 0.0, 0.0), size)[0] and np.sign(lens.values[1]) == -np.sign(
            k1
        )
        assert (lens.values[4:] == 0).all()
        assert camera_of(lens, size).k1 == pytest.approx(k1, abs=0.15 * abs(k1))
