"""Two-view pointmaps: sub-pixel flow on pictures whose motion is known, triangulation, predicted flow, own depth."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from mastd3r.camera.pinhole import Camera
from mastd3r.geometry.se3 import inverse, transform
from mastd3r.pointmap.flow import FlowMatcher, corner_grid
from mastd3r.pointmap.flow_maps import resized_flow
from mastd3r.pointmap.geometric import GeometricPointmaps, SensorDepthPointmaps, sample_own, working_size
from mastd3r.sources.synthetic import SyntheticView, room_camera
from mastd3r.types import Frame, Guess

Array = NDArray[Any]
WIDTH, HEIGHT = 320, 240


class Texture:
    """A sum of plane waves: a picture that is known between its pixels too."""

    def __init__(self, seed: int = 0, waves: int = 80) -> None:
        rng = np.random.default_rng(seed)
        length_px = np.exp(rng.uniform(np.log(7), np.log(90), waves))
        angle = rng.uniform(0, 2 * np.pi, waves)
        self.k = 2 * np.pi / length_px * np.stack([np.cos(angle), np.sin(angle)])
        self.phase = rng.uniform(0, 2 * np.pi, waves)
        self.height = length_px**0.5
        self.noise = np.random.default_rng(seed + 1)

    def seen_at(self, at: Array) -> Array:
        """(h, w) uint8 with one grey level of noise, of the picture at ``at`` (h, w, 2)."""
        value = np.zeros(at.shape[:2])
        for k, phase, height in zip(self.k.T, self.phase, self.height, strict=True):
            value += height * np.sin(at @ k + phase)
        value = 128 + 40 * value / np.sqrt((self.height**2).sum() / 2)
        return np.rint(value + self.noise.normal(0, 1, value.shape)).clip(0, 255).astype(np.uint8)


GRID = Camera.centred(1, WIDTH, HEIGHT).pixel_grid()
CENTRE = np.array([(WIDTH - 1) / 2, (HEIGHT - 1) / 2])


def turned(angle: float, zoom: float = 1.0) -> Array:
    c, s = zoom * np.cos(angle), zoom * np.sin(angle)
    return np.array([[c, -s], [s, c]])


def pair_of(matrix: Array, shift: Array) -> tuple[Array, Array, Callable[[Array], Array]]:
    """Pictures ref and new with new(M (x - c) + c + t) = ref(x), and the map of pixels."""
    texture = Texture()
    back = np.linalg.inv(matrix)
    ref = texture.seen_at(GRID)
    new = texture.seen_at((GRID - CENTRE - shift) @ back.T + CENTRE)
    return ref, new, lambda px: (px - CENTRE) @ matrix.T + CENTRE + shift


def error_px(
    matcher: FlowMatcher, pair: tuple, start: Array | None = None, near: bool = False
) -> tuple[float, float, float]:
    """Median and 95th percentile of the error of the believed matches, and their share of those in view."""
    ref, new, where = pair
    px, _ = corner_grid(ref, 10)
    found = matcher.match(ref, new, px, start, near=near)
    truth = where(px)
    visible = np.ones(len(px), bool)
    for at in (px, truth):  # a match's window must lie in both pictures
        visible &= ((at > 14) & (at < [WIDTH - 15, HEIGHT - 15])).all(1)
    used = (found.weight > 0.5) & visible
    error = np.linalg.norm(found.target - truth, axis=1)[used]
    return float(np.median(error)), float(np.percentile(error, 95)), float(used.sum() / visible.sum())


@pytest.mark.parametrize(
    ("matrix", "shift"),
    [
        (np.eye(2), np.array([0.0, 0.0])),
        (np.eye(2), np.array([3.37, -2.61])),
        (np.eye(2), np.array([-11.5, 6.25])),
        (turned(np.deg2rad(4)), np.array([1.3, 2.2])),
        (turned(0.0, 1.06), np.array([0.0, -3.7])),
    ],
)
def test_flow_is_sub_pixel(matrix: Array, shift: Array) -> None:
    median, p95, share = error_px(FlowMatcher(WIDTH, HEIGHT), pair_of(matrix, shift))
    assert median < 0.1 and p95 < 0.4 and share > 0.8


@pytest.mark.parametrize("start_error_px", [0.0, 2.5])
def test_flow_with_a_start_follows_a_jump_of_60_px(start_error_px: float) -> None:
    shift = np.array([60.3, -4.4])
    start = np.tile(np.float32(shift + start_error_px), (HEIGHT, WIDTH, 1))
    median, p95, share = error_px(FlowMatcher(WIDTH, HEIGHT), pair_of(np.eye(2), shift), start)
    assert median < 0.1 and p95 < 0.4 and share > 0.8


def test_flow_with_a_turning_start() -> None:
    matrix, shift = turned(np.deg2rad(25)), np.array([12.0, 5.0])
    pair = pair_of(matrix, shift)
    start = (pair[2](GRID) - GRID).astype(np.float32)
    median, _, share = error_px(FlowMatcher(WIDTH, HEIGHT), pair, start)
    assert median < 0.1 and share > 0.8


@pytest.mark.parametrize("start_size", [(HEIGHT, WIDTH), (HEIGHT // 2, WIDTH // 2)])
def test_near_flow_of_large_images_is_found_at_half_their_size(
    start_size: tuple[int, int], monkeypatch: pytest.MonkeyPatch
) -> None:
    """The start is 2 px off. It may be of either size; matches are as good as those from flow of the whole size."""
    matrix, shift = turned(np.deg2rad(5), 1.03), np.array([31.4, -7.3])
    pair = pair_of(matrix, shift)
    start = resized_flow((pair[2](GRID) - GRID + 1.5).astype(np.float32), start_size[1], start_size[0])
    matcher = FlowMatcher(WIDTH, HEIGHT)
    assert matcher.dense(*pair[:2], start, near=True).shape == (HEIGHT, WIDTH, 2)  # these images are small
    monkeypatch.setattr("mastd3r.pointmap.flow.LARGE_PX", WIDTH * HEIGHT)
    half = matcher.dense(*pair[:2], start, near=True)
    assert half.shape == (HEIGHT // 2, WIDTH // 2, 2)
    inner = np.s_[20:-20, 40:-40]
    error = np.linalg.norm(resized_flow(half, WIDTH, HEIGHT) - (pair[2](GRID) - GRID), axis=-1)[inner]
    assert np.median(error) < 0.5
    median, p95, share = error_px(matcher, pair, start, near=True)
    assert median < 0.1 and p95 < 0.4 and share > 0.8


def test_pictures_without_anything_in_common_do_not_match() -> None:
    ref, new = Texture(0).seen_at(GRID), Texture(50).seen_at(GRID)
    px, _ = corner_grid(ref, 10)
    same = FlowMatcher(WIDTH, HEIGHT).match(ref, ref, px)
    other = FlowMatcher(WIDTH, HEIGHT).match(ref, new, px)
    assert (other.weight > 0.5).mean() < 0.3 < (same.weight > 0.5).mean()
    assert ((other.weight >= 0) & (other.weight <= 1)).all()


def test_matches_outside_the_new_picture_have_no_weight() -> None:
    pair = pair_of(np.eye(2), np.array([60.3, 0.0]))
    start = np.tile(np.float32([60.3, 0.0]), (HEIGHT, WIDTH, 1))
    px, _ = corner_grid(pair[0], 10)
    found = FlowMatcher(WIDTH, HEIGHT).match(pair[0], pair[1], px, start)
    assert (found.weight[pair[2](px)[:, 0] > WIDTH] == 0).all()


def test_corner_grid_finds_the_corner_of_every_cell() -> None:
    gray = np.full((67, 103), 60, np.uint8)  # not a multiple of the cell
    rng = np.random.default_rng(0)
    rows, cols, cell = 3, 5, 20
    wanted = np.zeros((rows * cols, 2))
    for n in range(rows * cols):
        y, x = n // cols * cell + rng.integers(6, 14), n % cols * cell + rng.integers(6, 14)
        gray[y - 1 : y + 2, x - 1 : x + 2] = 220
        wanted[n] = x, y
    px, strength = corner_grid(gray, cell)
    assert px.shape == (rows * cols, 2) and strength.shape == (rows * cols,)
    assert np.abs(px - wanted).max() <= 3 and (strength > 0).all()
    flat, nothing = corner_grid(np.full((67, 103), 60, np.uint8), cell)
    assert (nothing == 0).all() and len(flat) == rows * cols


def test_working_size_keeps_the_shape_and_never_enlarges() -> None:
    assert working_size(320, 240, 196608) == (320, 240)
    assert working_size(1024, 768, 196608) == (512, 384)
    w, h = working_size(1920, 1080, 196608)
    assert w * h == pytest.approx(196608, rel=0.01) and w / h == pytest.approx(16 / 9, rel=0.01)


def test_geometric_provider_predicts_the_room(room_views: list[SyntheticView]) -> None:
    """Real shading: static pixels are found where exact depth and poses put them; known depths become points."""
    a, b = room_views[0], room_views[4]
    provider, camera = GeometricPointmaps(160, 120, 10), room_camera(160, 120)
    ref, new = provider.observe(a.frame), provider.observe(b.frame)
    assert ref.px.shape == (12 * 16, 2) and ref.grid == (12, 16) and ref.own_inv_depth is None
    x, y = ref.px.astype(int).T
    truth = a.depth_m[y, x].astype(float)
    pair = provider.predict(ref, new, Guess(camera, 1 / truth, 1e4 * truth**2))
    motion = inverse(b.world_from_cam) @ a.world_from_cam
    expected = camera.project(transform(motion, camera.rays(ref.px) * truth[:, None]))
    sure = (pair.matches.weight > 0.3) & ~a.moving[y, x]
    assert sure.sum() > 12 and pair.new_own is None
    assert np.median(np.linalg.norm(pair.matches.new_px - expected, axis=1)[sure]) < 0.15
    np.testing.assert_allclose(pair.ref.points[:, 2], truth, rtol=1e-6)
    assert (pair.ref.confidence > 0.9).all()
    unknown = provider.predict(ref, new, Guess(camera))
    assert (unknown.ref.confidence == 0).all() and unknown.flow.shape == (120, 160, 2)


def with_depth(view: SyntheticView) -> Frame:
    return replace(view.frame, depth_m=view.depth_m)


def test_sensor_depth_becomes_points_of_the_frame_itself(room_views: list[SyntheticView]) -> None:
    provider, camera = SensorDepthPointmaps(160, 120, 10), room_camera(160, 120)
    ref, new = (provider.observe(with_depth(v)) for v in (room_views[0], room_views[1]))
    assert ref.own_inv_depth is not None
    np.testing.assert_allclose(ref.own_inv_depth, 1 / room_views[0].depth_m, rtol=1e-6)
    own = provider.predict(ref, new, Guess(camera)).new_own
    assert own is not None
    sure = own.confidence > 0
    assert sure.mean() > 0.5
    x, y = np.round(own.px[sure]).astype(int).T
    np.testing.assert_allclose(own.points[sure, 2], room_views[1].depth_m[y, x], rtol=1e-6)
    np.testing.assert_allclose(camera.project(own.points[sure]), own.px[sure], atol=1e-6)


def test_sensor_depth_is_unknown_at_holes_and_edges(room_views: list[SyntheticView]) -> None:
    depth = np.full((120, 160), 2.0, np.float32)
    depth[:, 80:] = 4.0
    depth[30:40, 20:30] = 0.0
    provider = SensorDepthPointmaps(160, 120, 10)
    work = provider.observe(replace(room_views[0].frame, depth_m=depth))
    at = np.array([[10.0, 10], [79, 50], [80, 50], [100, 50], [25, 35], [30, 40]])
    np.testing.assert_allclose(sample_own(work, at), [0.5, 0, 0, 0.25, 0, 0])
    none = provider.observe(room_views[0].frame)
    assert none.own_inv_depth is not None and (none.own_inv_depth == 0).all()
