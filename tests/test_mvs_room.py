"""Depth, cloud and mesh of the made room, whose depth is exact."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from mastd3r.mvs.depth_maps import DepthMaps, dense_depth
from mastd3r.mvs.fuse import DenseCloud, fused
from mastd3r.mvs.mesh import meshed
from mastd3r.mvs.views import StereoView, angle_worth, neighbourhoods, visible
from mastd3r.sources.synthetic import SyntheticView, room_camera, synthetic_frames

Array = NDArray[Any]
EVERY = 12  # frame of 0.4 s steps: about 0.2 m


@pytest.fixture(scope="module")
def truth() -> list[SyntheticView]:
    return list(synthetic_frames(85, every=EVERY))


def points_of(view: SyntheticView, step: int) -> Array:
    camera = room_camera()
    at = camera.rays(camera.pixel_grid()) * view.depth_m[..., None]
    points = at @ view.world_from_cam[:3, :3].T + view.world_from_cam[:3, 3]
    return points[::step, ::step][~view.moving[::step, ::step]]


@pytest.fixture(scope="module")
def views(truth: list[SyntheticView]) -> list[StereoView]:
    return [StereoView(v.frame.timestamp_s, v.frame.image, ~v.moving, v.world_from_cam, room_camera()) for v in truth]


@pytest.fixture(scope="module")
def maps(truth: list[SyntheticView], views: list[StereoView]) -> DepthMaps:
    return dense_depth(views, np.concatenate([points_of(v, 10) for v in truth]), lambda: None)


@pytest.fixture(scope="module")
def cloud(views: list[StereoView], maps: DepthMaps) -> DenseCloud:
    return fused(views, maps)


@pytest.mark.slow
def test_trusted_depth_is_right_and_on_most_of_the_picture(truth: list[SyntheticView], maps: DepthMaps) -> None:
    depth, static = np.stack([v.depth_m for v in truth]), ~np.stack([v.moving for v in truth])
    trusted = maps.trusted
    error = np.abs(1 / maps.merged[trusted] / depth[trusted] - 1)
    assert np.median(error) < 0.004
    assert (error < 0.03).mean() > 0.93
    assert trusted.sum() / static.sum() > 0.6


@pytest.mark.slow
def test_what_moves_has_no_depth(truth: list[SyntheticView], maps: DepthMaps) -> None:
    moving = np.stack([v.moving for v in truth])
    assert moving.sum() > 1000
    assert not maps.trusted[moving].any()


@pytest.mark.slow
def test_the_cloud_lies_on_the_room_with_its_normals(truth: list[SyntheticView], cloud: DenseCloud) -> None:
    room = np.concatenate([points_of(v, 1) for v in truth])
    away, _ = cKDTree(room).query(cloud.points_world[::7])
    assert away.mean() < 0.02
    np.testing.assert_allclose(np.linalg.norm(cloud.normals, axis=1), 1, atol=1e-5)
    floor = np.abs(cloud.points_world[:, 1] - 1.30) < 0.02  # y is down, the floor is y = 1.30
    assert floor.sum() > 1000
    assert np.median(-cloud.normals[floor, 1]) > 0.97
    assert cloud.confidence.min() > 0 and cloud.confidence.max() <= 1


@pytest.mark.slow
def test_a_surface_is_given_once(maps: DepthMaps, cloud: DenseCloud) -> None:
    assert len(cloud.points_world) < 0.6 * maps.trusted.sum()


@pytest.mark.slow
def test_the_mesh_lies_on_the_room(truth: list[SyntheticView], views: list[StereoView], maps: DepthMaps) -> None:
    mesh = meshed(views, maps)
    room = cKDTree(np.concatenate([points_of(v, 1) for v in truth]))
    away, _ = room.query(mesh.vertices_world)
    assert np.median(away) < 0.015
    assert len(mesh.faces) > 5000
    assert mesh.faces.min() == 0 and mesh.faces.max() == len(mesh.vertices_world) - 1
    a, b, c = (mesh.vertices_world[mesh.faces[:, n]] for n in range(3))
    centre = np.mean([v.world_from_cam[:3, 3] for v in views], axis=0)
    towards = (np.cross(b - a, c - a) * (centre - a)).sum(1)
    assert (towards > 0).mean() > 0.9  # triangles face those who saw them
    assert mesh.colors.std() > 10


@pytest.mark.slow
def test_the_same_again(views: list[StereoView], truth: list[SyntheticView]) -> None:
    some, points = views[:3], np.concatenate([points_of(v, 10) for v in truth[:3]])
    first, second = (dense_depth(some, points, lambda: None) for _ in range(2))
    assert (first.merged == second.merged).all()


def test_sources_see_the_view_under_a_good_angle(truth: list[SyntheticView], views: list[StereoView]) -> None:
    points = np.concatenate([points_of(v, 10) for v in truth])
    near = neighbourhoods(views, points, 3)
    for i, n in enumerate(near):
        assert 1 <= len(n.sources) <= 3 and i not in n.sources
        depth = truth[i].depth_m[~truth[i].moving]
        assert n.inv_depth_range[0] < np.percentile(1 / depth, 2) < np.percentile(1 / depth, 98) < n.inv_depth_range[1]
    worth = angle_worth(np.array([0.0, 8.0, 60.0]))
    assert worth[1] == 1 and worth[0] < 0.5 and worth[2] < 0.01


def test_hidden_points_are_not_visible(truth: list[SyntheticView], views: list[StereoView]) -> None:
    view = views[0]
    shown = points_of(truth[0], 4)
    centre = view.world_from_cam[:3, 3]
    behind = centre + 2 * (shown - centre)
    assert visible(view, shown).mean() > 0.85
    both = visible(view, np.concatenate([shown, behind]))
    assert both[len(shown) :].mean() < 0.1
    assert not visible(view, 2 * centre - shown).any()  # behind the camera


def test_a_view_that_nothing_shares_has_no_depth(views: list[StereoView], truth: list[SyntheticView]) -> None:
    turned = views[0].world_from_cam @ np.diag([-1.0, 1, -1, 1])
    alone = StereoView(9.0, views[0].color, views[0].static, turned, views[0].camera)
    maps = dense_depth([views[0], views[2], alone], points_of(truth[0], 10), lambda: None)
    assert not maps.inv_depth[2].any() and not maps.trusted[2].any()
