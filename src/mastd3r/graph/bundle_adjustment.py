"""Joint optimisation of keyframe poses, inverse depths and intrinsics from flow matches (docs/joint_optimisation.md).

Levenberg-Marquardt; depths are eliminated by the Schur complement, host by host, so the dense system that is solved
has 6 rows a keyframe and 6 for the lens.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..concurrency import on_two_threads
from ..geometry.least_squares import damped_solve
from ..geometry.reprojection_kernels import N_COLS, N_GLOBAL, anchor_columns, anchor_cost, anchor_system
from ..geometry.se3 import adjoint, inverse, se3_exp
from .factors import Factors, ReprojectionFactor, Variables
from .intrinsics import Intrinsics

Array = NDArray[Any]
AT_INFINITY = 1e-6  # of a host's typical inverse depth: that of a point further away than infinity once all is solved
STEP_AT_INFINITY = 0.1  # of the same: as far as one step moves a point there, on either side


@dataclass(frozen=True)
class SolveReport:
    """How a joint optimisation ended."""

    iterations: int
    converged: bool
    cost_first: float
    cost_last: float
    focal_sigma_ratio: float  # 1-sigma of log f under unit pixel noise, inf where f is fixed


@dataclass
class _AnchorTerm:
    """What one host contributes in one iteration, kept for the back-substitution."""

    columns: Array  # global column of each local column, -1 = fixed
    cross: Array  # (p, n) E
    hdd: Array
    bd: Array


def solve(
    variables: Variables,
    edges: Sequence[ReprojectionFactor],
    lens: Intrinsics,
    *,
    fixed: frozenset[int],
    iterations: int,
    kernel_px: float = 1.0,
    tolerance: float = 1e-4,
) -> SolveReport:
    """Optimise in place. Poses in ``fixed`` stay; every host's depths and the free intrinsics move.

    Stops when the relative decrease of the robust cost is below ``tolerance``. A singular system or an
    exhausted damping ends the loop with ``converged=False``. Meanwhile inverse depths may fall below 0: noise moves
    points at infinity to both sides, and where they may go to one only, the lens makes up for it, or no step is good.
    """
    by_anchor: Factors = {}
    for edge in edges:
        by_anchor.setdefault(edge.i, []).append(edge)
    moving = [k for k in variables if k not in fixed]
    row_of = {k: 6 * n for n, k in enumerate(moving)}
    damping, cost_first, cost, done, converged = 1e-4, -1.0, -1.0, 0, False
    sigma = float("inf")
    for done in range(1, iterations + 1):
        hess, rhs, anchors, cost = _linearise(variables, by_anchor, lens, row_of, kernel_px)
        cost_first = cost if cost_first < 0 else cost_first
        accepted = False
        for _ in range(6):
            step = damped_solve(hess, rhs, damping)
            if step is None:
                damping *= 10
                continue
            saved = _apply(variables, lens, anchors, row_of, step)
            trial = _cost(variables, by_anchor, lens, kernel_px)
            if trial <= cost * (1 + 1e-9):
                accepted = True
                break
            _restore(variables, lens, saved)
            damping *= 10
        if not accepted:
            break
        damping = max(damping * 0.2, 1e-7)
        sigma = _focal_sigma(hess, lens)
        if cost - trial < tolerance * max(cost, 1e-12):
            converged, cost = True, trial
            break
        cost = trial
    if by_anchor and len(fixed) == 1:
        _face_scene(variables, by_anchor, min(fixed))
    for i in by_anchor:
        depth = variables[i].inv_depth
        variables[i].inv_depth = np.maximum(depth, AT_INFINITY * _typical(depth))
    return SolveReport(done, converged, cost_first, cost, sigma)


def _face_scene(variables: Variables, by_anchor: Factors, still: int) -> None:
    """Where most points ended behind their cameras: inverse depths and translations, all negated, project the same."""
    if np.median(np.concatenate([variables[i].inv_depth for i in by_anchor])) >= 0:
        return
    still_from_world = variables[still].cam_from_world
    world_from_still = inverse(still_from_world)
    for block in variables.values():
        pose = block.cam_from_world @ world_from_still
        pose[:3, 3] *= -1
        block.cam_from_world = pose @ still_from_world
    for i in by_anchor:
        variables[i].inv_depth = -variables[i].inv_depth


def _typical(inv_depth: Array) -> float:
    return float(np.abs(inv_depth).mean())


def _gather(variables: Variables, edges: list[ReprojectionFactor]) -> tuple[Array, Array, Array]:
    anchor_from_world = variables[edges[0].i].cam_from_world
    world_from_anchor = inverse(anchor_from_world)
    j_from_i = np.stack([variables[e.j].cam_from_world @ world_from_anchor for e in edges])
    return np.stack([e.target for e in edges]), np.stack([e.weight for e in edges]), j_from_i


def _linearise(
    variables: Variables,
    by_anchor: Factors,
    lens: Intrinsics,
    row_of: dict[int, int],
    kernel_px: float,
) -> tuple[Array, Array, dict[int, _AnchorTerm], float]:
    size = 6 * len(row_of) + N_GLOBAL
    hess, rhs = np.zeros((size, size)), np.zeros(size)
    anchors: dict[int, _AnchorTerm] = {}
    total = _prior_cost(variables, by_anchor, lens)
    lens_cols = np.where(lens.free, np.arange(size - N_GLOBAL, size), -1)

    def one(i: int) -> tuple[_AnchorTerm, Array, Array, float]:
        return _anchor_part(variables, by_anchor[i], lens, row_of, lens_cols, kernel_px)

    for i, (anchor, whole_h, whole_b, cost) in zip(by_anchor, on_two_threads(one, list(by_anchor)), strict=True):
        total += cost
        anchors[i] = anchor
        # here and not beside: BLAS has threads of its own, and may split a product by what else is asked of it
        scaled = anchor.cross / anchor.hdd[:, None]
        local_h = whole_h - scaled.T @ anchor.cross
        local_b = whole_b - scaled.T @ anchor.bd
        keep = anchor.columns >= 0
        rows = anchor.columns[keep]
        np.add.at(hess, (rows[:, None], rows[None, :]), local_h[np.ix_(keep, keep)])
        np.add.at(rhs, rows, local_b[keep])
    free = np.flatnonzero(lens.free)
    rows = size - N_GLOBAL + free
    hess[rows, rows] += lens.prior_info[free]
    rhs[rows] += lens.prior_info[free] * (lens.prior[free] - lens.values[free])
    return hess, rhs, anchors, total


def _anchor_part(
    variables: Variables,
    edges: list[ReprojectionFactor],
    lens: Intrinsics,
    row_of: dict[int, int],
    lens_cols: Array,
    kernel_px: float,
) -> tuple[_AnchorTerm, Array, Array, float]:
    """One host: what its depths are eliminated with, its part of the system before that, its cost."""
    i = edges[0].i
    block = variables[i]
    target, weight, j_from_i = _gather(variables, edges)
    h, b, e, hdd, bd, cost = anchor_system(block.px, block.inv_depth, target, weight, j_from_i, lens.values, kernel_px)
    block.depth_info = hdd.sum(0)
    hdd_i = block.depth_info + block.prior_info + 1e-9
    bd_i = bd.sum(0) + block.prior_info * (block.prior_depth - block.inv_depth)
    local_h, local_b, cross = _anchor_local(h, b, e, j_from_i)
    columns = np.concatenate([_pose_columns(i, row_of)] + [_pose_columns(x.j, row_of) for x in edges] + [lens_cols])
    return _AnchorTerm(columns, cross, hdd_i, bd_i), local_h, local_b, float(cost.sum())


def _pose_columns(k: int, row_of: dict[int, int]) -> Array:
    row = row_of.get(k)
    return np.full(6, -1) if row is None else np.arange(row, row + 6)


def _anchor_local(h: Array, b: Array, e: Array, j_from_i: Array) -> tuple[Array, Array, Array]:
    """Rewrite per-edge parts in the columns [pose i, pose j1 … jm, lens]: J_i = -J_j Ad(j_from_i)."""
    m, n = len(h), 6 + 6 * len(h) + N_GLOBAL
    hess, rhs, to_local = np.zeros((n, n)), np.zeros(n), np.zeros((m, N_COLS, 6 + N_COLS))
    to_local[:, :, 6:] = np.eye(N_COLS)
    for k in range(m):
        to_local[k, :6, :6] = -adjoint(j_from_i[k])
        part = to_local[k].T @ h[k] @ to_local[k]
        at = np.r_[0:6, 6 + 6 * k : 12 + 6 * k, n - N_GLOBAL : n]
        hess[np.ix_(at, at)] += part
        rhs[at] += to_local[k].T @ b[k]
    return hess, rhs, anchor_columns(e, np.ascontiguousarray(to_local[:, :6, :6]))


def _focal_sigma(hess: Array, lens: Intrinsics) -> float:
    if not lens.free[0]:
        return float("inf")
    unit = np.zeros(len(hess))
    unit[-N_GLOBAL] = 1.0
    column = damped_solve(hess, unit, 1e-9)
    return float("inf") if column is None or column[-N_GLOBAL] <= 0 else float(np.sqrt(column[-N_GLOBAL]))


def _apply(
    variables: Variables,
    lens: Intrinsics,
    anchors: dict[int, _AnchorTerm],
    row_of: dict[int, int],
    step: Array,
) -> tuple[Array, dict[int, tuple[Array, Array]]]:
    saved = (lens.values.copy(), {k: (b.cam_from_world, b.inv_depth) for k, b in variables.items()})
    for k, row in row_of.items():
        variables[k].cam_from_world = se3_exp(step[row : row + 6]) @ variables[k].cam_from_world
    lens.values = lens.values + step[-N_GLOBAL:]
    for i, anchor in anchors.items():
        local = np.where(anchor.columns >= 0, step[anchor.columns], 0.0)
        delta = (anchor.bd - anchor.cross @ local) / anchor.hdd
        depth = variables[i].inv_depth
        least = STEP_AT_INFINITY * _typical(depth)
        variables[i].inv_depth = depth + np.clip(delta, -np.maximum(0.75 * depth, least), 3.0 * np.abs(depth) + least)
    return saved


def _restore(variables: Variables, lens: Intrinsics, saved: tuple[Array, dict[int, tuple[Array, Array]]]) -> None:
    lens.values = saved[0]
    for k, (pose, depth) in saved[1].items():
        variables[k].cam_from_world, variables[k].inv_depth = pose, depth


def _prior_cost(variables: Variables, by_anchor: Factors, lens: Intrinsics) -> float:
    free = lens.free
    total = float((lens.prior_info[free] * (lens.values - lens.prior)[free] ** 2).sum())
    for i in by_anchor:
        b = variables[i]
        total += float((b.prior_info * (b.inv_depth - b.prior_depth) ** 2).sum())
    return total


def _cost(
    variables: Variables,
    by_anchor: Factors,
    lens: Intrinsics,
    kernel_px: float,
) -> float:
    def one(i: int) -> float:
        target, weight, j_from_i = _gather(variables, by_anchor[i])
        block = variables[i]
        return float(anchor_cost(block.px, block.inv_depth, target, weight, j_from_i, lens.values, kernel_px).sum())

    return _prior_cost(variables, by_anchor, lens) + sum(on_two_threads(one, list(by_anchor)))
