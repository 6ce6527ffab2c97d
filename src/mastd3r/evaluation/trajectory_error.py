"""How far an estimated trajectory is from the true one: ATE after Sim(3) alignment, and RPE.

Umeyama, "Least-squares estimation of transformation parameters between two point patterns", PAMI 1991;
Sturm et al., "A benchmark for the evaluation of RGB-D SLAM systems", IROS 2012 (ATE and RPE).
A trajectory that cannot be scored gives a result whose ``reason`` says why; it never gives NaN.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..geometry.sim3 import Sim3
from ..types import Trajectory, Truth

Array = NDArray[Any]
ASSOCIATION_S = 0.02  # a pose and a true pose that are further apart in time are no pair
MIN_POSES = 4  # a Sim(3) has seven degrees of freedom: three points fit far too well to be an error


@dataclass(frozen=True)
class AteResult:
    """Absolute trajectory error in the truth's unit. Where ``reason`` is set, the figures are None."""

    rmse: float | None = None
    mean: float | None = None
    median: float | None = None
    max: float | None = None
    n_associated: int = 0
    scale: float | None = None  # truth's unit per map unit
    truth_from_map: Sim3 | None = None
    rows: Array | None = None  # (n_associated,) rows of the estimate
    times_s: Array | None = None  # (n_associated,) their times
    aligned: Array | None = None  # (n_associated, 3) estimated positions in the truth's frame
    truth: Array | None = None  # (n_associated, 3) true positions
    reason: str | None = None  # why there is no figure

    def truth_in_map(self, n_poses: int) -> Array | None:
        """True positions in the map's frame and units, (n_poses, 3), NaN where a pose has none; for plots."""
        if self.truth_from_map is None or self.truth is None or self.rows is None:
            return None
        if self.truth_from_map.scale <= 0:  # positions that have nothing in common with the true ones
            return None
        placed = np.full((n_poses, 3), np.nan)
        placed[self.rows] = self.truth_from_map.inverse().apply(self.truth)
        return placed

    def table(self) -> Array | None:
        """(n_associated, 7) rows of time [s], aligned estimate and truth in the truth's unit; None without figures."""
        if self.times_s is None or self.aligned is None or self.truth is None:
            return None
        return np.concatenate([self.times_s[:, None], self.aligned, self.truth], 1)


@dataclass(frozen=True)
class RpeResult:
    """Relative pose error over pairs of poses. Where ``reason`` is set, figures are None."""

    translation_rmse: float | None = None  # truth's unit
    translation_mean: float | None = None
    rotation_rmse_rad: float | None = None
    rotation_mean_rad: float | None = None
    n_pairs: int = 0
    reason: str | None = None


def umeyama(source: Array, target: Array, with_scale: bool = True) -> Sim3:
    """Least-squares similarity from paired points, Umeyama eqs. (40)-(42).

    ``source`` and ``target`` are (n, 3), n >= 1, finite. Points on one line leave the turn about that line
    free: one of the equally good answers is given. A source that is a single point gives scale 1.
    """
    source, target = np.asarray(source, float), np.asarray(target, float)
    source_mean, target_mean = source.mean(0), target.mean(0)
    centred = source - source_mean
    u, singular, vt = np.linalg.svd((target - target_mean).T @ centred)
    sign = np.array([1.0, 1.0, np.sign(np.linalg.det(u @ vt))])
    rotation = (u * sign) @ vt
    spread = float((centred**2).sum())
    scale = float(singular @ sign) / spread if with_scale and spread > 0 else 1.0
    return Sim3(rotation, target_mean - scale * rotation @ source_mean, scale)


def associate(times_s: Array, truth_s: Array, tolerance_s: float) -> tuple[Array, Array]:
    """For each time the nearest true time, where it is within the tolerance.

    Times are (n,) and (m,) seconds in any order. Gives rows of ``times_s`` and of ``truth_s``, each (k,).
    """
    if len(times_s) == 0 or len(truth_s) == 0:
        return np.zeros(0, int), np.zeros(0, int)
    order = np.argsort(truth_s, kind="stable")
    ordered = np.asarray(truth_s, float)[order]
    after = np.clip(np.searchsorted(ordered, times_s), 0, len(ordered) - 1)
    before = np.maximum(after - 1, 0)
    earlier = np.abs(ordered[before] - times_s) <= np.abs(ordered[after] - times_s)
    near = np.where(earlier, before, after)
    rows = np.flatnonzero(np.abs(ordered[near] - times_s) <= tolerance_s)
    return rows, order[near[rows]]


def ate_of_positions(
    times_s: Array, positions: Array, truth_s: Array, truth_positions: Array, tolerance_s: float = ASSOCIATION_S
) -> AteResult:
    """ATE of (n, 3) positions against (m, 3) true positions after Sim(3) alignment; see ``ate_rmse``."""
    rows, truth_rows = associate(times_s, truth_s, tolerance_s)
    estimate = np.asarray(positions, float).reshape(-1, 3)[rows]
    truth = np.asarray(truth_positions, float).reshape(-1, 3)[truth_rows]
    reason = _why_not(estimate, truth, tolerance_s)
    if reason:
        return AteResult(n_associated=len(rows), reason=reason)
    truth_from_map = umeyama(estimate, truth)
    aligned = truth_from_map.apply(estimate)
    error = np.linalg.norm(truth - aligned, axis=1)
    return AteResult(
        rmse=float(np.sqrt((error**2).mean())),
        mean=float(error.mean()),
        median=float(np.median(error)),
        max=float(error.max()),
        n_associated=len(rows),
        scale=truth_from_map.scale,
        truth_from_map=truth_from_map,
        rows=rows,
        times_s=np.asarray(times_s, float)[rows],
        aligned=aligned,
        truth=truth,
    )


def ate_rmse(estimate: Trajectory, truth: Truth, tolerance_s: float = ASSOCIATION_S) -> AteResult:
    """Absolute trajectory error after Sim(3) alignment, in the truth's unit.

    Each pose is paired with the nearest true pose within ``tolerance_s``. Fewer than four pairs, a camera
    that never moves or a pose that is not finite gives a result with ``reason`` and no figures.
    """
    return ate_of_positions(
        estimate.timestamps_s,
        estimate.world_from_cam[:, :3, 3],
        truth.timestamps_s,
        truth.world_from_cam[:, :3, 3],
        tolerance_s,
    )


def rpe(estimate: Trajectory, truth: Truth, delta: int = 1, tolerance_s: float = ASSOCIATION_S) -> RpeResult:
    """Relative pose error over all pairs of associated poses ``delta`` rows apart.

    The estimate takes the scale of the Sim(3) alignment first. With true motion Q and estimated motion P
    between the two poses, the error is inv(Q) @ P: its translation's length, its rotation's angle.
    """
    if delta < 1:
        return RpeResult(reason=f"expected a delta of 1 frame or more, got {delta}")
    poses, true_poses, reason = _associated(estimate, truth, tolerance_s)
    if reason:
        return RpeResult(reason=reason)
    if len(poses) <= delta:
        return RpeResult(reason=f"expected more than {delta} associated poses, got {len(poses)}")
    first = np.arange(len(poses) - delta)
    return _rpe_of_pairs(poses, true_poses, first, first + delta)


def rpe_over_distance(
    estimate: Trajectory, truth: Truth, distance: float, tolerance_s: float = ASSOCIATION_S, slack_ratio: float = 0.1
) -> RpeResult:
    """Relative pose error over pairs that lie ``distance`` (truth's unit) apart along the TRUE path.

    Each pose is paired with the later one whose path length from it is nearest to ``distance``; pairs off by more
    than ``slack_ratio`` of it are left out. Otherwise as ``rpe``; the error is that over the whole distance.
    """
    if not distance > 0:
        return RpeResult(reason=f"expected a distance above 0, got {distance:g}")
    poses, true_poses, reason = _associated(estimate, truth, tolerance_s)
    if reason:
        return RpeResult(reason=reason)
    path = _path_length(true_poses)
    first, second = _pairs_along(path, distance, slack_ratio)
    if not len(first):
        return RpeResult(reason=f"expected poses {distance:g} apart along a true path of {path[-1]:.3g}, got none")
    return _rpe_of_pairs(poses, true_poses, first, second)


def drift_distance(estimate: Trajectory, truth: Truth, tolerance_s: float = ASSOCIATION_S) -> float:
    """The distance to measure drift over, in the truth's unit: 1, 10 or 100.

    The smallest that is at least five median steps of the true path, so that pairs within a tenth of it exist
    (a car makes a metre a frame); 1 where nothing is known.
    """
    _, true_poses, reason = _associated(estimate, truth, tolerance_s)
    if reason:
        return 1.0
    step = float(np.median(np.diff(_path_length(true_poses))))
    return next((d for d in (1.0, 10.0) if d >= 5 * step), 100.0)


def _associated(estimate: Trajectory, truth: Truth, tolerance_s: float) -> tuple[Array, Array, str | None]:
    """Paired poses (k, 4, 4), the estimated ones in the truth's unit; or the reason why there are none."""
    nothing = np.zeros((0, 4, 4))
    ate = ate_rmse(estimate, truth, tolerance_s)
    if ate.reason or ate.scale is None:
        return nothing, nothing, ate.reason or "expected a scale, got none"
    rows, truth_rows = associate(estimate.timestamps_s, truth.timestamps_s, tolerance_s)
    poses, true_poses = estimate.world_from_cam[rows].astype(float), truth.world_from_cam[truth_rows]
    if not (np.isfinite(poses).all() and np.isfinite(true_poses).all()):
        return nothing, nothing, "expected finite poses, got a rotation that is not"
    poses[:, :3, 3] *= ate.scale
    return poses, true_poses, None


def _path_length(poses: Array) -> Array:
    """(k,) length of the path from the first pose on."""
    steps = np.linalg.norm(np.diff(poses[:, :3, 3], axis=0), axis=1)
    return np.concatenate([[0.0], np.cumsum(steps)])


def _pairs_along(path: Array, distance: float, slack_ratio: float) -> tuple[Array, Array]:
    """Rows (i, j), j > i, of which j lies nearest to ``distance`` after i, within the slack."""
    wanted, first = path[:-1] + distance, np.arange(len(path) - 1)
    after = np.clip(np.searchsorted(path, wanted), 1, len(path) - 1)
    ends = np.stack([after - 1, after])
    ends = np.maximum(np.searchsorted(path, path[ends]), first + 1)  # where the camera rests: the first pose there
    nearer = np.abs(path[ends[0]] - wanted) <= np.abs(path[ends[1]] - wanted)
    second = np.where(nearer, ends[0], ends[1])
    near = np.abs(path[second] - wanted) <= slack_ratio * distance
    return first[near], second[near]


def _rpe_of_pairs(poses: Array, true_poses: Array, first: Array, second: Array) -> RpeResult:
    moved = np.linalg.inv(poses[first]) @ poses[second]
    truly_moved = np.linalg.inv(true_poses[first]) @ true_poses[second]
    error = np.linalg.inv(truly_moved) @ moved
    length = np.linalg.norm(error[:, :3, 3], axis=1)
    angle = rotation_angle_rad(error[:, :3, :3])
    return RpeResult(
        translation_rmse=float(np.sqrt((length**2).mean())),
        translation_mean=float(length.mean()),
        rotation_rmse_rad=float(np.sqrt((angle**2).mean())),
        rotation_mean_rad=float(angle.mean()),
        n_pairs=len(length),
    )


def rotation_angle_rad(rotation: Array) -> Array:
    """(..., 3, 3) rotations to (...) angles in 0..pi; exact near 0, where arccos of the trace is not."""
    r = rotation
    axis = np.stack([r[..., 2, 1] - r[..., 1, 2], r[..., 0, 2] - r[..., 2, 0], r[..., 1, 0] - r[..., 0, 1]], -1)
    return np.asarray(np.arctan2(np.linalg.norm(axis, axis=-1), np.trace(r, axis1=-2, axis2=-1) - 1))


def _why_not(estimate: Array, truth: Array, tolerance_s: float) -> str | None:
    """The reason why paired positions cannot be scored, or None."""
    if len(estimate) < MIN_POSES:
        near = f"within {tolerance_s * 1000:g} ms of truth"
        return f"expected {MIN_POSES} or more poses {near}, got {len(estimate)}"
    if not np.isfinite(estimate).all():
        bad = int((~np.isfinite(estimate).all(1)).sum())
        return f"expected finite positions, got {bad} of {len(estimate)} that are not"
    if not np.isfinite(truth).all():
        return "expected finite true positions, got some that are not"
    if np.ptp(estimate, 0).max() == 0:
        return f"the estimated camera never moves over {len(estimate)} poses: no scale to align"
    if np.ptp(truth, 0).max() == 0:
        return f"the true camera never moves over {len(truth)} poses: no scale to align"
    return None
