"""Sim(3) pose-graph optimisation once a place is seen again: first the scales, then the poses."""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_array, csr_array, diags_array
from scipy.sparse.csgraph import breadth_first_order, minimum_spanning_tree
from scipy.sparse.linalg import spsolve

from ..geometry.least_squares import Damping, levenberg_marquardt
from ..geometry.se3 import adjoint, inverse, se3_exp, se3_log
from ..geometry.sim3 import Sim3
from .keyframe_graph import KeyframeGraph

Array = NDArray[Any]
ITERATIONS = 30
LOOP_WEIGHT = 100.0  # of a loop's matches against an edge's: what it says is verified, and many edges hold the chain


@dataclass(frozen=True)
class Loop:
    """Keyframe j seen again from keyframe i, far apart in time."""

    i: int
    j: int
    j_from_i: Sim3  # from points of camera i to those of camera j, each in the lengths around it
    matches: float  # weighted matches


@dataclass(frozen=True)
class _Edge:
    i: int  # rows of the keyframes
    j: int
    j_from_i: Array  # (4, 4)
    log_scale: float  # lengths around i per length around j
    weight: float
    is_loop: bool = False


def optimise_pose_graph(graph: KeyframeGraph, loops: list[Loop]) -> None:
    """Sim(3) pose-graph optimisation of the submap being tracked, so that the loops close.

    Its first keyframe stays, and a saved map.

    The edges are the pairs that matches connect, with their present relative poses, and the loops. An edge counts by
    the square of its matches, since one that had few was also at the limit of what can be followed: drift goes there.
    A loop counts ``LOOP_WEIGHT`` times that. Edges side by side drift alike; were each one more measurement against a
    lone loop, they would keep a part of the drift, and no solver that starts from there takes it out again.
    Scale first, which is linear: minimise the sum of w (x_j - x_i - log s)², x the log of a keyframe's factor. Then the
    poses, with the edges' translations stretched: Levenberg-Marquardt on SE(3), r = log(T_j T_i⁻¹ measured⁻¹).
    """
    ids = graph.members()
    row = {k: n for n, k in enumerate(ids)}
    edges = _present_edges(graph, row) + [_loop_edge(x, row) for x in loops]
    still = max(1, len(ids) - len(graph.free_members()))  # rows: the first
    factor = np.exp(_log_factors(len(ids), still, edges))
    for k, n in row.items():
        graph.scale_keyframes([k], float(factor[n]))
    for n, edge in enumerate(edges):
        pose = edge.j_from_i.copy()
        # a loop was measured in i's lengths, an edge belongs to both of its ends
        pose[:3, 3] *= factor[edge.i] if edge.is_loop else np.sqrt(factor[edge.i] * factor[edge.j])
        edges[n] = replace(edge, j_from_i=pose)
    depth = 1 / np.median([graph.median_inv_depth(k) for k in ids])
    start = _chained(graph.variables[ids[0]].cam_from_world, len(ids), edges)
    start[:still] = [graph.variables[k].cam_from_world for k in ids[:still]]
    poses = _solve_poses(start, still, edges, float(depth))
    for k, n in row.items():
        graph.set_keyframe_pose(k, poses[n])


def _loop_edge(loop: Loop, row: dict[int, int]) -> _Edge:
    scale = 1 / loop.j_from_i.scale
    rigid = loop.j_from_i.in_lengths(scale).rigid
    return _Edge(row[loop.i], row[loop.j], rigid, float(np.log(scale)), LOOP_WEIGHT * loop.matches**2, True)


def _present_edges(graph: KeyframeGraph, row: dict[int, int]) -> list[_Edge]:
    """One for each connected pair, with the pose that the graph has now; neighbours are always held a little."""
    ids = sorted(row)
    seen = dict.fromkeys(pairwise(ids), 1.0)
    for e in graph.edges:
        if e.i in row and e.j in row:
            pair = (min(e.i, e.j), max(e.i, e.j))
            seen[pair] = max(seen.get(pair, 0.0), float(e.weight.sum()))
    poses = {k: graph.variables[k].cam_from_world for k in row}
    return [_Edge(row[i], row[j], poses[j] @ inverse(poses[i]), 0.0, w**2) for (i, j), w in seen.items()]


def _log_factors(n: int, still: int, edges: list[_Edge]) -> Array:
    """(n,) log of every keyframe's factor; those of the first ``still`` are 0."""
    if still == n:
        return np.zeros(n)
    i, j = np.array([x.i for x in edges]), np.array([x.j for x in edges])
    weight = np.array([x.weight for x in edges]) / np.mean([x.weight for x in edges])
    wanted = weight * np.array([x.log_scale for x in edges])
    rows, ones = np.arange(len(edges)), np.ones(len(edges))
    jac = csr_array(coo_array((np.r_[ones, -ones], (np.r_[rows, rows], np.r_[j, i])), shape=(len(edges), n)))
    hess = (jac.T @ diags_array(weight) @ jac)[still:, still:] + 1e-9 * diags_array(np.ones(n - still))
    return np.r_[np.zeros(still), np.atleast_1d(spsolve(hess.tocsc(), (jac.T @ wanted)[still:]))]


def _chained(first: Array, n: int, edges: list[_Edge]) -> list[Array]:
    """Poses along the strongest edges, loops among them: what they do not agree on lies at the weakest."""
    steps = {(x.i, x.j): x for x in edges}  # of a pair that is both, the loop
    cost = coo_array(([1 / max(x.weight, 1e-9) for x in steps.values()], tuple(np.array([*steps]).T)), shape=(n, n))
    order, before = breadth_first_order(minimum_spanning_tree(csr_array(cost)), 0, directed=False)
    poses = [first] * n
    for k in order[1:]:
        b = int(before[k])
        edge = steps.get((b, int(k)))
        poses[k] = (edge.j_from_i if edge is not None else inverse(steps[int(k), b].j_from_i)) @ poses[b]
    return poses


@dataclass(frozen=True)
class _Poses:
    """cam_from_world (4, 4) of all keyframes, the first ``still`` of which stay: values of Levenberg-Marquardt."""

    poses: list[Array]
    still: int
    edges: list[_Edge]
    unit: Array  # (6,) squares of what a residual is divided by

    def _residuals(self) -> Array:
        """(m, 6) log(T_j T_i⁻¹ measured⁻¹)."""
        return np.stack([se3_log(self.poses[x.j] @ inverse(x.j_from_i @ self.poses[x.i])) for x in self.edges])

    def _weights(self) -> Array:
        weight = np.array([x.weight for x in self.edges])
        return (weight / weight.mean())[:, None] * self.unit

    def cost(self) -> float:
        """Sum of w r²."""
        return float((self._weights() * self._residuals() ** 2).sum())

    def linearised(self) -> tuple[Any, Array, float]:
        """See ``least_squares.Estimate``; the rows of what stays are empty."""
        n, m = len(self.poses), len(self.edges)
        weight, residual = self._weights(), self._residuals()
        jac = np.zeros((m, 2, 6, 6))  # by the poses of either end
        for e, x in enumerate(self.edges):
            jac[e, 0] = -adjoint(self.poses[x.j] @ inverse(self.poses[x.i]))
        jac[:, 1] = np.eye(6)
        ends = np.array([(x.i, x.j) for x in self.edges])
        jac[ends < self.still] = 0.0
        rows = np.broadcast_to(6 * np.arange(m)[:, None, None, None] + np.arange(6)[:, None], jac.shape)
        columns = np.broadcast_to(6 * ends[:, :, None, None] + np.arange(6), jac.shape)
        matrix = csr_array(coo_array((jac.ravel(), (rows.ravel(), columns.ravel())), shape=(6 * m, 6 * n)))
        weighted = matrix.T @ diags_array(weight.ravel())
        return weighted @ matrix, -(weighted @ residual.ravel()), float((weight * residual**2).sum())

    def moved(self, step: Array) -> _Poses:
        """Perturbed on the left."""
        poses = [se3_exp(xi) @ p for xi, p in zip(step.reshape(-1, 6), self.poses, strict=True)]
        return replace(self, poses=poses)


def _solve_poses(poses: list[Array], still: int, edges: list[_Edge], depth: float) -> list[Array]:
    """What the edges say together, the first ``still`` poses held.

    A translation of the scene's depth counts like a turn of one radian.
    """
    if still == len(poses):
        return poses
    start = _Poses(poses, still, edges, np.r_[np.full(3, 1 / depth), np.ones(3)] ** 2)
    return levenberg_marquardt(start, Damping(tries=6), iterations=ITERATIONS, tolerance=1e-9).estimate.poses
