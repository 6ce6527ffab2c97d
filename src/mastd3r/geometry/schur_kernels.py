"""Numba kernels of the joint optimisation: an anchor keyframe's depths eliminated (docs/joint_optimisation.md).

A point is seen by few of the keyframes that its anchor is matched with, so what its depth couples is a few blocks of
six unknowns: they are multiplied point by point, and nothing is made of the others.
"""

from __future__ import annotations

from typing import Any

import numba as nb
import numpy as np
from numpy.typing import NDArray

from .anchor_matches import AnchorMatches
from .pose_kernels import edge_poses, to_anchor_pose
from .reprojection_kernels import N_GLOBAL, N_POSE, anchor_cost, anchor_system

Array = NDArray[Any]
_JIT: dict[str, Any] = {"cache": True, "fastmath": True, "error_model": "numpy", "nogil": True}
B = 6  # unknowns of a block: a pose, or the lens
assert N_POSE == N_GLOBAL == B


@nb.njit(**_JIT)
def local_system(hess: Array, rhs: Array, to_anchor: Array) -> tuple[Array, Array]:
    """H (n, n) and b (n,), n = 12 + 6 m, of one anchor keyframe from its edges' parts (m, 12, 12) and (m, 12).

    The columns are [pose i, pose j1 … jm, lens], those of an edge [pose j, lens]. ``to_anchor`` (m, 6, 6): pose i's
    columns of an edge are those of pose j times it.
    """
    m = len(hess)
    n = 2 * B + B * m
    last = n - B
    out, b = np.zeros((n, n)), np.zeros(n)
    for e in range(m):
        a, h, j = to_anchor[e], hess[e], B + B * e
        for r in range(B):
            for c in range(B):
                ij, ig = 0.0, 0.0
                for k in range(B):
                    ij += a[k, r] * h[k, c]
                    ig += a[k, r] * h[k, B + c]
                out[r, j + c] = ij
                out[r, last + c] += ig
                out[j + r, j + c] = h[r, c]
                out[j + r, last + c] = h[r, B + c]
                out[last + r, last + c] += h[B + r, B + c]
            for k in range(B):
                b[r] += a[k, r] * rhs[e, k]
            b[j + r] = rhs[e, r]
            b[last + r] += rhs[e, B + r]
        for r in range(B):
            for c in range(B):
                for k in range(B):
                    out[r, c] += out[r, j + k] * a[k, c]
    _mirror(out)
    return out, b


@nb.njit(**_JIT)
def _mirror(square: Array) -> None:
    """The lower triangle becomes the upper one."""
    for r in range(len(square)):
        for c in range(r):
            square[r, c] = square[c, r]


@nb.njit(**_JIT)
def _gather(
    n: int, cross: Array, matches: AnchorMatches, to_anchor: Array, blocks: Array, values: Array, column: Array
) -> int:
    """Fill ``values`` with the row of point ``n`` in E, block after block, and ``column`` with where they begin.

    Returns how many blocks there are, without those that are held: pose i, the poses of those that see it in order,
    the lens.
    """
    m, count = len(to_anchor), 0
    lens = values[m + 1]  # of the last row nothing else is made before all is seen
    for c in range(B):
        values[0, c] = 0.0
        lens[c] = 0.0
    if blocks[0] >= 0:
        count, column[0] = 1, 0
    for s in range(matches.of_point[n], matches.of_point[n + 1]):
        k = matches.by_point[s]
        e = matches.edge[k]
        if blocks[0] >= 0:
            for c in range(B):
                for i in range(B):
                    values[0, i] += float(cross[k, c]) * to_anchor[e, c, i]
        for c in range(B):
            lens[c] += cross[k, B + c]
        if blocks[e + 1] >= 0:
            column[count] = B + B * e
            for c in range(B):
                values[count, c] = cross[k, c]
            count += 1
    if blocks[m + 1] >= 0:
        column[count] = B + B * m
        for c in range(B):
            values[count, c] = lens[c]
        count += 1
    return count


@nb.njit(inline="always", **_JIT)
def _subtract(hess: Array, row: Any, column: Any, a: Array, b: Array, per: float) -> None:
    """``per`` a b^T (6, 6) is taken from the block of ``hess`` that begins there."""
    b0, b1, b2, b3, b4, b5 = per * b[0], per * b[1], per * b[2], per * b[3], per * b[4], per * b[5]
    c1, c2, c3 = column + np.uintp(1), column + np.uintp(2), column + np.uintp(3)
    c4, c5 = column + np.uintp(4), column + np.uintp(5)
    for r in range(B):
        v, at = a[r], row + np.uintp(r)
        hess[at, column] -= v * b0
        hess[at, c1] -= v * b1
        hess[at, c2] -= v * b2
        hess[at, c3] -= v * b3
        hess[at, c4] -= v * b4
        hess[at, c5] -= v * b5


@nb.njit(**_JIT)
def eliminate(
    hess: Array,
    rhs: Array,
    cross: Array,
    matches: AnchorMatches,
    to_anchor: Array,
    blocks: Array,
    hdd: Array,
    bd: Array,
) -> None:
    """H - E D⁻¹ E^T and b - E D⁻¹ b_d, in place: the system of one anchor keyframe without its depths.

    ``hess`` (n, n), ``rhs`` (n,) as ``local_system`` makes them; ``cross`` (k, 12) of its matches; ``blocks`` (m + 2,)
    of each six unknowns, -1: they are held, and what is of them in H and b is left as it is; ``hdd``, ``bd`` (p,).
    """
    most = len(to_anchor) + 2
    values, column = np.empty((most, B)), np.empty(most, np.int64)
    for n in range(len(hdd)):
        if matches.of_point[n] == matches.of_point[n + 1]:
            continue
        count, per = _gather(n, cross, matches, to_anchor, blocks, values, column), 1.0 / hdd[n]
        for p in range(count):
            at = np.uintp(column[p])
            for r in range(B):
                v = values[p, r] * per
                rhs[at + np.uintp(r)] -= v * bd[n]
            for q in range(p, count):
                _subtract(hess, at, np.uintp(column[q]), values[p], values[q], per)
    _mirror(hess)


@nb.njit(**_JIT)
def depth_steps(
    step: Array, cross: Array, matches: AnchorMatches, to_anchor: Array, blocks: Array, hdd: Array, bd: Array
) -> Array:
    """(p,) of the depths, from the ``step`` (s, 6) of all blocks: D⁻¹ (b_d - E^T x)."""
    most = len(to_anchor) + 2
    values, column = np.empty((most, B)), np.empty(most, np.int64)
    out = np.empty(len(hdd))
    for n in range(len(hdd)):
        moved = 0.0
        if matches.of_point[n] < matches.of_point[n + 1]:
            for q in range(_gather(n, cross, matches, to_anchor, blocks, values, column)):
                block = blocks[column[q] // B]
                for c in range(B):
                    moved += values[q, c] * step[block, c]
        out[n] = (bd[n] - moved) / hdd[n]
    return out


# -- all that is made of one anchor keyframe, in one call ------------------------------------------------------------


@nb.njit(**_JIT)
def anchor_part(
    px: Array, depth: Array, prior: Array, matches: AnchorMatches, poses: Array, ends: Array, blocks: Array, g: Array,
    kernel_px: float,
) -> tuple[Array, Array, Array, Array, Array, Array, Array, float]:  # fmt: skip
    """The system of one anchor keyframe without its depths, and what they follow from.

    Args: px (p, 2); depth (p,) inverse; prior (2, p) its value and information; poses (q, 4, 4) cam_from_world of all
        keyframes; ends (m + 1,) which of them is the anchor, and which are those of its edges; blocks (m + 2,).
    Returns: H (n, n), b (n,), E (k, 12), to_anchor (m, 6, 6), H_dd (p,), b_d (p,), H_dd without the prior (p,), cost.
    """
    j_from_i = edge_poses(poses, ends)
    h, b, cross, depth_info, bd, cost = anchor_system(px, depth, matches, j_from_i, g, kernel_px, blocks[-1] >= 0)
    hdd = depth_info + prior[1] + 1e-9
    bd += prior[1] * (prior[0] - depth)
    to_anchor = to_anchor_pose(j_from_i)
    hess, rhs = local_system(h, b, to_anchor)
    eliminate(hess, rhs, cross, matches, to_anchor, blocks, hdd, bd)
    return hess, rhs, cross, to_anchor, hdd, bd, depth_info, cost.sum() + _prior_cost(depth, prior)


@nb.njit(**_JIT)
def anchor_part_cost(
    px: Array, depth: Array, prior: Array, matches: AnchorMatches, poses: Array, ends: Array, g: Array, kernel_px: float
) -> float:
    """The cost that ``anchor_part`` gives, alone."""
    cost: float = anchor_cost(px, depth, matches, edge_poses(poses, ends), g, kernel_px).sum()
    return cost + _prior_cost(depth, prior)


@nb.njit(**_JIT)
def _prior_cost(depth: Array, prior: Array) -> float:
    cost = 0.0
    for n in range(len(depth)):
        cost += prior[1, n] * (depth[n] - prior[0, n]) ** 2
    return cost


@nb.njit(**_JIT)
def moved_depths(
    depth: Array, step: Array, cross: Array, matches: AnchorMatches, to_anchor: Array, blocks: Array, hdd: Array,
    bd: Array, at_infinity: float,
) -> Array:  # fmt: skip
    """(p,) inverse depths after ``depth_steps``; no step goes on from infinity by more than ``at_infinity`` of the
    mean inverse depth, and none makes a point less than a quarter, or more than four times, of what it was."""
    out = depth_steps(step, cross, matches, to_anchor, blocks, hdd, bd)
    least = at_infinity * np.abs(depth).mean()
    for n in range(len(out)):
        down, up = max(0.75 * depth[n], least), 3.0 * abs(depth[n]) + least
        out[n] = depth[n] + min(max(out[n], -down), up)
    return out
