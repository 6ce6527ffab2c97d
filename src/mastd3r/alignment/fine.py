"""Fine stage, eq. (11)(12): re-mapping residual, point-to-point residual and bidirectional Chamfer, by LM on Sim(3)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from ..geometry.least_squares import damped_solve
from ..geometry.point_kernels import point_system
from ..geometry.reprojection_kernels import pose_system
from ..geometry.se3 import se3_exp, transform
from .reproject import PoseReport, StaticMatches

Array = NDArray[Any]
STALE_SIGMA = 0.1  # a nearest neighbour is believed to stay the nearest until points moved by this share of a sigma


@dataclass(frozen=True)
class OwnPoints:
    """Both clouds at the matched pixels; new's are in new's camera, before the scale."""

    ref: Array  # (p, 3) in ref's camera
    new: Array  # (p, 3) in new's camera
    weight: Array  # (p,)
    sigma_ratio: float  # 1-sigma of a point relative to its depth


def point_terms(moved: Array, own: Array, weight: Array, sigma: Array) -> tuple[Array, Array, float]:
    """(7, 7), (7,) and cost of |own - moved|²/sigma² with a Cauchy kernel of 2 sigma.

    Tangent: left perturbation of new_from_ref (translation, rotation), log-scale of ``own``. ``own`` holds the
    scaled points, so d own / d log s = own. Residual r = own - moved, J = d(moved - own).
    """
    found: tuple[Array, Array, float] = point_system(
        *(np.ascontiguousarray(v, float) for v in (moved, own, weight, sigma))
    )
    return found


def chamfer_pairs(moved: Array, own: Array) -> tuple[Array, Array]:
    """Indices (rows of moved, rows of own) of both directions' nearest neighbours: the bidirectional E_cham."""
    forward = cKDTree(own).query(moved)[1]
    backward = cKDTree(moved).query(own)[1]
    return np.r_[np.arange(len(moved)), backward], np.r_[forward, np.arange(len(own))]


class _Neighbours:
    """The pairs of E_cham, searched again where a point has moved by ``STALE_SIGMA`` of its own sigma since."""

    def __init__(self) -> None:
        self._moved: Array | None = None
        self._own = np.zeros(0)
        self._pairs = (np.zeros(0, int), np.zeros(0, int))

    def of(self, moved: Array, own: Array, sigma: Array) -> tuple[Array, Array]:
        """Pairs of two clouds (n, 3), row by row those of the last call, but a little moved."""
        if self._moved is not None:
            away = np.abs(moved - self._moved).max(1) + np.abs(own - self._own).max(1)
            if (away < STALE_SIGMA * sigma).all():
                return self._pairs
        self._moved, self._own, self._pairs = moved, own, chamfer_pairs(moved, own)
        return self._pairs


def align_fine(
    matches: StaticMatches,
    own: OwnPoints | None,
    new_from_ref: Array,
    scale: float,
    *,
    chamfer_weight: float,
    kernel_px: float = 1.5,
    iterations: int = 20,
    as_printed: bool = False,
) -> tuple[PoseReport, float]:
    """Minimise eq. (12), with the plus sign that print lost; returns the pose and new's scale.

    Without own points the sum is the re-mapping term alone, on SE(3). ``as_printed``: where there are own points,
    the sum is theirs alone, and the scale stays as the stage before left it: T of eq. (11) is in SE(3).
    """
    pose, damping, converged, done = new_from_ref, 1e-4, False, 0
    log_scale = float(np.log(scale))
    near = _Neighbours()
    fixed = (kernel_px, near, as_printed)
    state = _system(matches, own, pose, log_scale, chamfer_weight, *fixed)
    for done in range(1, iterations + 1):
        step = damped_solve(state[0], state[1], damping)
        if step is None or damping > 1e4:
            break
        trial_pose, trial_log = se3_exp(step[:6]) @ pose, log_scale + float(step[6])
        trial = _system(matches, own, trial_pose, trial_log, chamfer_weight, *fixed)
        if trial[2] > state[2] * (1 + 1e-9):
            damping *= 10
            continue
        damping = max(damping * 0.2, 1e-8)
        converged = state[2] - trial[2] < 1e-5 * max(state[2], 1e-12)
        pose, log_scale, state = trial_pose, trial_log, trial
        if converged:
            break
    return PoseReport(pose, state[0][:6, :6], done, converged), float(np.exp(log_scale))


def _system(
    matches: StaticMatches,
    own: OwnPoints | None,
    pose: Array,
    log_scale: float,
    chamfer_weight: float,
    kernel_px: float,
    near: _Neighbours,
    as_printed: bool,
) -> tuple[Array, Array, float]:
    hess, rhs, cost = np.zeros((7, 7)), np.zeros(7), 0.0
    if own is None or not as_printed:
        hess[:6, :6], rhs[:6], cost = pose_system(
            matches.px,
            matches.inv_depth,
            matches.depth_info,
            matches.target,
            matches.weight,
            pose,
            matches.lens,
            kernel_px,
        )
    if own is None:
        return hess, rhs, cost
    used = own.weight > 0.05
    moved, scaled, w = transform(pose, own.ref[used]), np.exp(log_scale) * own.new[used], own.weight[used]
    sigma = own.sigma_ratio * np.maximum(scaled[:, 2], 1e-6)
    parts = [point_terms(moved, scaled, w, sigma)]
    if chamfer_weight > 0 and used.sum() > 10:
        i, j = near.of(moved, scaled, sigma)
        parts.append(point_terms(moved[i], scaled[j], chamfer_weight * np.minimum(w[i], w[j]), sigma[j]))
    for h, b, c in parts:
        hess, rhs, cost = hess + h, rhs + b, cost + c
    if as_printed:
        hess[6], hess[:, 6], rhs[6] = 0.0, 0.0, 0.0
        hess[6, 6] = 1.0
    return hess, rhs, cost
