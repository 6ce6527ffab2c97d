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
from ..geometry.anchor_matches import AnchorMatches
from ..geometry.least_squares import Damping, damped_solve, levenberg_marquardt
from ..geometry.pose_kernels import moved_poses
from ..geometry.reprojection_kernels import N_GLOBAL
from ..geometry.schur_kernels import anchor_part, anchor_part_cost, moved_depths
from ..geometry.se3 import inverse
from .factors import Factors, ReprojectionFactor, Variables
from .intrinsics import Intrinsics
from .normal_equations import DENSE_MOST, BlockPattern, DenseEquations, SparseEquations
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
    poses = np.stack([v.cam_from_world for v in variables.values()]).astype(float)
    start = _Estimate(problem, poses, {k: v.inv_depth for k, v in variables.items()}, intrinsics.values)
    found = levenberg_marquardt(start, DAMPING, iterations=iterations, tolerance=tolerance)
    end, anchors = found.estimate, list(problem.by_anchor)
    poses, depths = end.poses, end.depths
    if anchors and len(fixed) == 1:
        poses, depths = _facing_scene(end, anchors, problem.row_of[min(fixed)])
    for (k, v), pose in zip(variables.items(), poses, strict=True):
        v.cam_from_world, v.inv_depth = pose.copy(), depths[k]
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
        self.row_of = {k: n for n, k in enumerate(variables)}  # of poses
        free = [k not in fixed for k in variables]
        self.block_of = np.where(free, np.cumsum(free) - 1, -1)  # (q,) of poses, -1 = fixed
        self.lens = sum(free)  # the last block
        self.ends = {i: np.array([self.row_of[k] for k in (i, *(e.j for e in of))]) for i, of in self.by_anchor.items()}
        lens = self.lens if intrinsics.free.any() else -1
        self.blocks = {i: np.append(self.block_of[ends], lens) for i, ends in self.ends.items()}
        self.speed = speed.by_rows(self.row_of) if speed is not None and len(speed.ids) else None
        self.in_a_row = [] if self.speed is None else list(self.block_of[self.speed.ids])
        self.terms: dict[int, _AnchorTerm] = {}
        self._matches: dict[int, AnchorMatches] = {}
        self._priors: dict[int, Array] = {}
        self.pattern: BlockPattern | None = None
        if self.lens >= DENSE_MOST:
            groups = [*self.blocks.values(), *self.in_a_row]
            self.pattern = BlockPattern(self.lens + 1, [g[g >= 0] for g in groups])

    def matches(self, i: int) -> AnchorMatches:
        """Those of an anchor keyframe; of a long video they are not kept, but made whenever they are asked for."""
        found = self._matches.get(i)
        if found is None:
            edges = self.by_anchor[i]
            found = AnchorMatches.of([e.target for e in edges], [e.weight for e in edges])
            if self.pattern is None:
                self._matches[i] = found
        return found

    def prior(self, i: int) -> Array:
        """(2, p) of an anchor keyframe's depths: value and information."""
        found = self._priors.get(i)
        if found is None:
            found = np.stack([self.variables[i].prior_depth, self.variables[i].prior_info])
            if self.pattern is None:
                self._priors[i] = found
        return found

    def parts(self) -> Iterator[list[int]]:
        """The anchor keyframes, some at a time: what they contribute is not held for all of them at once."""
        anchors = list(self.by_anchor)
        return (anchors[n : n + AT_ONCE] for n in range(0, len(anchors), AT_ONCE))


@dataclass(frozen=True)
class _Estimate:
    """Values of all unknowns."""

    problem: _Problem
    poses: Array  # (q, 4, 4) cam_from_world of all keyframes
    depths: dict[int, Array]  # (p,) inverse
    g: Array  # (6,) intrinsics

    def linearised(self) -> tuple[Any, Array, float]:
        """The system without the depths; their terms are left with the problem."""
        problem, intrinsics = self.problem, self.problem.intrinsics
        pattern = problem.pattern
        equations = DenseEquations(problem.lens + 1) if pattern is None else SparseEquations(pattern)
        total, held = self._prior_cost(), ~intrinsics.free
        for some in problem.parts():
            for i, (term, local_h, local_b, cost) in zip(some, on_two_threads(self._anchor_part, some), strict=True):
                total += cost
                problem.terms[i] = term
                local_h[-N_GLOBAL:][held], local_h[:, -N_GLOBAL:][:, held], local_b[-N_GLOBAL:][held] = 0.0, 0.0, 0.0
                equations.add(problem.blocks[i], local_h, local_b)
                if pattern is not None:
                    term.cross = None
        if problem.speed is not None:
            for blocks, part_h, part_b in zip(problem.in_a_row, *problem.speed.system(self.poses), strict=True):
                equations.add(blocks, part_h, part_b)
        info = np.where(held, 0.0, intrinsics.prior_info)
        equations.add(np.array([problem.lens]), np.diag(info), info * (intrinsics.prior - self.g))
        if pattern is not None:
            give_back_memory()  # what the parts were made in, before the system is factorised
        return equations.matrix(), equations.rhs, total

    def cost(self) -> float:
        """The robust cost, priors included."""
        problem = self.problem

        def one(i: int) -> float:
            return float(anchor_part_cost(*self._given(i), self.g, problem.kernel_px))

        return self._prior_cost() + sum(on_two_threads(one, list(problem.by_anchor)))

    def moved(self, step: Array) -> _Estimate:
        """The estimate after a step of poses and intrinsics, with the depths that follow from it."""
        depths, of_block = dict(self.depths), step.reshape(-1, 6)
        poses = moved_poses(self.poses, self.problem.block_of, of_block)
        for some in self.problem.parts():
            moved = on_two_threads(lambda i: self._moved_depths(i, of_block), some)
            depths.update(zip(some, moved, strict=True))
        return _Estimate(self.problem, poses, depths, self.g + step[-N_GLOBAL:])

    def _moved_depths(self, i: int, of_block: Array) -> Array:
        """(p,) of an anchor keyframe, after the step (n, 6) of all blocks."""
        term = self.problem.terms[i]
        cross = self._anchor_part(i)[0].cross if term.cross is None else term.cross
        of = cross, self.problem.matches(i), term.to_anchor, self.problem.blocks[i], term.hdd, term.bd
        found: Array = moved_depths(self.depths[i], of_block, *of, STEP_AT_INFINITY)
        return found

    def _given(self, i: int) -> tuple[Array, Array, Array, AnchorMatches, Array, Array]:
        problem = self.problem
        v = problem.variables[i]
        return v.px, self.depths[i], problem.prior(i), problem.matches(i), self.poses, problem.ends[i]

    def _anchor_part(self, i: int) -> tuple[_AnchorTerm, Array, Array, float]:
        """What an anchor keyframe's depths are eliminated with, its part of the system without them, its cost."""
        problem = self.problem
        h, b, *kept, cost = anchor_part(*self._given(i), problem.blocks[i], self.g, problem.kernel_px)
        return _AnchorTerm(*kept), h, b, float(cost)

    def _prior_cost(self) -> float:
        """Of what no anchor keyframe has a part in."""
        intrinsics, speed = self.problem.intrinsics, self.problem.speed
        free = intrinsics.free
        total = float((intrinsics.prior_info[free] * (self.g - intrinsics.prior)[free] ** 2).sum())
        return total + (0.0 if speed is None else speed.cost(self.poses))


def _facing_scene(end: _Estimate, anchors: list[int], still: int) -> tuple[Array, dict[int, Array]]:
    """Poses and depths; where most points ended behind their cameras, inverse depths and translations are negated,
    all of them: they project the same. ``still``: row of the pose that stays."""
    if np.median(np.concatenate([end.depths[i] for i in anchors])) >= 0:
        return end.poses, end.depths
    poses = end.poses @ inverse(end.poses[still])
    poses[:, :3, 3] *= -1
    return poses @ end.poses[still], {**end.depths, **{i: -end.depths[i] for i in anchors}}


def _typical(inv_depth: Array) -> float:
    return float(np.abs(inv_depth).mean())


def _lens_covariance(hess: Any) -> Array | None:
    units = np.zeros((hess.shape[0], N_GLOBAL))
    units[-N_GLOBAL:] = np.eye(N_GLOBAL)
    columns = damped_solve(hess, units, 1e-9)
    return None if columns is None else columns[-N_GLOBAL:]
