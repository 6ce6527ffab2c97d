"""Joint optimisation of keyframe poses, inverse depths and intrinsics from flow matches (docs/joint_optimisation.md).

Levenberg-Marquardt; depths are eliminated by the Schur complement, one anchor keyframe after another, so the system
that is solved has 6 rows a keyframe and 6 for the intrinsics: dense, or of a long video sparse (normal_equations.py).
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..concurrency import give_back_memory, on_two_threads
from ..geometry.least_squares import Damping, damped_solve, levenberg_marquardt
from ..geometry.reprojection_kernels import N_GLOBAL, AnchorMatches, anchor_cost, anchor_system
from ..geometry.schur_kernels import depth_steps, eliminate, local_system
from ..geometry.se3 import adjoint, inverse, se3_exp
from .factors import Factors, ReprojectionFactor, Variables
from .intrinsics import Intrinsics
from .normal_equations import DENSE_MOST, BlockPattern, DenseEquations, SparseEquations, unknowns
from .steady_speed import SteadySpeed

Array = NDArray[Any]
AT_INFINITY = 1e-6  # of an anchor's typical inverse depth: that of a point beyond infinity once all is solved
STEP_AT_INFINITY = 0.1  # of the same: as far as one step moves a point there, on either side
AT_ONCE = 64  # anchor keyframes whose parts of the system are held together
DAMPING = Damping(least=1e-7, most=0.0, tries=6)  # a cost is cheap beside a system: one system serves six tries


@dataclass(frozen=True)
class SolveReport:
    """How a joint optimisation ended."""

    iterations: int
    converged: bool
    cost_first: float
    cost_last: float
    focal_sigma_ratio: float  # 1-sigma of log f under unit pixel noise, inf where f is fixed
    lens_covariance: Array | None = None  # (6, 6) of the lens under unit pixel noise, 0 for what is fixed


def solve(
    variables: Variables,
    edges: Sequence[ReprojectionFactor],
    intrinsics: Intrinsics,
    *,
    fixed: frozenset[int],
    iterations: int,
    kernel_px: float = 1.0,
    tolerance: float = 1e-4,
    speed: SteadySpeed | None = None,
) -> SolveReport:
    """Optimise in place. Poses in ``fixed`` stay; every anchor keyframe's depths and the free intrinsics move.

    Stops when the relative decrease of the robust cost is below ``tolerance``. A singular system or an
    exhausted damping ends the loop with ``converged=False``. Meanwhile inverse depths may fall below 0: noise moves
    points at infinity to both sides, and where they may go to one only, the lens makes up for it, or no step is good.
    ``speed``: what is asked of keyframes in a row.
    """
    problem = _Problem(variables, edges, intrinsics, fixed, kernel_px, speed)
    poses = {k: v.cam_from_world for k, v in variables.items()}
    start = _Estimate(problem, poses, {k: v.inv_depth for k, v in variables.items()}, intrinsics.values)
    found = levenberg_marquardt(start, DAMPING, iterations=iterations, tolerance=tolerance)
    end, anchors = found.estimate, list(problem.by_anchor)
    poses, depths = end.poses, end.depths
    if anchors and len(fixed) == 1:
        poses, depths = _facing_scene(end, anchors, min(fixed))
    for k, v in variables.items():
        v.cam_from_world, v.inv_depth = poses[k], depths[k]
    for i in anchors:
        v = variables[i]
        v.inv_depth = np.maximum(v.inv_depth, AT_INFINITY * _typical(v.inv_depth))
    for i, term in problem.terms.items():
        variables[i].depth_info = term.depth_info
    intrinsics.values = end.g
    lens = _lens_covariance(found.hess) if found.hess is not None and intrinsics.free.any() else None
    known = lens is not None and intrinsics.free[0] and lens[0, 0] > 0
    sigma = float(np.sqrt(lens[0, 0])) if lens is not None and known else float("inf")
    return SolveReport(found.iterations, found.converged, found.cost_first, found.cost_last, sigma, lens)


@dataclass
class _AnchorTerm:
    """What one anchor keyframe contributes in one iteration, kept for the back-substitution."""

    blocks: Array  # block of each six local columns, -1 = fixed
    cross: Array | None  # (k, 12) E of its matches; None where it is made once more when it is needed
    to_anchor: Array  # (m, 6, 6)
    hdd: Array
    bd: Array
    depth_info: Array  # (p,) hdd without the prior


class _Problem:
    """What does not change while it is solved; and the parts of the last system, by anchor keyframe."""

    def __init__(
        self,
        variables: Variables,
        edges: Sequence[ReprojectionFactor],
        intrinsics: Intrinsics,
        fixed: frozenset[int],
        kernel_px: float,
        speed: SteadySpeed | None,
    ) -> None:
        self.variables, self.intrinsics, self.kernel_px = variables, intrinsics, kernel_px
        self.by_anchor: Factors = {}
        for edge in edges:
            self.by_anchor.setdefault(edge.i, []).append(edge)
        self.block_of = {k: n for n, k in enumerate(k for k in variables if k not in fixed)}
        self.lens = len(self.block_of)  # the last block
        self.speed = speed if speed is not None and len(speed.ids) else None
        rows = () if self.speed is None else self.speed.ids.tolist()
        self.in_a_row = [np.array([self.block_of.get(k, -1) for k in row]) for row in rows]
        self.terms: dict[int, _AnchorTerm] = {}
        self._matches: dict[int, AnchorMatches] = {}
        self.pattern: BlockPattern | None = None
        if self.lens >= DENSE_MOST:
            groups = [*(self.blocks_of(i) for i in self.by_anchor), *self.in_a_row]
            self.pattern = BlockPattern(self.lens + 1, [g[g >= 0] for g in groups])

    def blocks_of(self, i: int) -> Array:
        """(m + 2,) blocks of an anchor keyframe, of those that it is matched with, and of the lens; -1 = fixed."""
        ends = (self.block_of.get(k, -1) for k in (i, *(edge.j for edge in self.by_anchor[i])))
        return np.array([*ends, self.lens])

    def matches(self, i: int) -> AnchorMatches:
        """Those of an anchor keyframe; of a long video they are not kept, but made whenever they are asked for."""
        found = self._matches.get(i)
        if found is None:
            edges = self.by_anchor[i]
            found = AnchorMatches.of([e.target for e in edges], [e.weight for e in edges])
            if self.pattern is None:
                self._matches[i] = found
        return found

    def parts(self) -> Iterator[list[int]]:
        """The anchor keyframes, some at a time: what they contribute is not held for all of them at once."""
        anchors = list(self.by_anchor)
        return (anchors[n : n + AT_ONCE] for n in range(0, len(anchors), AT_ONCE))


@dataclass(frozen=True)
class _Estimate:
    """Values of all unknowns."""

    problem: _Problem
    poses: dict[int, Array]  # cam_from_world (4, 4) of each keyframe
    depths: dict[int, Array]  # (p,) inverse
    g: Array  # (6,) intrinsics

    def linearised(self) -> tuple[Any, Array, float]:
        """The system without the depths; their terms are left with the problem."""
        problem, intrinsics = self.problem, self.problem.intrinsics
        pattern = problem.pattern
        equations = DenseEquations(problem.lens + 1) if pattern is None else SparseEquations(pattern)
        rhs = np.zeros(6 * (problem.lens + 1))
        total, held = self._prior_cost(), ~intrinsics.free
        for some in problem.parts():
            for i, (term, local_h, local_b, cost) in zip(some, on_two_threads(self._anchor_part, some), strict=True):
                total += cost
                problem.terms[i] = term
                local_h[-N_GLOBAL:][held], local_h[:, -N_GLOBAL:][:, held], local_b[-N_GLOBAL:][held] = 0.0, 0.0, 0.0
                _add(equations, rhs, term.blocks, local_h, local_b)
                if pattern is not None:
                    term.cross = None
        if problem.speed is not None:
            for blocks, part_h, part_b in zip(problem.in_a_row, *problem.speed.system(self.poses), strict=True):
                _add(equations, rhs, blocks, part_h, part_b)
        prior_info = np.where(held, 0.0, intrinsics.prior_info)
        equations.add(np.array([problem.lens]), np.diag(prior_info))
        rhs[-N_GLOBAL:] += prior_info * (intrinsics.prior - self.g)
        if pattern is not None:
            give_back_memory()  # what the parts were made in, before the system is factorised
        return equations.matrix(), rhs, total

    def cost(self) -> float:
        """The robust cost, priors included."""
        problem = self.problem

        def one(i: int) -> float:
            given = problem.variables[i].px, self.depths[i], problem.matches(i), self._j_from_i(i)
            return float(anchor_cost(*given, self.g, problem.kernel_px).sum())

        return self._prior_cost() + sum(on_two_threads(one, list(problem.by_anchor)))

    def moved(self, step: Array) -> _Estimate:
        """The estimate after a step of poses and intrinsics, with the depths that follow from it."""
        poses, depths = dict(self.poses), dict(self.depths)
        of_block = step.reshape(-1, 6)
        for k, block in self.problem.block_of.items():
            poses[k] = se3_exp(of_block[block]) @ self.poses[k]
        for some in self.problem.parts():
            for i, delta in zip(some, on_two_threads(lambda i: self._depth_step(i, of_block), some), strict=True):
                depth = self.depths[i]
                least = STEP_AT_INFINITY * _typical(depth)
                depths[i] = depth + np.clip(delta, -np.maximum(0.75 * depth, least), 3.0 * np.abs(depth) + least)
        return _Estimate(self.problem, poses, depths, self.g + step[-N_GLOBAL:])

    def _depth_step(self, i: int, of_block: Array) -> Array:
        """(p,) of an anchor's depths, from the step (n, 6) of all blocks."""
        term = self.problem.terms[i]
        cross = self._anchor_part(i)[0].cross if term.cross is None else term.cross
        local = np.where(term.blocks[:, None] >= 0, of_block[term.blocks], 0.0).reshape(-1)
        found: Array = depth_steps(local, cross, self.problem.matches(i), term.to_anchor, term.hdd, term.bd)
        return found

    def _j_from_i(self, i: int) -> Array:
        """(m, 4, 4) of an anchor keyframe's edges."""
        world_from_anchor = inverse(self.poses[i])
        return np.stack([self.poses[e.j] @ world_from_anchor for e in self.problem.by_anchor[i]])

    def _anchor_part(self, i: int) -> tuple[_AnchorTerm, Array, Array, float]:
        """What an anchor keyframe's depths are eliminated with, its part of the system without them, its cost."""
        problem, v, depth = self.problem, self.problem.variables[i], self.depths[i]
        matches, j_from_i = problem.matches(i), self._j_from_i(i)
        h, b, cross, depth_info, bd, cost = anchor_system(v.px, depth, matches, j_from_i, self.g, problem.kernel_px)
        hdd = depth_info + v.prior_info + 1e-9
        bd += v.prior_info * (v.prior_depth - depth)
        to_anchor = -np.stack([adjoint(t) for t in j_from_i])  # J_i = -J_j Ad(j_from_i)
        local_h, local_b = local_system(h, b, to_anchor)
        eliminate(local_h, local_b, cross, matches, to_anchor, hdd, bd)
        term = _AnchorTerm(problem.blocks_of(i), cross, to_anchor, hdd, bd, depth_info)
        return term, local_h, local_b, float(cost.sum())

    def _prior_cost(self) -> float:
        variables, intrinsics = self.problem.variables, self.problem.intrinsics
        free = intrinsics.free
        total = float((intrinsics.prior_info[free] * (self.g - intrinsics.prior)[free] ** 2).sum())
        total += 0.0 if self.problem.speed is None else self.problem.speed.cost(self.poses)
        for i in self.problem.by_anchor:
            v = variables[i]
            total += float((v.prior_info * (self.depths[i] - v.prior_depth) ** 2).sum())
        return total


def _add(equations: DenseEquations | SparseEquations, rhs: Array, blocks: Array, part_h: Array, part_b: Array) -> None:
    """Add a part (6 k, 6 k) and (6 k,) of the system, of ``blocks`` (k,); -1 = fixed."""
    moves = blocks >= 0
    keep = np.repeat(moves, 6)
    equations.add(blocks[moves], part_h[np.ix_(keep, keep)])
    np.add.at(rhs, unknowns(blocks[moves]), part_b[keep])


def _facing_scene(end: _Estimate, anchors: list[int], still: int) -> tuple[dict[int, Array], dict[int, Array]]:
    """Poses and depths; where most points ended behind their cameras, inverse depths and translations are negated,
    all of them: they project the same."""
    if np.median(np.concatenate([end.depths[i] for i in anchors])) >= 0:
        return end.poses, end.depths
    still_from_world = end.poses[still]
    world_from_still = inverse(still_from_world)
    poses = {}
    for k, cam_from_world in end.poses.items():
        pose = cam_from_world @ world_from_still
        pose[:3, 3] *= -1
        poses[k] = pose @ still_from_world
    return poses, {**end.depths, **{i: -end.depths[i] for i in anchors}}


def _typical(inv_depth: Array) -> float:
    return float(np.abs(inv_depth).mean())


def _lens_covariance(hess: Any) -> Array | None:
    units = np.zeros((hess.shape[0], N_GLOBAL))
    units[-N_GLOBAL:] = np.eye(N_GLOBAL)
    columns = damped_solve(hess, units, 1e-9)
    return None if columns is None else columns[-N_GLOBAL:]
