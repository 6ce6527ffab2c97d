"""Metres from the camera's height over the ground, which is looked for among the static points below it.

Where a keyframe stands, the ground is the plane, nearly level, that most points around it lie in and hardly any below.
Points are taken wherever any frame saw them: of a driving camera those beneath it were seen when they lay ahead.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..errors import InputError
from ..export.formats import evenly
from .estimate import Scale, biweight, jackknifed, scale_of
from .material import Material

Array = NDArray[Any]
WHERE = "--scale camera-height"
REACH = 8.0  # heights around the camera that the ground is looked for in; farther, depths are too uncertain
THICK_RATIO = 0.05  # of the height: points within belong to the plane
LEAST_TILT_RAD, MOST_TILT_RAD = np.radians(8), np.radians(20)  # that the ground may have against the map's level
LEAST_POINTS = 30  # in the plane
LEAST_SHARE = 0.3  # of the points below half the height, in reach
SAME_HEIGHT = 0.15  # of the height: by so much it may differ for the cameras in reach, as one height is what was said
UNEVEN = 0.04  # 1 sigma of what no number of points takes away, as ground is no plane: from the driving sequences
MOST_BELOW = 0.2  # of the plane's points, that lie under it: more, and it is a table
DRAWS, DRAWN_POINTS = 300, 1500
LEAST_FRAMES, MOST_FRAMES = 3, 60
REFITS = 10


@dataclass(frozen=True)
class Ground:
    """The plane under one keyframe."""

    height: float  # of the camera over it, map units
    normal: Array  # (3,) unit, downward
    log_sigma: float  # 1 sigma of log height: what leaving out parts of the plane changes
    points: Array  # (m,) rows of the static points that lie in it


def scale_from_height(metres: float, map_: Material) -> Scale:
    """The camera's height in metres against its height over the ground of the map, over keyframes.

    The sigma holds the spread over keyframes, how sure each plane is (planes of the same points are one witness),
    how uneven ground is, and what the focal length leaves open. Raises InputError where no plane
    has support under three keyframes or more.
    """
    tracks = map_.needed_tracks(WHERE)
    if map_.down_sigma_rad is None:
        raise InputError(f"{WHERE}: expected a map whose +y is down, got a run that was stopped before it was turned")
    keyframes = map_.trajectory.tracked().keyframes()
    tilt = float(np.clip(2 * map_.down_sigma_rad, LEAST_TILT_RAD, MOST_TILT_RAD))
    chosen = evenly(len(keyframes.timestamps_s), MOST_FRAMES)
    points, cameras = tracks.points_world.astype(float), keyframes.world_from_cam[:, :3, 3]
    found = [ground_below(points, cameras, n, tilt) for n in chosen]
    planes = [g for g in found if g is not None]
    logs = np.array([np.log(g.height) for g in planes])
    least = max(LEAST_FRAMES, -(-len(chosen) // 4))
    if len(logs) < least:
        raise InputError(
            f"{WHERE}: expected ground below the camera, a level plane with {LEAST_POINTS} static points in it and "
            f"hardly any below, under {least} or more of {len(chosen)} keyframes, got it under {len(logs)}"
        )
    height, sigma = jackknifed(lambda rows: biweight(logs[rows]), len(logs))
    seen = np.concatenate([g.points for g in planes])
    witnesses = len(np.unique(seen)) / (len(seen) / len(planes))
    of_a_plane = float(np.median([g.log_sigma for g in planes]))
    whole = float(np.linalg.norm([sigma, of_a_plane / np.sqrt(witnesses), UNEVEN, map_.focal_sigma_ratio]))
    return scale_of(float(np.log(metres)) - height, whole, len(logs), "keyframes over level ground", WHERE)


def ground_below(points_world: Array, cameras_world: Array, which: int, tilt_rad: float) -> Ground | None:
    """The ground under one of (k, 3) cameras among (n, 3) points; None where no plane has support.

    It is no steeper than ``tilt_rad`` against the world's level, and all cameras in reach are as high above it.
    """
    offset = points_world - cameras_world[which]
    cameras = cameras_world - cameras_world[which]
    rows = np.flatnonzero(offset[:, 1] > 0)
    below = offset[rows]
    if len(below) < LEAST_POINTS:
        return None
    random = np.random.default_rng(0)
    drawn = below[np.sort(random.choice(len(below), min(len(below), DRAWN_POINTS), replace=False))]
    normals, heights = _hypotheses(drawn, tilt_rad, random)
    along = _parallel(cameras, normals, heights)
    normals, heights = normals[along], heights[along]
    inside, under, _ = _members(drawn, normals, heights)
    score = inside.sum(0) - 2 * under
    if not len(score) or score.max() <= 0:
        return None
    normal, height = normals[score.argmax()], float(heights[score.argmax()])
    for _ in range(REFITS):
        normal, height = _fitted(below[_members(below, normal[None], np.array([height]))[0][:, 0]], normal)
        if not (height > 0 and normal[1] >= np.cos(tilt_rad)):
            return None
    if not _parallel(cameras, normal[None], np.array([height]))[0]:
        return None
    inside, under, candidates = _members(below, normal[None], np.array([height]))
    count = int(inside.sum())
    if count < LEAST_POINTS or count < LEAST_SHARE * candidates[0] or under[0] > MOST_BELOW * count:
        return None
    plane = below[inside[:, 0]]
    return Ground(height, normal, _log_sigma(plane, normal), rows[inside[:, 0]])


def _hypotheses(points: Array, tilt_rad: float, random: np.random.Generator) -> tuple[Array, Array]:
    """Planes through three points each that are level enough: downward normals (k, 3), heights over them (k,).

    The second and third point are no farther from the first than it is far below the camera, twice: far ones are
    rarely of one plane.
    """
    first = points[random.integers(0, len(points), DRAWS)]
    apart = np.linalg.norm(points[None] - first[:, None], axis=2)
    near = (apart > 0) & (apart < 2 * first[:, 1:2])
    second, third = (points[np.where(near, random.random(near.shape), -1).argmax(1)] for _ in range(2))
    normals = np.cross(second - first, third - first)
    length = np.linalg.norm(normals, axis=1)
    good = (near.sum(1) > 1) & (length > 1e-9 * first[:, 1] ** 2)
    normals = normals[good] / length[good, None]
    normals *= np.where(normals[:, 1:2] < 0, -1, 1)
    heights = (normals * first[good]).sum(1)
    level = (normals[:, 1] >= np.cos(tilt_rad)) & (heights > 0)
    return normals[level], heights[level]


def _parallel(cameras: Array, normals: Array, heights: Array) -> Array:
    """(k,) bool of planes: the cameras in reach, at these offsets from the one above, are as high."""
    lower = cameras @ normals.T
    near = (cameras**2).sum(1)[:, None] - lower**2 < (REACH * heights) ** 2
    return np.asarray((~near | (np.abs(lower) < SAME_HEIGHT * heights)).all(0))


def _members(points: Array, normals: Array, heights: Array) -> tuple[Array, Array, Array]:
    """Of k planes: (n, k) bool in the plane; (k,) how many lie under it; (k,) how many could lie in it.

    Those are in reach of the camera, and below half its height.
    """
    depth = points @ normals.T
    near = (points**2).sum(1)[:, None] - depth**2 < (REACH * heights) ** 2
    inside = near & (np.abs(depth - heights) < THICK_RATIO * heights)
    under = near & (depth > (1 + 3 * THICK_RATIO) * heights)
    return inside, under.sum(0), (near & (depth > 0.5 * heights)).sum(0)


def _fitted(plane: Array, normal: Array) -> tuple[Array, float]:
    """Normal and height of the plane that (n, 3) points lie in best; near ones say more, as their depths are surer."""
    if len(plane) < 3:
        return normal, -1.0
    weight = 1 / (plane**2).sum(1)
    weight /= weight.sum()
    mean = weight @ plane
    spread = plane - mean
    _, axes = np.linalg.eigh((spread * weight[:, None]).T @ spread)
    turned = axes[:, 0] * np.sign(axes[:, 0] @ normal)
    return turned, float(turned @ mean)


def _log_sigma(plane: Array, normal: Array) -> float:
    """1 sigma of the log of the height: blocks are strips across the direction that the (n, 3) points extend in."""
    level = plane - (plane @ normal)[:, None] * normal
    _, axes = np.linalg.eigh((level - level.mean(0)).T @ (level - level.mean(0)))
    order = np.argsort(level @ axes[:, 2], kind="stable")

    def log_height(rows: Array) -> float:
        return float(np.log(max(_fitted(plane[order[rows]], normal)[1], 1e-300)))

    return jackknifed(log_height, len(plane))[1]
