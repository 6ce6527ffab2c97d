"""Re-mapping residuals of a pair under a pose, and the pose that makes them small."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..geometry.least_squares import Damping, levenberg_marquardt
from ..geometry.reprojection_kernels import MIN_DEPTH, edge_residuals, pose_system
from ..geometry.se3 import se3_exp
from ..types import USABLE_WEIGHT

Array = NDArray[Any]
EXACT = 1e12  # information of an inverse depth that is not in doubt


@dataclass(frozen=True)
class StaticMatches:
    """Matches of a pair with the weight of eq. (5)(6): P(static) of both ends times the match's own weight."""

    px: Array  # (p, 2) in ref
    inv_depth: Array  # (p,) in ref
    depth_info: Array  # (p,) 1/variance of it, unit pixel noise
    target: Array  # (p, 2) in new
    weight: Array  # (p,)
    intrinsics: Array  # (6,) log f, k, cx, cy, m, n

    @property
    def count(self) -> int:
        """Matches that say something."""
        return int((self.weight > USABLE_WEIGHT).sum())

    def thinned(self, most: int) -> StaticMatches:
        """At most so many of the matches that say something, evenly from all over ref."""
        used = np.flatnonzero(self.weight > USABLE_WEIGHT)
        if len(used) <= most:
            return self
        some = used[np.linspace(0, len(used) - 1, most).astype(int)]
        return replace(
            self,
            px=self.px[some],
            inv_depth=self.inv_depth[some],
            depth_info=self.depth_info[some],
            target=self.target[some],
            weight=self.weight[some],
        )

    def as_known(self) -> StaticMatches:
        """The same, every depth taken as exact."""
        return replace(self, depth_info=np.full(len(self.px), EXACT))

    def system(self, new_from_ref: Array, kernel_px: float) -> tuple[Array, Array, float]:
        """Normal equations (6, 6), (6,) of a pose, and its robust cost, each depth marginalised."""
        args = (self.px, self.inv_depth, self.depth_info, self.target, self.weight)
        found: tuple[Array, Array, float] = pose_system(*args, new_from_ref, self.intrinsics, kernel_px)
        return found

    def residual_px(self, new_from_ref: Array) -> Array:
        """(p,) norm of the re-mapping residual; 1e3 behind the camera."""
        r, z = edge_residuals(self.px, self.inv_depth, self.target, new_from_ref, self.intrinsics)
        return np.where(z < MIN_DEPTH, 1e3, np.hypot(r[:, 0], r[:, 1]))

    def quality(self, new_from_ref: Array) -> tuple[float, float]:
        """(inlier ratio, median residual in px) over the weighted matches.

        A depth that is not known yet is free: only the residual across the epipolar line counts then.
        """
        used = self.weight > USABLE_WEIGHT
        if not used.any():
            return 0.0, float("inf")
        r, z = edge_residuals(self.px, self.inv_depth, self.target, new_from_ref, self.intrinsics)
        r_far, _ = edge_residuals(self.px, self.inv_depth * 1.02 + 1e-4, self.target, new_from_ref, self.intrinsics)
        along = (r_far - r) / (0.02 * self.inv_depth + 1e-4)[:, None]
        share = 1.0 / (self.depth_info + (along**2).sum(1) + 1e-12)
        squared = (r**2).sum(1) - (r * along).sum(1) ** 2 * share
        error = np.where(z < MIN_DEPTH, 1e3, np.sqrt(np.maximum(squared, 0.0)))[used]
        return float((error < 2.0).mean()), float(np.median(error))


@dataclass(frozen=True)
class PoseReport:
    """A pose from re-mapping residuals."""

    new_from_ref: Array  # (4, 4)
    converged: bool


@dataclass(frozen=True)
class _Pose:
    """A pose as the solver's estimate; the kernel gives the cost with the system."""

    matches: StaticMatches
    kernel_px: float
    new_from_ref: Array

    @cached_property
    def _system(self) -> tuple[Array, Array, float]:
        return self.matches.system(self.new_from_ref, self.kernel_px)

    def linearised(self) -> tuple[Array, Array, float]:
        return self._system

    def cost(self) -> float:
        return self._system[2]

    def moved(self, step: Array) -> _Pose:
        return _Pose(self.matches, self.kernel_px, se3_exp(step) @ self.new_from_ref)


def solve_pose(matches: StaticMatches, new_from_ref: Array, *, kernel_px: float, iterations: int = 20) -> PoseReport:
    """Levenberg-Marquardt on SE(3); each depth is marginalised under its own information, so that a point
    without depth still fixes rotation and the direction across its epipolar line."""
    start = _Pose(matches, kernel_px, new_from_ref)
    found = levenberg_marquardt(start, Damping(), iterations=iterations, tolerance=1e-5)
    return PoseReport(found.estimate.new_from_ref, found.converged)
