"""What no photograph shows: a finished map has no hole there, and nothing that is known is hidden."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
import torch

from mastd3r.camera.pinhole import Camera
from mastd3r.config import MappingConfig
from mastd3r.mapping import coverage
from mastd3r.mapping.coverage import with_backdrop
from mastd3r.mapping.gaussians import Array, GaussianMap
from mastd3r.mapping.mapper import Mapper
from mastd3r.mapping.seed import seed_gaussians
from mastd3r.types import StaticCloud, View

CAMERA = Camera.centred(120.0, 160, 120)
NEAR = 0.01
HOLE = (slice(40, 80), slice(60, 100))


def wall(open_middle: bool) -> GaussianMap:
    """A grey-blue opaque wall 3 units away, with or without its middle."""
    x, y = (a.ravel() for a in np.meshgrid(np.linspace(-2.6, 2.6, 110), np.linspace(-2, 2, 85)))
    inside = (np.abs(x) < 0.5) & (np.abs(y) < 0.5)
    x, y = (x[~inside], y[~inside]) if open_middle else (x, y)
    cloud = StaticCloud(
        points_world=np.stack([x, y, np.full_like(x, 3.0)], 1).astype(np.float32),
        colors=np.tile(np.array([60, 90, 150], np.uint8), (len(x), 1)),
        confidence=np.ones(len(x), np.float32),
        spacing=np.full(len(x), 0.06, np.float32),
        kf_id=np.zeros(len(x), np.int32),
    )
    gaussians = seed_gaussians(cloud, len(x), 0)
    with torch.no_grad():
        gaussians.opacity_logits += 4
    return gaussians


def view(x: float) -> View:
    """In every photograph something bright moves before the hole: nothing is known of what is behind."""
    image, static = np.full((120, 160, 3), (60, 90, 150), np.uint8), np.ones((120, 160), np.float32)
    image[30:90, 50:110], static[30:90, 50:110] = 255, 0.02
    pose = np.eye(4)
    pose[0, 3] = x
    return View(x, image, static, pose, CAMERA, 0)


def drawn(gaussians: GaussianMap, world_from_cam: Array) -> tuple[Array, Array]:
    with torch.no_grad():
        pose, K = torch.from_numpy(np.linalg.inv(world_from_cam)), torch.from_numpy(CAMERA.matrix)
        color, _, alpha = gaussians.draw(pose, K, CAMERA.width, CAMERA.height, NEAR)
    return color.numpy(), alpha.numpy()


@pytest.fixture(scope="module")
def filled() -> Callable[..., GaussianMap]:
    def make(gaussians: GaussianMap, views: list[View], room: int = 4000) -> GaussianMap:
        poses = [np.linalg.inv(v.world_from_cam) for v in views]
        return with_backdrop(gaussians, views, poses, NEAR, room)

    return make


def test_a_hole_is_filled_in_the_colours_around_it(filled: Callable[..., GaussianMap]) -> None:
    views, before = [view(x) for x in (-0.1, 0.1)], wall(open_middle=True)
    after = filled(before, views)
    assert drawn(before, np.eye(4))[1][HOLE].min() < 0.01
    for v in views:
        color, alpha = drawn(after, v.world_from_cam)
        assert (alpha > 0.9).all()
        assert np.abs(color[HOLE] - np.array([60, 90, 150]) / 255).max() < 0.12  # not what moved


def test_nothing_known_is_hidden(filled: Callable[..., GaussianMap]) -> None:
    """The wall's own pixels stay what they were, from beside too; a wall without a hole stays as it is."""
    views, before = [view(0.0)], wall(open_middle=True)
    after, known = filled(before, views), wall(open_middle=False)
    for x in (0.0, 0.6):
        pose = np.eye(4)
        pose[0, 3] = x
        (color, alpha), (new, _) = drawn(before, pose), drawn(after, pose)
        assert np.abs(new - color)[alpha > 0.98].max() < 0.02
    assert len(filled(known, views)) == len(known)


def test_no_more_than_there_is_room_for(filled: Callable[..., GaussianMap]) -> None:
    before = wall(open_middle=True)
    assert len(filled(before, [view(0.0), view(0.3)], room=50)) <= len(before) + 50
    assert len(filled(before, [view(0.0)], room=0)) == len(before)


def test_pixels_without_data_stay_open(filled: Callable[..., GaussianMap]) -> None:
    """The black border that undistortion leaves is not part of the world."""
    blind = view(0.0)
    static = blind.static.copy()
    static[static < 0.5] = 0
    before = wall(open_middle=True)
    assert len(filled(before, [replace(blind, static=static)])) == len(before)


def test_few_pixels_are_left(filled: Callable[..., GaussianMap], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(coverage, "FEW", 10_000)
    before = wall(open_middle=True)
    assert len(filled(before, [view(0.0)])) == len(before)


def test_a_trained_map_has_no_hole() -> None:
    """The mapper puts it there when it settles, within the number of Gaussians that is allowed."""
    gaussians = wall(open_middle=True).arrays()
    cloud = StaticCloud(
        points_world=gaussians.means,
        colors=np.rint(gaussians.colors * 255).astype(np.uint8),
        confidence=np.ones(len(gaussians.means), np.float32),
        spacing=np.full(len(gaussians.means), 0.06, np.float32),
        kf_id=gaussians.kf_id,
    )
    mapper = Mapper(MappingConfig(iterations=60, max_gaussians=6000), cloud, [view(x) for x in (-0.1, 0, 0.1)], 0)
    mapper.refine(60)
    assert mapper.render(np.eye(4), CAMERA)[2][HOLE].min() < 0.5
    mapper.settle()
    assert (mapper.render(np.eye(4), CAMERA)[2][HOLE] > 0.9).mean() > 0.98 and len(mapper.gaussians.means) <= 6000
    mapper.refine(1)  # and the optimiser has followed
