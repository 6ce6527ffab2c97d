"""Joint optimisation of keyframe poses, inverse depths and intrinsics from flow matches (docs/joint_optimisation.md).

Levenberg-Marquardt; depths are eliminated by the Schur complement, host by host, so the dense system that is solved
has 6 rows a keyframe and 6 for the lens.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..geometry.gauss_newton import damped_solve
from ..geometry.reprojection import N_COLS, N_GLOBAL, host_columns, host_cost, host_system
from ..geometry.se3 import adjoint, inverse, se3_exp
from .two_threads import on_two_threads

Array = NDArray[Any]
AT_INFINITY = 1e-6  # of a host's typical inverse depth: that of a point further away than infinity once all is solved
STEP_AT_INFINITY = 0.1  # of the same: as far as one step moves a point there, on either side


@dataclass
class Edge:
    """Matches of host i's grid pixels in keyframe j."""

    i: int
    j: int
    target: Array  # (p, 2) float64 pixels in j
    weight: Array  # (p,) float64, 0 = no match


@dataclass
class Lens:
    """Shared intrinsics g = (log f, k, cx, cy, m, n) at the working resolution, with a Gaussian prior on each."""

    g: Array  # (6,)
    prior: Array  # (6,)
    prior_info: Array  # (6,) 1/variance in px^-2 units; inf = fixed

    @property
    def free(self) -> Array:
        """(6,) bool, which intrinsics are estimated."""
        return np.isfinite(self.prior_info)


@dataclass
class Block:
    """One keyframe in the problem."""

    px: Array  # (p, 2)
    inv_depth: Array  # (p,)
    prior_depth: Array  # (p,)
    prior_info: Array  # (p,) information of prior_depth
    cam_from_world: Array  # (4, 4)
    depth_info: Array = field(default_factory=lambda: np.zeros(0))  # (p,) H_dd of the last solve


@dataclass(frozen=True)
class SolveReport:
    """How a joint optimisation ended."""

    iterations: int
    converged: bool
    cost_first: float
    cost_last: float
    focal_sigma_ratio: float  # 1-sigma of log f under unit pixel noise, inf where f is fixed


@dataclass
class _Host:
    """What one host contributes in one iteration, kept for the back-substitution."""

    columns: Array  # global column of each local column, -1 = fixed
    cross: Array  # (p, n) E
    hdd: Array
    bd: Array


def solve(
    blocks: dict[int, Block],
    edges: Sequence[Edge],
    lens: Lens,
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
    by_host: dict[int, list[Edge]] = {}
    for edge in edges:
        by_host.setdefault(edge.i, []).append(edge)
    moving = [k for k in blocks if k not in fixed]
    row_of = {k: 6 * n for n, k in enumerate(moving)}
    damping, cost_first, cost, done, converged = 1e-4, -1.0, -1.0, 0, False
    sigma = float("inf")
    for done in range(1, iterations + 1):
        hess, rhs, hosts, cost = _linearise(blocks, by_host, lens, row_of, kernel_px)
        cost_first = cost if cost_first < 0 else cost_first
        accepted = False
        for _ in range(6):
            step = damped_solve(hess, rhs, damping)
            if step is None:
                damping *= 10
                continue
            saved = _apply(blocks, lens, hosts, row_of, step)
            trial = _cost(blocks, by_host, lens, kernel_px)
            if trial <= cost * (1 + 1e-9):
                accepted = True
                break
            _restore(blocks, lens, saved)
            damping *= 10
        if not accepted:
            break
        damping = max(damping * 0.2, 1e-7)
        sigma = _focal_sigma(hess, lens)
        if cost - trial < tolerance * max(cost, 1e-12):
            converged, cost = True, trial
            break
        cost = trial
    if by_host and len(fixed) == 1:
        _face_scene(blocks, by_host, min(fixed))
    for i in by_host:
        depth = blocks[i].inv_depth
        blocks[i].inv_depth = np.maximum(depth, AT_INFINITY * _typical(depth))
    return SolveReport(done, converged, cost_first, cost, sigma)


def _face_scene(blocks: dict[int, Block], by_host: dict[int, list[Edge]], still: int) -> None:
    """Where most points ended behind their cameras: inverse depths and translations, all negated, project the same."""
    if np.median(np.concatenate([blocks[i].inv_depth for i in by_host])) >= 0:
        return
    still_from_world = blocks[still].cam_from_world
    world_from_still = inverse(still_from_world)
    for block in blocks.values():
        pose = block.cam_from_world @ world_from_still
        pose[:3, 3] *= -1
        block.cam_from_world = pose @ still_from_world
    for i in by_host:
        blocks[i].inv_depth = -blocks[i].inv_depth


def _typical(inv_depth: Array) -> float:
    return float(np.abs(inv_depth).mean())


def _gather(blocks: dict[int, Block], edges: list[Edge]) -> tuple[Array, Array, Array]:
    host_from_world = blocks[edges[0].i].cam_from_world
    world_from_host = inverse(host_from_world)
    j_from_i = np.stack([blocks[e.j].cam_from_world @ world_from_host for e in edges])
    return np.stack([e.target for e in edges]), np.stack([e.weight for e in edges]), j_from_i


def _linearise(
    blocks: dict[int, Block],
    by_host: dict[int, list[Edge]],
    lens: Lens,
    row_of: dict[int, int],
    kernel_px: float,
) -> tuple[Array, Array, dict[int, _Host], float]:
    size = 6 * len(row_of) + N_GLOBAL
    hess, rhs = np.zeros((size, size)), np.zeros(size)
    hosts: dict[int, _Host] = {}
    total = _prior_cost(blocks, by_host, lens)
    lens_cols = np.where(lens.free, np.arange(size - N_GLOBAL, size), -1)

    def one(i: int) -> tuple[_Host, Array, Array, float]:
        return _host_part(blocks, by_host[i], lens, row_of, lens_cols, kernel_px)

    for i, (host, whole_h, whole_b, cost) in zip(by_host, on_two_threads(one, list(by_host)), strict=True):
        total += cost
        hosts[i] = host
        # here and not beside: BLAS has threads of its own, and may split a product by what else is asked of it
        scaled = host.cross / host.hdd[:, None]
        local_h = whole_h - scaled.T @ host.cross
        local_b = whole_b - scaled.T @ host.bd
        keep = host.columns >= 0
        rows = host.columns[keep]
        np.add.at(hess, (rows[:, None], rows[None, :]), local_h[np.ix_(keep, keep)])
        np.add.at(rhs, rows, local_b[keep])
    free = np.flatnonzero(lens.free)
    rows = size - N_GLOBAL + free
    hess[rows, rows] += lens.prior_info[free]
    rhs[rows] += lens.prior_info[free] * (lens.prior[free] - lens.g[free])
    return hess, rhs, hosts, total


def _host_part(
    blocks: dict[int, Block], edges: list[Edge], lens: Lens, row_of: dict[int, int], lens_cols: Array, kernel_px: float
) -> tuple[_Host, Array, Array, float]:
    """One host: what its depths are eliminated with, its part of the system before that, its cost."""
    i = edges[0].i
    block = blocks[i]
    target, weight, j_from_i = _gather(blocks, edges)
    h, b, e, hdd, bd, cost = host_system(block.px, block.inv_depth, target, weight, j_from_i, lens.g, kernel_px)
    block.depth_info = hdd.sum(0)
    hdd_i = block.depth_info + block.prior_info + 1e-9
    bd_i = bd.sum(0) + block.prior_info * (block.prior_depth - block.inv_depth)
    local_h, local_b, cross = _host_local(h, b, e, j_from_i)
    columns = np.concatenate([_pose_columns(i, row_of)] + [_pose_columns(x.j, row_of) for x in edges] + [lens_cols])
    return _Host(columns, cross, hdd_i, bd_i), local_h, local_b, float(cost.sum())


def _pose_columns(k: int, row_of: dict[int, int]) -> Array:
    row = row_of.get(k)
    return np.full(6, -1) if row is None else np.arange(row, row + 6)


def _host_local(h: Array, b: Array, e: Array, j_from_i: Array) -> tuple[Array, Array, Array]:
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
    return hess, rhs, host_columns(e, np.ascontiguousarray(to_local[:, :6, :6]))


def _focal_sigma(hess: Array, lens: Lens) -> float:
    if not lens.free[0]:
        return float("inf")
    unit = np.zeros(len(hess))
    unit[-N_GLOBAL] = 1.0
    column = damped_solve(hess, unit, 1e-9)
    return float("inf") if column is None or column[-N_GLOBAL] <= 0 else float(np.sqrt(column[-N_GLOBAL]))


def _apply(
    blocks: dict[int, Block], lens: Lens, hosts: dict[int, _Host], row_of: dict[int, int], step: Array
) -> tuple[Array, dict[int, tuple[Array, Array]]]:
    saved = (lens.g.copy(), {k: (b.cam_from_world, b.inv_depth) for k, b in blocks.items()})
    for k, row in row_of.items():
        blocks[k].cam_from_world = se3_exp(step[row : row + 6]) @ blocks[k].cam_from_world
    lens.g = lens.g + step[-N_GLOBAL:]
    for i, host in hosts.items():
        local = np.where(host.columns >= 0, step[host.columns], 0.0)
        delta = (host.bd - host.cross @ local) / host.hdd
        depth = blocks[i].inv_depth
        least = STEP_AT_INFINITY * _typical(depth)
        blocks[i].inv_depth = depth + np.clip(delta, -np.maximum(0.75 * depth, least), 3.0 * np.abs(depth) + least)
    return saved


def _restore(blocks: dict[int, Block], lens: Lens, saved: tuple[Array, dict[int, tuple[Array, Array]]]) -> None:
    lens.g = saved[0]
    for k, (pose, depth) in saved[1].items():
        blocks[k].cam_from_world, blocks[k].inv_depth = pose, depth


def _prior_cost(blocks: dict[int, Block], by_host: dict[int, list[Edge]], lens: Lens) -> float:
    free = lens.free
    total = float((lens.prior_info[free] * (lens.g - lens.prior)[free] ** 2).sum())
    for i in by_host:
        b = blocks[i]
        total += float((b.prior_info * (b.inv_depth - b.prior_depth) ** 2).sum())
    return total


def _cost(blocks: dict[int, Block], by_host: dict[int, list[Edge]], lens: Lens, kernel_px: float) -> float:
    def one(i: int) -> float:
        target, weight, j_from_i = _gather(blocks, by_host[i])
        block = blocks[i]
        return float(host_cost(block.px, block.inv_depth, target, weight, j_from_i, lens.g, kernel_px).sum())

    return _prior_cost(blocks, by_host, lens) + sum(on_two_threads(one, list(by_host)))
