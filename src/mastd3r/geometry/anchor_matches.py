"""The matches of one anchor keyframe as the kernels of the joint optimisation want them: those with weight alone."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import numba as nb
import numpy as np
from numpy.typing import NDArray

Array = NDArray[Any]
_JIT: dict[str, Any] = {"cache": True, "nogil": True}


class AnchorMatches(NamedTuple):
    """The matches with weight of one anchor keyframe, edge after edge: k in all of its m edges."""

    first: Array  # (m + 1,) int64: those of edge e are first[e] to first[e + 1]
    edge: Array  # (k,) int64
    point: Array  # (k,) int64 of the anchor's p points, in order within an edge
    target: Array  # (k, 2) float64 pixels in the edge's other end
    weight: Array  # (k,) float64, above 0
    of_point: Array  # (p + 1,) int64: those of point n are by_point[of_point[n]] to by_point[of_point[n + 1]]
    by_point: Array  # (k,) int64 the matches, point after point, in order of their edges

    @staticmethod
    def of(targets: Sequence[Array], weights: Sequence[Array]) -> AnchorMatches:
        """Of edges that say of all p points where they are, (p, 2) each, and with which weight, (p,) each."""
        m, p = len(weights), len(weights[0])
        first, edge, point = np.zeros(m + 1, np.int64), np.empty(m * p, np.int64), np.empty(m * p, np.int64)
        target, weight = np.empty((m * p, 2)), np.empty(m * p)
        for e in range(m):
            first[e + 1] = _pack(targets[e], weights[e], e, first[e], edge, point, target, weight)
        kept: tuple[Array, ...] = tuple(a[: first[m]].copy() for a in (edge, point, target, weight))
        return AnchorMatches(first, *kept, *_sorted(kept[1], p))


@nb.njit(**_JIT)
def _pack(
    targets: Array, weights: Array, e: int, at: int, edge: Array, point: Array, target: Array, weight: Array
) -> int:
    """Add the matches with weight of edge ``e`` from row ``at`` on; returns the row after them."""
    for n in range(len(weights)):
        if weights[n] > 0:
            edge[at], point[at], weight[at] = e, n, weights[n]
            target[at, 0], target[at, 1] = targets[n, 0], targets[n, 1]
            at += 1
    return at


@nb.njit(**_JIT)
def _sorted(point: Array, p: int) -> tuple[Array, Array]:
    """``of_point`` and ``by_point`` of matches (k,) of p points."""
    first, order = np.zeros(p + 1, np.int64), np.empty(len(point), np.int64)
    for n in point:
        first[n + 1] += 1
    for n in range(p):
        first[n + 1] += first[n]
    at = first[:-1].copy()
    for k in range(len(point)):
        order[at[point[k]]] = k
        at[point[k]] += 1
    return first, order
