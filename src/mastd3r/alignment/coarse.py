"""Coarse stage, eq. (5)-(8): a robust pose from static points."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from ..geometry.se3 import inverse, transform
from ..geometry.sim3 import procrustes
from .reproject import StaticMatches, solve_pose

Array = NDArray[Any]
COARSE_MATCHES = 500  # that a coarse pose in the image is found from


@dataclass(frozen=True)
class IcpReport:
    """How an iterative-closest-point run ended."""

    new_from_ref: Array  # (4, 4)
    converged: bool
    inlier_ratio: float


def icp(points_ref: Array, points_new: Array, weight: Array, new_from_ref: Array, *, iterations: int = 30) -> IcpReport:
    """Point-to-point ICP on SE(3), eq. (8), started from matches row by row.

    Args: points_ref, points_new (n, 3) matched, each in its own camera; weight (n,).
    Alternates nearest neighbours (new against moved ref, replaced by the given match where that is as near)
    with the closed form; weights fall as 1/(1 + (distance / s)²), s = 2 x the median distance relative to depth.
    """
    used = weight > 0
    if used.sum() < 6:
        return IcpReport(new_from_ref, False, 0.0)
    a, b, w = points_ref[used], points_new[used], weight[used]
    tree = cKDTree(b)
    pose, converged, inlier_ratio = new_from_ref, False, 0.0
    pair = np.arange(len(a))
    for _ in range(iterations):
        moved = transform(pose, a)
        distance = np.linalg.norm(moved - b[pair], axis=1) / np.maximum(b[pair, 2], 1e-9)
        scale = max(2.0 * float(np.median(distance)), 1e-4)
        robust = w / (1 + (distance / scale) ** 2)
        fit = procrustes(b[pair], a, robust).rigid
        inlier_ratio = float((distance < 0.05).mean())
        change = float(np.abs(fit @ inverse(pose) - np.eye(4)).max())
        pose = fit
        moved = transform(pose, a)
        nearest_distance, nearest = tree.query(moved)
        own_distance = np.linalg.norm(moved - b, axis=1)
        pair = np.where(own_distance <= 1.5 * nearest_distance + 0.01 * moved[:, 2], np.arange(len(a)), nearest)
        if change < 1e-5:
            converged = True
            break
    return IcpReport(pose, converged, inlier_ratio)


def resect(matches: StaticMatches, guess: Array) -> IcpReport:
    """The coarse pose where the new view measures no depth: matches against ref's points, wide robust kernel.

    A provider without own depth has no X^t to run eq. (8) on; the same static points are aligned in the image.
    Kernel 8 px, then 3 px. A part of the matches is enough to come near.
    """
    some = matches.thinned(COARSE_MATCHES)
    wide = solve_pose(some, guess, kernel_px=8.0, iterations=15)
    near = solve_pose(some, wide.new_from_ref, kernel_px=3.0, iterations=10)
    inlier_ratio, _ = matches.quality(near.new_from_ref)
    return IcpReport(near.new_from_ref, near.converged, inlier_ratio)
