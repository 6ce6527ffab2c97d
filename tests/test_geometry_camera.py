"""The camera: projection against rays, half pixels, padding."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from mastd3r.geometry.camera import Camera

QUICK = settings(max_examples=40, deadline=None)
cameras = st.builds(
    lambda f, w, h, k1, dx, dy: Camera(f * w, f * w * 1.03, w / 2 + dx, h / 2 + dy, w, h, k1),
    st.floats(0.7, 2.0),
    st.integers(64, 640),
    st.integers(64, 480),
    st.floats(-0.1, 0.15),
    st.floats(-8, 8),
    st.floats(-8, 8),
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


def test_the_radial_term_is_that_of_the_conventions() -> None:
    camera = Camera(100, 200, 10, 20, 64, 48, k1=0.5)
    x, y = 0.3, -0.2
    s = 1 + 0.5 * (x * x + y * y)
    np.testing.assert_allclose(camera.project(np.array([2 * x, 2 * y, 2])), [10 + 100 * x * s, 20 + 200 * y * s])
    np.testing.assert_allclose(camera.matrix @ [x, y, 1], [*camera.pinhole.project(np.array([x, y, 1])), 1])


def test_pixel_grid_is_x_then_y() -> None:
    grid = Camera.centred(10, 5, 3).pixel_grid()
    assert grid.shape == (3, 5, 2)
    assert tuple(grid[2, 4]) == (4.0, 2.0)


def test_k1_zero_is_exact() -> None:
    camera = Camera.centred(37.0, 64, 48)
    px = sample_px(camera)
    assert np.abs(camera.project(camera.rays(px)) - px).max() == pytest.approx(0, abs=1e-12)
