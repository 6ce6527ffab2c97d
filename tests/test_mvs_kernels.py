"""The stereo kernels do what their plain NumPy twins, or the equation itself, say."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.sparse import diags_array
from scipy.sparse.linalg import spsolve

from mastd3r.camera.pinhole import Camera
from mastd3r.geometry.se3 import inverse
from mastd3r.mvs.depth_maps import agreed, pinhole
from mastd3r.mvs.fill import filled
from mastd3r.mvs.fill_kernels import relax
from mastd3r.mvs.fuse import normals_cam
from mastd3r.mvs.mesh import surface_net
from mastd3r.mvs.sweep_kernels import aggregate, best_plane, plane_cost
from mastd3r.mvs.tsdf_kernels import SIDE, integrate
from mastd3r.mvs.views import Neighbourhood

Array = NDArray[Any]


def test_plane_cost_is_the_better_half_of_normalised_correlation() -> None:
    rng = np.random.default_rng(0)
    ref_mean, ref_var = rng.uniform(0, 255, (6, 7)), rng.uniform(0, 900, (6, 7))
    mean = rng.uniform(0, 255, (5, 6, 7))
    sums = np.stack(
        [mean, mean**2 + rng.uniform(0, 900, mean.shape), mean * ref_mean + rng.normal(0, 300, mean.shape)], 1
    )
    valid = (rng.random(mean.shape) < 0.6).astype(np.uint8)
    valid[:, 0, 0] = 0
    out = np.empty((6, 7), np.float32)
    plane_cost(ref_mean, ref_var, sums, valid, 4.0, out)
    var = np.maximum(sums[:, 1] - mean**2, 0)
    ncc = (sums[:, 2] - mean * ref_mean) / np.sqrt((var + 4) * (ref_var + 4))
    cost = np.sort(np.where(valid > 0, np.clip(1 - ncc, 0, 1), np.inf), 0)
    used = (valid.sum(0) + 1) // 2
    expected = np.ones((6, 7))
    for y, x in np.argwhere(used > 0):
        expected[y, x] = cost[: used[y, x], y, x].mean()
    np.testing.assert_allclose(out, expected, rtol=1e-5)


def aggregate_twin(cost: Array, gray: Array, p1: float, p2: float, edge: float) -> Array:
    """All eight paths of Hirschmueller's (13), pixel by pixel."""
    h, w = cost.shape[:2]
    total = np.zeros_like(cost)
    for dy, dx in ((0, 1), (1, 1), (1, 0), (1, -1), (0, -1), (-1, -1), (-1, 0), (-1, 1)):
        path = np.zeros_like(cost)
        rows = range(h) if dy >= 0 else range(h - 1, -1, -1)
        for y in rows:
            for x in range(w) if dx >= 0 else range(w - 1, -1, -1):
                before = y - dy, x - dx
                path[y, x] = cost[y, x]
                if 0 <= before[0] < h and 0 <= before[1] < w:
                    jump = max(p1, p2 / (1 + abs(gray[y, x] - gray[before]) / edge))
                    last = path[before]
                    step = np.minimum(np.append(last[1:], np.inf), np.append(np.inf, last[:-1])) + p1
                    path[y, x] += np.minimum(np.minimum(last, step), last.min() + jump) - last.min()
        total += path
    return total


def test_aggregation_follows_eight_paths() -> None:
    rng = np.random.default_rng(1)
    cost = rng.random((7, 9, 6)).astype(np.float32)
    gray = rng.uniform(0, 60, (7, 9)).astype(np.float32)
    total = np.zeros_like(cost)
    for backward in (False, True):
        aggregate(cost, gray, 0.1, 0.7, 0.1, 12.0, backward, total)
    np.testing.assert_allclose(total, aggregate_twin(cost, gray, 0.1, 0.7, 12.0), rtol=1e-4)


def test_the_best_plane_lies_between_planes() -> None:
    at = np.array([[2.3, 0.0], [4.8, 7.0]])
    total = ((np.arange(8) - at[..., None]) ** 2).astype(np.float32)
    place = np.empty((2, 2), np.float32)
    best_plane(total, place)
    np.testing.assert_allclose(place, at, atol=1e-5)


def test_relaxation_solves_its_equation() -> None:
    rng = np.random.default_rng(2)
    h, w = 9, 8
    data, weight, right, down = (rng.random((h, w)) for _ in range(4))
    weight[rng.random((h, w)) < 0.7] = 0
    right[:, -1] = down[-1] = 0
    value = np.zeros((h, w))
    relax(value, data, weight, right, down, 1.7, 400)
    r, d = right.ravel()[:-1], down.ravel()[:-w]
    laplace = diags_array([-r, -r, -d, -d], offsets=[1, -1, w, -w], shape=(h * w, h * w)).tocsr()
    matrix = laplace - diags_array(laplace.sum(1)) + diags_array(weight.ravel())
    np.testing.assert_allclose(value.ravel(), spsolve(matrix.tocsc(), (weight * data).ravel()), atol=1e-6)


def test_a_bare_plane_is_filled_from_its_outline() -> None:
    y, x = np.mgrid[:64, :80].astype(np.float32)
    plane = 0.5 + 0.002 * x - 0.001 * y
    known = np.ones(plane.shape, np.float32)
    known[8:56, 8:72] = 0
    found = filled(np.where(known > 0, plane, 9.0), known, np.full((64, 80, 3), 90, np.uint8))
    np.testing.assert_allclose(found, plane, rtol=0.01)
    assert not filled(plane, np.zeros_like(known), np.zeros((64, 80, 3), np.uint8)).any()


def two_walls() -> tuple[Array, Camera, Array]:
    """Inverse depth of three views of a slanted wall, with holes and one wrong patch."""
    camera = Camera.centred(60.0, 40, 30)
    poses = np.tile(np.eye(4), (3, 1, 1))
    poses[1, 0, 3], poses[2, 1, 3] = 0.2, 0.15
    normal, offset = np.array([0.2, -0.1, 1.0]), 2.0  # normal . X = offset
    rays = camera.rays(camera.pixel_grid())
    maps = np.stack([rays @ (pose[:3, :3].T @ normal) / (offset - normal @ pose[:3, 3]) for pose in poses])
    maps[1, 5:9, 5:9] = 0
    maps[2, 20:, 30:] *= 1.2
    return maps.astype(np.float32), camera, poses


def test_views_agree_where_they_see_one_surface() -> None:
    maps, camera, poses = two_walls()
    near = [Neighbourhood(tuple(j for j in range(3) if j != i), (0.1, 1.0)) for i in range(3)]
    count, merged = agreed(maps, camera, poses, near, 1.0)
    px = camera.pixel_grid()
    for i in range(3):
        expected = np.zeros(count.shape[1:], int)
        for j in near[i].sources:
            j_from_i = inverse(poses[j]) @ poses[i]
            points = camera.unproject(px, np.maximum(maps[i], 1e-6)) @ j_from_i[:3, :3].T + j_from_i[:3, 3]
            at = camera.project(points)
            inside = ((at > -0.5) & (at < np.array([39.5, 29.5]))).all(-1)
            column, row = (np.floor(np.clip(at[..., n], 0, (39, 29)[n]) + 0.5).astype(int) for n in (0, 1))
            there = maps[j][row, column]
            alike = np.abs(1 / np.maximum(there, 1e-6) - points[..., 2]) < 0.1 * points[..., 2]
            expected += inside & alike & (there > 0) & (maps[i] > 0)
        assert (count[i] == expected).mean() > 0.97  # at the rims of holes and patches a mean of four may differ
    right = (count[0] == 2) & (maps[0] > 0)
    np.testing.assert_allclose(merged[0][right], maps[0][right], rtol=2e-3)
    assert not count[1, 5:9, 5:9].any() and not count[2, 23:, 33:].any()


def test_normals_of_a_plane() -> None:
    maps, camera, _ = two_walls()
    rays = camera.rays(camera.pixel_grid())
    found = normals_cam(maps[0], rays)[4:-4, 4:-4]
    expected = -np.array([0.2, -0.1, 1.0]) / np.linalg.norm([0.2, -0.1, 1.0])
    np.testing.assert_allclose(found, np.broadcast_to(expected, found.shape), atol=1e-3)


def test_integration_is_the_weighted_mean_of_truncated_distances() -> None:
    maps, camera, poses = two_walls()
    blocks = np.array([[0, 0, 3], [-1, 0, 4]], np.int64)
    voxel, truncation = 0.0613, 0.25
    weights = np.random.default_rng(0).integers(1, 6, maps.shape).astype(np.uint8)
    cam_from_world = np.stack([inverse(p)[:3] for p in poses])
    value, weight = np.empty((2, *(SIDE,) * 3), np.float32), np.empty((2, *(SIDE,) * 3), np.float32)
    integrate(0, 2, blocks, voxel, truncation, 0.3, maps, weights, pinhole(camera), cam_from_world, value, weight)
    place = np.stack(np.meshgrid(*(np.arange(SIDE),) * 3, indexing="ij"), -1)
    points = (blocks[:, None, None, None] * SIDE + place) * voxel
    total, by = np.zeros(value.shape), np.zeros(value.shape)
    for n in range(3):
        at = points @ cam_from_world[n, :, :3].T + cam_from_world[n, :, 3]
        px = camera.project(np.where(at[..., 2:] > 1e-6, at, 1.0))
        inside = ((px > -0.5) & (px < [39.5, 29.5])).all(-1) & (at[..., 2] > 1e-6)
        column, row = (np.clip(np.floor(px[..., k] + 0.5).astype(int), 0, (39, 29)[k]) for k in (0, 1))
        distance = (1 / np.maximum(maps[n][row, column], 1e-9) - at[..., 2]) / truncation
        own = weights[n][row, column] * (inside & (maps[n][row, column] > 0) & (distance >= -1))
        own = own * np.where(distance > 1, 0.3, 1)
        total, by = total + own * np.minimum(distance, 1), by + own
    np.testing.assert_allclose(weight, by, rtol=1e-6)
    np.testing.assert_allclose(value, np.where(by > 0, total / np.maximum(by, 1e-9), 1), atol=1e-5)


@pytest.fixture(scope="module")
def ball() -> tuple[Array, Array]:
    """The surface net of a ball of 9.3 voxels about (2, 1, 0)."""
    blocks = np.stack(np.meshgrid(*(np.arange(-3, 3),) * 3, indexing="ij"), -1).reshape(-1, 3)
    place = np.stack(np.meshgrid(*(np.arange(SIDE),) * 3, indexing="ij"), -1)
    points = blocks[:, None, None, None] * SIDE + place - np.array([2.0, 1.0, 0.0])
    value = ((np.linalg.norm(points, axis=-1) - 9.3) / 4).astype(np.float32)
    return surface_net(blocks, value, np.ones_like(value), 0.5)


def test_the_surface_net_of_a_ball_is_closed_and_faces_outward(ball: tuple[Array, Array]) -> None:
    vertices, faces = ball
    away = vertices - np.array([2.0, 1.0, 0.0])
    np.testing.assert_allclose(np.linalg.norm(away, axis=1), 9.3, atol=0.2)
    edges = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])
    assert len(np.unique(edges, axis=0)) == len(edges)  # each once in this direction
    assert {tuple(e) for e in edges} == {tuple(e) for e in edges[:, ::-1]}  # and once in the other
    a, b, c = (vertices[faces[:, n]] for n in range(3))
    outward = (np.cross(b - a, c - a) * (a + b + c - 3 * np.array([2.0, 1.0, 0.0]))).sum(1)
    assert (outward > 0).mean() > 0.999


def test_the_surface_net_is_as_large_as_marching_cubes_say(ball: tuple[Array, Array]) -> None:
    measure = pytest.importorskip("skimage.measure")
    grid = np.stack(np.meshgrid(*(np.arange(-24, 24),) * 3, indexing="ij"), -1) - np.array([2.0, 1.0, 0.0])
    vertices, faces, *_ = measure.marching_cubes(np.linalg.norm(grid, axis=-1) - 9.3, 0)
    area = measure.mesh_surface_area(vertices, faces)
    assert abs(measure.mesh_surface_area(*ball) / area - 1) < 0.03
