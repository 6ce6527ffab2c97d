"""Planes of a scene are found in few points, and bare pixels are given to the one that they lie on."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from mastd3r.camera.pinhole import Camera
from mastd3r.mvs.depth_maps import halved, pinhole, relative, with_plane
from mastd3r.mvs.plane_kernels import count_near, evidence
from mastd3r.mvs.plane_labels import Swept, plane_inv_depth, plane_labels
from mastd3r.mvs.planes import Planes, found_planes
from mastd3r.mvs.sweep import SweepImage
from mastd3r.mvs.views import Neighbourhood

Array = NDArray[Any]
CAMERA = Camera.centred(60.0, 80, 60)
RAYS = CAMERA.rays(CAMERA.pixel_grid())
FLOOR, FRONT, WALL = (0.0, 1.0, 0.0, 0.6), (0.0, 0.0, 1.0, 2.0), (0.0, 0.0, 1.0, 3.0)  # n . X = d, y is down
SEEN_AT_M = 2.0


def test_a_point_is_on_a_plane_within_its_own_sigma_and_with_its_normal() -> None:
    rng = np.random.default_rng(0)
    points, normals = rng.normal(size=(300, 3)), rng.normal(size=(300, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    normals[::3] = 0
    sigma = rng.uniform(0, 0.6, 300)
    planes = np.concatenate([normals[1:8:3], rng.normal(size=(3, 1))], 1)
    out = np.empty(3, np.int64)
    count_near(points, normals, sigma, planes, 0.7, out)
    near = np.abs(planes[:, :3] @ points.T - planes[:, 3:]) < sigma
    alike = (np.abs(planes[:, :3] @ normals.T) > 0.7) | ~normals.any(1)
    np.testing.assert_array_equal(out, (near & alike).sum(1))
    assert 0 < out.min() < 300


def on(plane: tuple[float, ...], centre: list[float], count: int, rng: np.random.Generator) -> Array:
    """Points spread over a metre and a half of a plane about a centre."""
    normal, offset, noise = np.array(plane[:3]), plane[3], 0.004
    points = centre + rng.uniform(-0.75, 0.75, (count, 3))
    points -= (points @ normal - offset - rng.normal(size=count) * noise)[:, None] * normal
    return points


@pytest.fixture(scope="module")
def planes() -> Planes:
    """Of a textured floor and wall, a front of which three rows of points are seen, and clutter."""
    rng = np.random.default_rng(1)
    rows = on(FRONT, [0, 0, 2], 600, rng)
    rows[:, 0] = np.repeat([-0.6, 0.05, 0.7], 200) + rng.normal(size=600) * 0.004
    clutter = rng.uniform([-0.7, -0.7, 1.2], [0.7, 0.0, 1.8], (4000, 3))
    points = np.concatenate([on(FLOOR, [0, 0, 1.3], 6000, rng), on(WALL, [0, -1.2, 3], 6000, rng), rows, clutter])
    return found_planes(points, np.full(len(points), SEEN_AT_M), SEEN_AT_M)


def number_of(plane: tuple[float, ...], planes: Planes) -> int:
    """The one plane found that is this one."""
    sign = np.sign(planes.equations[:, :3] @ plane[:3])[:, None]
    alike = (np.abs(planes.equations * sign - plane) < [0.03, 0.03, 0.03, 0.02]).all(1)
    assert alike.sum() == 1, planes.equations
    return int(np.argmax(alike))


def test_planes_are_found_even_those_of_which_rows_are_seen_alone(planes: Planes) -> None:
    assert {number_of(FLOOR, planes), number_of(WALL, planes)} == {0, 1}
    number_of(FRONT, planes)
    assert len(planes.equations) <= 6  # clutter is no plane


def test_support_is_near_the_points_of_a_plane(planes: Planes) -> None:
    n = number_of(FRONT, planes)
    for point, least, most in (((0.05, 0.1, 2.0), 0, 1.5), ((0.4, 0.0, 2.0), 3, 8), ((1.5, 0, 2), 9, 99)):
        i, j = (planes.axes[n] @ np.append(point, 1.0)).astype(int)
        assert least <= planes.grids[n, j, i] <= most


def test_no_points_have_no_planes() -> None:
    none = found_planes(np.zeros((0, 3)), np.zeros(0), 1.0)
    assert none.equations.shape == (0, 4) and none.slopes(np.eye(4)).shape == (0, 3)
    assert not len(found_planes(np.random.default_rng(0).normal(size=(30, 3)), np.ones(30), 1.0).equations)


def places() -> Array:
    poses = np.tile(np.eye(4), (3, 1, 1))
    poses[1, 0, 3], poses[2, 1, 3] = 0.2, -0.15
    return poses


def maps_of(planes: list[tuple[float, ...]], poses: Array) -> Array:
    """(V, h, w) inverse depth of the nearest plane."""
    out = []
    for pose in poses:
        rho = [RAYS @ np.array(p[:3]) / (p[3] - np.array(p[:3]) @ pose[:3, 3]) for p in planes]
        out.append(np.max(rho, 0))
    return np.array(out, np.float32)


def test_evidence_is_distance_from_support_and_what_is_seen_through(planes: Planes) -> None:
    poses = places()
    sure = maps_of([FLOOR, WALL], poses)  # no view sees the front
    sure[1, :20] = 0
    others, from_ref, _ = relative(poses, 0, Neighbourhood((1, 2), (0.1, 1.0)))
    slopes = planes.slopes(poses[0])
    out = np.empty((60, 80, len(slopes)), np.float32)
    k = pinhole(CAMERA)
    evidence(slopes, RAYS, planes.axes @ poses[0], planes.grids, sure, others, k, from_ref, 0.01, 14.0, out)
    for n in (number_of(p, planes) for p in (FLOOR, FRONT, WALL)):
        rho = RAYS @ slopes[n]
        points = RAYS / np.maximum(rho, 1e-9)[..., None]
        cell = np.floor(points @ planes.axes[n, :, :3].T + planes.axes[n, :, 3]).astype(int)
        inside = (rho > 1e-9) & ((cell >= 0) & (cell < planes.grids.shape[1])).all(-1)
        i, j = np.where(inside, cell[..., 0], 0), np.where(inside, cell[..., 1], 0)
        away = planes.grids[n][j, i] / 14.0
        votes = np.zeros(rho.shape)
        for o, move in zip(others, from_ref, strict=True):
            there = points @ move[:, :3].T + move[:, 3]
            px = CAMERA.project(np.where(there[..., 2:] > 1e-6, there, 1.0))
            seen = (px > -0.5).all(-1) & (px < [79.5, 59.5]).all(-1) & (there[..., 2] > 1e-6)
            column, row = (np.clip(np.floor(px[..., a] + 0.5).astype(int), 0, (79, 59)[a]) for a in (0, 1))
            depth = np.where(sure[o][row, column] > 0, 1 / np.maximum(sure[o][row, column], 1e-9), 0) * seen
            ratio = depth / np.maximum(there[..., 2], 1e-9)
            votes += 1.0 * (ratio > 1.02) - ((ratio > 0.99) & (ratio <= 1.02))
        expected = np.where(inside & (away <= 1), away + np.maximum(votes, 0), 9)
        assert (np.abs(out[..., n] - expected) < 1e-3).mean() > 0.97  # between pixels depth is a mean of four
    assert np.median(out[20:28, 30:50, number_of(FRONT, planes)]) > 1.5  # both look through it


def test_bare_pixels_are_given_to_the_plane_that_they_lie_on(planes: Planes) -> None:
    poses = places()
    truth = maps_of([FLOOR, FRONT], poses)
    rng = np.random.default_rng(2)
    images, clear = [], np.zeros(truth.shape, np.float32)
    floor = RAYS[..., 1] / FLOOR[3] >= truth[0] - 1e-6
    clear[:, 45:] = 1  # the floor has texture, of the front three rows have
    for x in (16, 41, 64):
        clear[:, :, x] = 1
    for pose in poses:
        gray = np.where(floor, 90 + 30 * rng.random((60, 80)), 60).astype(np.float32)
        images.append(SweepImage(gray, np.ones((60, 80), np.uint8), CAMERA.matrix, pose))
    wrong = np.where(clear > 0, truth, 0.9 * truth).astype(np.float32)
    swept = Swept(images, wrong, clear, np.zeros_like(clear), np.where(clear > 0, truth, 0).astype(np.float32))
    others, from_ref, _ = relative(poses, 0, Neighbourhood((1, 2), (0.1, 1.0)))
    labels = plane_labels(swept, 0, others, planes, RAYS, pinhole(CAMERA), from_ref, 0.015)
    front, rows = labels == number_of(FRONT, planes) + 1, slice(26, 46)
    assert front[rows, 18:64].mean() > 0.9
    assert (labels[50:, 20:60] == number_of(FLOOR, planes) + 1).mean() > 0.95
    found = plane_inv_depth(labels, planes.slopes(poses[0]), RAYS)
    known = found[rows, 18:64] > 0
    assert known.mean() > 0.9
    assert np.median(np.abs(found[rows, 18:64] / truth[0, rows, 18:64] - 1)[known]) < 0.01
    nobody = plane_labels(swept, 0, others[:0], planes, RAYS, pinhole(CAMERA), from_ref[:0], 0.015)
    assert not nobody.any()


def test_a_plane_takes_the_place_of_what_is_neither_clear_nor_on_it() -> None:
    swept, weight = np.array([[1.0, 1.0, 1.0, 1.0]]), np.array([[0.9, 0.1, 0.1, 0.4]])
    data, by, measured = with_plane(swept, weight, np.array([[2.0, 2.0, 0.0, 1.001]]))
    np.testing.assert_allclose(data, [[1, 2, 1, 1]])
    np.testing.assert_allclose(by, [[0.9, 0.3, 0.1, 0.4]])
    np.testing.assert_array_equal(measured, [[True, False, True, True]])


def test_of_four_pixels_the_surest_stays() -> None:
    rng = np.random.default_rng(3)
    by, a = rng.random((2, 6, 9)), rng.random((2, 6, 9))
    out = halved(by, a)[0]
    assert out.shape == (2, 3, 4)
    for v, y, x in np.ndindex(out.shape):
        block = np.s_[v, 2 * y : 2 * y + 2, 2 * x : 2 * x + 2]
        assert out[v, y, x] == a[block].ravel()[by[block].argmax()]
