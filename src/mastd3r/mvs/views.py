"""Keyframes as stereo views, and which of them are compared: by common points and the angle between their rays."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..camera.pinhole import Camera
from ..geometry.se3 import inverse

Array = NDArray[Any]
BEST_ANGLE_DEG = 8.0  # between the rays of two views that see a point: less tells little depth, more looks different
ANGLE_SIGMA_DEG = (5.0, 12.0)  # how fast a pair loses worth below and above it
BEHIND_RATIO = 1.2  # a point that lies so much behind the nearest one of its cell is hidden
CELLS = 24  # cells across an image, for that
MIN_SCORE = 0.02  # a source that shares less with a view says nothing
MIN_POINTS = 20  # fewer points in view tell no range of depths
RANGE_PERCENTILES = (1.0, 99.0)  # of the inverse depths of the points in view
RANGE_MARGIN_RATIO = (0.7, 1.4)  # how far beyond them depth is looked for


@dataclass(frozen=True)
class StereoView:
    """A keyframe as a pinhole image of known place."""

    timestamp_s: float
    color: Array  # (h, w, 3) uint8 RGB
    static: Array  # (h, w) bool: has data, and does not move
    world_from_cam: Array  # (4, 4) float64
    camera: Camera  # at (h, w), without radial terms


@dataclass(frozen=True)
class Neighbourhood:
    """What a view is compared with, and between which inverse depths."""

    sources: tuple[int, ...]  # numbers of views, the best first; empty: nothing sees what this view sees
    inv_depth_range: tuple[float, float]  # far, near; in 1 / map units


def neighbourhoods(views: list[StereoView], points_world: Array, most: int) -> list[Neighbourhood]:
    """For every view the ``most`` best sources and the range of its inverse depths, by known points (n, 3).

    A source is worth to a visible point what the angle between both rays is (as view selection of MVSNet, Yao et al.,
    ECCV 2018, section 4.1); sources are taken one by one, a point that others serve counting less, so that together
    they see all of the view.
    """
    points = np.asarray(points_world, float)
    seen = [visible(view, points) for view in views]
    centres = [view.world_from_cam[:3, 3] for view in views]
    out = []
    for i, view in enumerate(views):
        rows = np.flatnonzero(seen[i])
        if len(rows) < MIN_POINTS:
            out.append(Neighbourhood((), (0.0, 0.0)))
            continue
        here = _directions(points[rows], centres[i])
        worth = np.zeros((len(views), len(rows)))
        for j in range(len(views)):
            common = seen[j][rows]
            if j != i and common.any():
                cos = (here[common] * _directions(points[rows[common]], centres[j])).sum(1)
                worth[j, common] = angle_worth(np.degrees(np.arccos(np.clip(cos, -1, 1))))
        best = _covering(worth, most)
        depth = points[rows] @ inverse(view.world_from_cam)[2, :3] + inverse(view.world_from_cam)[2, 3]
        far, near = np.percentile(1 / depth, RANGE_PERCENTILES) * RANGE_MARGIN_RATIO
        out.append(Neighbourhood(tuple(best), (float(far), float(near))))
    return out


def _covering(worth: Array, most: int) -> list[int]:
    """Rows of ``worth`` (views, points), one after the other the one that adds most to what the points have by then."""
    best: list[int] = []
    has = np.zeros(worth.shape[1])
    while len(best) < most:
        gain = (worth / (1 + 2 * has)).mean(1)
        gain[best] = 0
        j = int(np.argmax(gain))
        if gain[j] < MIN_SCORE:
            break
        best.append(j)
        has += worth[j]
    return best


def angle_worth(angle_deg: Array) -> Array:
    """0..1: what a point seen under this angle between two rays says of depth."""
    sigma = np.where(angle_deg < BEST_ANGLE_DEG, *ANGLE_SIGMA_DEG)
    return np.asarray(np.exp(-((angle_deg - BEST_ANGLE_DEG) ** 2) / (2 * sigma**2)))


def visible(view: StereoView, points_world: Array) -> Array:
    """(n,) bool: in the image, and not far behind another point of the same cell."""
    camera = view.camera
    cam_from_world = inverse(view.world_from_cam)
    points = points_world @ cam_from_world[:3, :3].T + cam_from_world[:3, 3]
    front = points[:, 2] > 1e-9
    px = camera.project(np.where(front[:, None], points, [0, 0, 1.0]))
    inside = front & (px > -0.5).all(1) & (px < np.array([camera.width, camera.height]) - 0.5).all(1)
    cell = np.floor((px + 0.5) * (CELLS / camera.width)).astype(int)
    number = np.where(inside, cell[:, 1] * CELLS + cell[:, 0], 0)
    nearest = np.full(int(number.max(initial=0)) + 1, np.inf)
    np.minimum.at(nearest, number[inside], points[inside, 2])
    return inside & (points[:, 2] <= BEHIND_RATIO * nearest[number])


def _directions(points: Array, centre: Array) -> Array:
    away = points - centre
    out: Array = away / np.linalg.norm(away, axis=1, keepdims=True)
    return out
