"""Between photographs, pinhole images and flows: what goes there comes back."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from mastd3r.camera.map_view import MapView
from mastd3r.camera.pinhole import Camera
from mastd3r.dynamics.flow import HalfFlow
from mastd3r.dynamics.soft_mask import static_at
from mastd3r.dynamics.uncertainty import SeenFrom, reprojection_residual_px, uncertainty_weight
from mastd3r.graph.prediction import cell_centres
from mastd3r.offline.smoothing import is_holdout
from mastd3r.pointmap.flow_maps import chained_flow, invert_flow
from mastd3r.tracking.depth_prior import own_depth_spread

Array = NDArray[Any]


def smooth_picture(width: int, height: int) -> Array:
    y, x = np.mgrid[0:height, 0:width] / width
    waves = [np.sin(9 * x + 4 * y), np.sin(7 * y - 3 * x), np.cos(8 * x * y)]
    return np.rint(127 + 100 * np.stack(waves, -1)).astype(np.uint8)


@pytest.mark.parametrize("k1", [-0.12, -0.03, 0.05])
def test_a_photograph_survives_the_pinhole_image(k1: float) -> None:
    full = Camera.centred(300, 320, 240, k1)
    view = MapView(full, 160, 2.0)
    assert view.pinhole.k1 == 0 and (view.camera.width, view.camera.height) == (160, 120)
    photo = smooth_picture(320, 240)
    pinhole, inside = view.pinhole_image(photo)
    assert pinhole.shape == (view.pinhole.height, view.pinhole.width, 3) and inside.shape == pinhole.shape[:2]
    assert pinhole.dtype == np.uint8 and set(np.unique(inside)) <= {0.0, 1.0}
    small = cv2.resize(photo, (160, 120), interpolation=cv2.INTER_AREA) / 255
    back = view.as_photograph(pinhole) / 255
    assert back.shape == (120, 160, 3)
    assert np.abs(back - small)[3:-3, 3:-3].max() < 0.03
    # nothing of the photograph is cut: the pinhole image holds the ray of every pixel
    seen = view.pinhole.project(view.camera.rays(view.camera.pixel_grid()))
    assert seen.min() > -1 and (seen < [view.pinhole.width, view.pinhole.height]).all()


def test_the_pinhole_image_is_straight() -> None:
    """A point of the photograph lands where its ray meets the pinhole image."""
    full = Camera.centred(300, 320, 240, -0.1)
    view = MapView(full, 320, 2.0)
    photo = np.zeros((240, 320, 3), np.uint8)
    at = np.array([[40.0, 50], [280, 200], [160, 30]])
    for x, y in at.astype(int):
        cv2.circle(photo, (int(x), int(y)), 4, (255, 255, 255), -1)
    pinhole, _ = view.pinhole_image(photo)
    for x, y in view.pinhole.project(full.rays(at)):
        near = pinhole[round(y) - 8 : round(y) + 9, round(x) - 8 : round(x) + 9, 0]
        cy, cx = np.average(np.indices(near.shape).reshape(2, -1), axis=1, weights=near.reshape(-1))
        assert abs(cx - 8 + round(x) - x) < 0.7 and abs(cy - 8 + round(y) - y) < 0.7


def test_a_lens_without_distortion_changes_nothing() -> None:
    view = MapView(Camera.centred(300, 320, 240), 320, 2.0)
    photo = smooth_picture(320, 240)
    pinhole, inside = view.pinhole_image(photo)
    assert np.array_equal(pinhole, photo)
    assert view.pad_px == 0 and inside.all() and view.as_photograph(pinhole) is pinhole
    assert MapView(Camera.centred(300, 320, 240), 999, 2.0).camera.width == 320  # never enlarged


def test_flows_are_inverted_and_chained() -> None:
    x, y = np.meshgrid(np.arange(160, dtype=np.float32), np.arange(120, dtype=np.float32))
    grid = np.stack([x, y], -1)
    turn = np.array([[np.cos(0.02), -np.sin(0.02)], [np.sin(0.02), np.cos(0.02)]], np.float32)
    first = (grid @ turn.T - grid + [3, -2]).astype(np.float32)
    second = (grid @ turn @ np.diag([1.02, 1.02]) - grid).astype(np.float32)
    there = grid + first
    whole = there @ turn @ np.diag([1.02, 1.02]) - grid
    inner = np.s_[12:-12, 12:-12]
    np.testing.assert_allclose(chained_flow(first, second)[inner], whole[inner], atol=0.05)
    back = invert_flow(first)
    round_trip = chained_flow(first, back)
    assert np.abs(round_trip[inner]).max() < 0.15


def test_static_weight_is_read_at_the_nearest_pixel_inside() -> None:
    moving = np.zeros((4, 6), np.float32)
    moving[1, 2], moving[3, 5] = 1.0, 0.25
    px = np.array([[2.4, 0.6], [2.6, 1.0], [99, 99], [-5, -5]])
    np.testing.assert_allclose(static_at(moving, px), [0, 1, 0.75, 1])


def test_cell_centres_are_pixel_centres() -> None:
    centres = cell_centres((2, 3), 35, 25)
    np.testing.assert_allclose(centres[:4], [[5, 5], [16, 5], [27, 5], [5, 16]])


def test_uncertainty_of_eq_16() -> None:
    """u = e / max e over R = {e > tau²}; tau in pixels, e squared."""
    e = np.array([1.0, 3.9, 4.1, 16.0, 8.0])
    np.testing.assert_allclose(uncertainty_weight(e, 2.0), [0, 0, 4.1 / 16, 1, 0.5])
    np.testing.assert_array_equal(uncertainty_weight(e, 5.0), 0)


def test_every_eighth_frame_is_held_out() -> None:
    assert [n for n in range(25) if is_holdout(n)] == [0, 8, 16, 24]


@pytest.mark.parametrize("sigma", [0.03, 0.12])
def test_the_spread_of_own_depths_is_measured(sigma: float) -> None:
    """Frames each of another scale, solved depths that lean on them; a point in twenty is far off."""
    rng = np.random.default_rng(0)
    y, x = np.divmod(np.arange(400), 20)
    px = np.stack([10 * x + 5, 10 * y + 5], 1).astype(float)
    keyframes, variables = [], {}
    for n in range(4):
        inv_depth = rng.uniform(0.2, 1.0, 400)
        away = rng.normal(0, sigma, 400)
        own = inv_depth * np.exp(away) * rng.uniform(0.5, 2)
        own[rng.random(400) < 0.05] *= 3
        dense = np.kron(own.reshape(20, 20), np.ones((10, 10))).astype(np.float32)
        info = np.where(rng.random(400) < 0.7, 1e4, 10.0) / inv_depth**2  # a third is not fixed by matches
        solved = np.where(info * inv_depth**2 > 100, inv_depth * np.exp(away / 3), 1.5 * inv_depth)
        variables[n] = SimpleNamespace(
            px=px, inv_depth=solved, depth_info=info, prior_info=info / 2
        )  # leans by a third
        keyframes.append(SimpleNamespace(id=n, work=SimpleNamespace(own_inv_depth=dense)))
    graph: Any = SimpleNamespace(keyframes=keyframes, variables=variables)
    assert own_depth_spread(graph) == pytest.approx(sigma, rel=0.15)
    graph.keyframes = [SimpleNamespace(id=0, work=SimpleNamespace(own_inv_depth=None))]
    assert own_depth_spread(graph) is None


def wall_seen_from(x: float, picture: np.ndarray) -> np.ndarray:
    """A wall 2 units away, 100 px a unit of its own, from a camera that stands ``x`` to the right."""
    start = round(100 + 100 * x)
    return np.ascontiguousarray(picture[:192, start : start + 256])


CAMERA = Camera.centred(200.0, 256, 192)


def keyframes_of(grays: dict[float, np.ndarray]) -> list[SeenFrom]:
    """Keyframes at x = the keys, in which nothing moves."""
    out = []
    for x, gray in grays.items():
        cam_from_world = np.eye(4)
        cam_from_world[0, 3] = -x
        out.append(SeenFrom(gray, np.zeros(gray.shape, np.uint8), cam_from_world))
    return out


def residual_px(keyframes: list[SeenFrom], view: np.ndarray) -> np.ndarray:
    inv_depth = np.full((192, 256), 0.5, np.float32)
    return reprojection_residual_px(keyframes, CAMERA, np.eye(4), view, inv_depth, HalfFlow(128, 96), 8.0)


def test_reprojection_residual_finds_what_moved_and_nothing_else() -> None:
    """A block that stands elsewhere in both keyframes; the wall, textured or blank, has no residual."""
    rng = np.random.default_rng(0)
    picture = cv2.GaussianBlur(rng.integers(0, 256, (192, 500)).astype(np.float32), (0, 0), 2)
    picture = cv2.normalize(picture, None, 0, 255, cv2.NORM_MINMAX).astype(np.uint8)
    picture[:, 330:] = 120  # a blank part of the wall
    thing = ((rng.random((9, 5)) > 0.5) * 255).astype(np.uint8).repeat(8, 0).repeat(8, 1)  # 72 x 40

    def shown(x: float, column: int) -> np.ndarray:
        image = wall_seen_from(x, picture)
        image[60:132, column : column + 40] = thing
        return image

    view = shown(0.0, 90)
    keyframes = keyframes_of({-0.1: shown(-0.1, 84), 0.1: shown(0.1, 96)})  # on the wall it would be at 100 and 80
    residual = residual_px(keyframes, view)
    moved = np.zeros((96, 128), bool)
    moved[30:66, 45:65] = True
    near = cv2.dilate(moved.astype(np.uint8), np.ones((15, 15))) > 0
    assert (residual[moved] > 2).mean() > 0.4
    assert (residual[~near] > 2).mean() < 0.05
    for kf in keyframes:
        kf.moving[:] = 255
    assert not residual_px(keyframes, view).any()
    still = keyframes_of({-0.1: wall_seen_from(-0.1, picture), 0.1: wall_seen_from(0.1, picture)})
    quiet = residual_px(still, wall_seen_from(0.0, picture))
    assert (quiet > 2).mean() < 0.03
    assert not residual_px([], view).any()
