"""Planes of the scene, found in points that several views see alike: the walls, floors and fronts of a room.

Greedy RANSAC, as the planes of Sinha et al., "Piecewise planar stereo for image-based rendering", ICCV 2009, and
Gallup et al., "Piecewise planar and non-planar stereo for urban scene reconstruction", CVPR 2010.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from .plane_kernels import count_near
from .voxels import surest_of_voxels

Array = NDArray[Any]
SIGMA_RATIO = 0.006  # of its depth, that a point may be off a plane
SPACING_RATIO = 0.012  # of the median depth, between points that planes are found in
MOST_POINTS = 40_000
MOST_PLANES = 14
HYPOTHESES = 500  # a plane, of each kind
NEIGHBOURS = 400  # among which the other two points of a hypothesis are drawn
LEAST_RATIO, LEAST_POINTS = 0.002, 40  # of all points, that a plane must have for itself
REFITS = 3
AROUND = 40  # points that tell whether a point lies on something flat
ROW_RATIO, FLAT_RATIO = 0.08, 0.15  # of their second spread to the first, and of their third to the second
LEAST_COS = 0.85  # between a point's normal and its plane's
WORTH = (1.0, 2.0, 3.0)  # of a point on any plane, on one at right angles to the first, on one parallel to another
GRID = 160  # cells along the map of a plane's support
CELL_RATIO = 0.03  # of the median depth


@dataclass(frozen=True)
class Planes:
    """Planes n . X = d of the world, and where on them points were found."""

    equations: Array  # (P, 4) float64: unit n, d
    axes: Array  # (P, 2, 4): cell along a grid's axis = axis . (X, 1)
    grids: Array  # (P, G, G) float32 distance to the nearest cell with a point, in cells

    def slopes(self, world_from_cam: Array) -> Array:
        """(P, 3): the inverse depth of a plane is slope . ray, for rays with z = 1 of a camera there."""
        normal = self.equations[:, :3] @ world_from_cam[:3, :3]
        away = self.equations[:, 3] - self.equations[:, :3] @ world_from_cam[:3, 3]
        away = np.where(np.abs(away) < 1e-9, 1e-9, away)
        return np.asarray(normal / away[:, None])


def found_planes(points_world: Array, depth: Array, median_depth: float) -> Planes:
    """Planes in points (n, 3) that were seen at a depth (n,)."""
    rows = surest_of_voxels(points_world, -depth, SPACING_RATIO * median_depth)
    rng = np.random.default_rng(0)
    if len(rows) > MOST_POINTS:
        rows = np.sort(rng.choice(rows, MOST_POINTS, replace=False))
    points = points_world[rows].astype(float)
    some = Points(points, _normals(points), SIGMA_RATIO * depth[rows].astype(float), np.ones(len(rows), bool))
    least = max(LEAST_POINTS, int(LEAST_RATIO * len(points)))
    cell = CELL_RATIO * median_depth
    equations: list[Array] = []
    maps = []
    while len(equations) < MOST_PLANES and some.left.sum() >= least:
        plane = _next(some, np.array(equations).reshape(-1, 4)[:, :3], least, rng)
        if plane is None:
            break
        equations.append(plane)
        maps.append(_support(plane, points[_on(plane, some, 1) & some.left], cell))
        some = replace(some, left=some.left & ~_on(plane, some, 2))
    return Planes(
        np.array(equations).reshape(-1, 4),
        np.array([axes for axes, _ in maps]).reshape(-1, 2, 4),
        np.array([grid for _, grid in maps], np.float32).reshape(-1, GRID, GRID),
    )


@dataclass(frozen=True)
class Points:
    """What planes are looked for in."""

    points: Array  # (n, 3)
    normals: Array  # (n, 3), 0 where there is none
    sigma: Array  # (n,)
    left: Array  # (n,) bool: on no plane so far


def _normals(points: Array) -> Array:
    """(n, 3) normals, 0 of points whose neighbours are on no plane or in a row."""
    if len(points) < AROUND:
        return np.zeros_like(points)
    _, near = cKDTree(points).query(points, k=AROUND)
    away = points[near] - points[near].mean(1, keepdims=True)
    spread, directions = np.linalg.eigh(np.einsum("nki,nkj->nij", away, away))
    flat = (spread[:, 1] > ROW_RATIO * spread[:, 2]) & (spread[:, 0] < FLAT_RATIO * spread[:, 1])
    return np.where(flat[:, None], directions[..., 0], 0)


def _on(plane: Array, some: Points, sigmas: float) -> Array:
    """(n,) bool, as ``count_near`` counts them."""
    alike = np.abs(some.normals @ plane[:3])
    near = np.abs(some.points @ plane[:3] - plane[3]) < sigmas * some.sigma
    return near & ((alike > LEAST_COS) | ~some.normals.any(1))


def _next(some: Points, known: Array, least: int, rng: np.random.Generator) -> Array | None:
    """(4,) the plane that most points lie on, of those through three neighbours, of those at right angles to the first
    of the ``known`` (k, 3) through two, and of those parallel to any of them; None where none has ``least`` points.

    The fewer ways a plane may turn, the fewer points speak for it (as Furukawa et al., "Manhattan-world stereo", CVPR
    2009). Points without a normal speak for those alone that may not turn.
    """
    rows = np.flatnonzero(some.left)
    points = some.points[rows]
    first = rng.integers(len(points), size=HYPOTHESES)
    near = np.asarray(cKDTree(points).query(points[first], k=min(NEIGHBOURS, len(points)))[1])
    pick = rng.integers(near.shape[1], size=(2, HYPOTHESES))
    a, b, c = points[first], points[near[np.arange(HYPOTHESES), pick[0]]], points[near[np.arange(HYPOTHESES), pick[1]]]
    kinds: list[tuple[Array, Array | None]] = [(np.cross(b - a, c - a), np.eye(3))]
    if len(known):
        upright = np.cross(np.broadcast_to(known[0], a.shape), b - a)
        kinds += [(upright, np.linalg.svd(known[:1])[2][1:]), (known[rng.integers(len(known), size=len(a))], None)]
    best, score = None, 0.0
    for (across, free), worth in zip(kinds, WORTH, strict=False):
        normal = across / np.maximum(np.linalg.norm(across, axis=1, keepdims=True), 1e-12)
        planes = np.concatenate([normal, (normal * a).sum(1, keepdims=True)], 1)
        plane = planes[int(np.argmax(_votes(planes, some, free is None)))]
        for _ in range(REFITS):
            on = _on(plane, some, 1) & some.left & (some.normals.any(1) | (free is None))
            if on.sum() >= 3:
                plane = _fitted(some.points[on], 1 / some.sigma[on] ** 2, plane[None, :3] if free is None else free)
        found = float(_votes(plane[None], some, free is None)[0])
        if found >= least and found * worth > score:
            best, score = plane, found * worth
    return best


def _votes(planes: Array, some: Points, alone: bool) -> Array:
    """(p,) points left on every plane (p, 4) that have a normal.

    ``alone``: also those that have none, and those on other planes where they are fewer, less what any plane has that
    cuts what lies around: the larger number just before and just behind it, and three times its own 1-sigma.
    """

    def count(planes: Array, own: Array) -> Array:
        out = np.empty(len(planes), np.int64)
        count_near(some.points, some.normals, np.where(own, some.sigma, 0), planes, LEAST_COS, out)
        return out

    if not alone:
        return count(planes, some.left & some.normals.any(1))
    every, aside = np.ones(len(some.left), bool), 2 * np.array([0, 0, 0, np.median(some.sigma)])
    left, found = count(planes, some.left), count(planes, every)
    around = np.maximum(count(planes + aside, every), count(planes - aside, every))
    return np.asarray(np.where(2 * left > found, found - around - 3 * np.sqrt(around), 0))


def _fitted(points: Array, weight: Array, free: Array) -> Array:
    """(4,) the plane of least weighted squares whose normal is made of the rows of ``free`` (m, 3)."""
    mean = (points * weight[:, None]).sum(0) / weight.sum()
    away = (points - mean) @ free.T
    _, vectors = np.linalg.eigh((away * weight[:, None]).T @ away)
    normal = vectors[:, 0] @ free
    return np.append(normal, normal @ mean)


def _support(plane: Array, points: Array, cell: float) -> tuple[Array, Array]:
    """(2, 4) axes of a grid about the points' median, and (G, G) float32 distance to the nearest cell with one."""
    helper = np.eye(3)[int(np.argmin(np.abs(plane[:3])))]
    first = np.cross(plane[:3], helper)
    first /= np.linalg.norm(first)
    directions = np.stack([first, np.cross(plane[:3], first)]) / cell
    shift = GRID / 2 - directions @ np.median(points, axis=0)
    at = np.floor(points @ directions.T + shift).astype(int)
    at = at[((at >= 0) & (at < GRID)).all(1)]
    empty = np.ones((GRID, GRID), np.uint8)
    empty[at[:, 1], at[:, 0]] = 0
    return np.concatenate([directions, shift[:, None]], 1), cv2.distanceTransform(empty, cv2.DIST_L2, 5)
