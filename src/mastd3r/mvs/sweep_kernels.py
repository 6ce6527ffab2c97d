"""Numba kernels of the plane sweep: one plane's matching cost, semi-global aggregation, the best plane."""

from __future__ import annotations

import math
from typing import Any

import numba as nb
import numpy as np
from numpy.typing import NDArray

Array = NDArray[Any]
_JIT: dict[str, Any] = {"cache": True, "error_model": "numpy", "nogil": True}


@nb.njit(**_JIT)
def plane_cost(ref_mean: Array, ref_var: Array, sums: Array, valid: Array, noise_var: float, out: Array) -> None:
    """Cost (h, w) of one plane from S warped sources: the mean of 1 - NCC over the better half of those that see it.

    ref_mean, ref_var: (h, w) of the windows in the view. sums: (S, 3, h, w) window means of source, its square, and
    its product with the view. valid: (S, h, w) uint8. ``noise_var``: variance of grey levels that is noise, so that a
    bare window says nothing. 1 where no source sees the pixel.
    """
    count, h, w = valid.shape
    costs = np.empty(count, np.float32)
    for y in range(h):
        for x in range(w):
            n = 0
            for s in range(count):
                if valid[s, y, x] == 0:
                    continue
                mean = sums[s, 0, y, x]
                var = max(sums[s, 1, y, x] - mean * mean, 0.0)
                cov = sums[s, 2, y, x] - mean * ref_mean[y, x]
                ncc = cov / math.sqrt((var + noise_var) * (ref_var[y, x] + noise_var))
                c = min(1.0, max(0.0, 1.0 - ncc))
                at = n  # insertion into ascending order
                while at > 0 and costs[at - 1] > c:
                    costs[at] = costs[at - 1]
                    at -= 1
                costs[at] = c
                n += 1
            if n == 0:
                out[y, x] = 1.0
                continue
            used = (n + 1) // 2
            total = 0.0
            for s in range(used):
                total += costs[s]
            out[y, x] = total / used


@nb.njit(inline="always", **_JIT)
def _step(cost: Array, before: Array, low: float, p1: float, p2: float, now: Array, total: Array) -> Any:
    """One pixel of one path, Hirschmueller (PAMI 2008) eq. (13); adds to ``total`` and gives the path's minimum."""
    count = cost.shape[0]
    least = np.float32(1e9)
    jump = low + p2
    for d in range(count):
        best = min(before[d], jump)
        if d > 0:
            best = min(best, before[d - 1] + p1)
        if d + 1 < count:
            best = min(best, before[d + 1] + p1)
        value = cost[d] + best - low
        now[d] = value
        total[d] += value
        least = min(least, value)
    return least


@nb.njit(**_JIT)
def aggregate(
    cost: Array, gray: Array, p1: float, p2: float, least: float, edge: float, backward: bool, total: Array
) -> None:
    """Adds four paths of semi-global matching to ``total`` (h, w, D): those that come from before in reading order,
    or, ``backward``, from after. cost: (h, w, D) float32. gray: (h, w) float32. A jump costs p2 / (1 + |step| / edge),
    never less than ``least``, where the grey level steps so much along the path. p1 is inf where planes have no order.
    """
    h, w, count = cost.shape
    rows = np.zeros((3, 2, w, count), np.float32)  # of the three paths from the row before
    lows = np.zeros((3, 2, w), np.float32)
    along = np.zeros((2, count), np.float32)
    sign = -1 if backward else 1
    for line in range(h):
        y = h - 1 - line if backward else line
        new, old = line & 1, 1 - (line & 1)
        low = np.float32(0)
        for column in range(w):
            x = w - 1 - column if backward else column
            here, there = column & 1, 1 - (column & 1)
            if column == 0:
                along[there] = 0
                low = np.float32(0)
                jump = p2
            else:
                jump = max(least, p2 / (1 + abs(gray[y, x] - gray[y, x - sign]) / edge))
            low = _step(cost[y, x], along[there], low, p1, jump, along[here], total[y, x])
            for path in range(3):
                at = x - sign * (1 - path)
                if line == 0 or at < 0 or at >= w:
                    for d in range(count):
                        rows[path, new, x, d] = cost[y, x, d]
                        total[y, x, d] += cost[y, x, d]
                    start = np.float32(1e9)
                    for d in range(count):
                        start = min(start, cost[y, x, d])
                    lows[path, new, x] = start
                else:
                    jump = max(least, p2 / (1 + abs(gray[y, x] - gray[y - sign, at]) / edge))
                    lows[path, new, x] = _step(
                        cost[y, x],
                        rows[path, old, at],
                        lows[path, old, at],
                        p1,
                        jump,
                        rows[path, new, x],
                        total[y, x],
                    )


@nb.njit(**_JIT)
def best_plane(total: Array, out: Array) -> None:
    """(h, w) float32 place of the least cost in 0 … D-1, between planes by a parabola through three."""
    h, w, count = total.shape
    for y in range(h):
        for x in range(w):
            d = 0
            for n in range(1, count):
                if total[y, x, n] < total[y, x, d]:
                    d = n
            place = float(d)
            if 0 < d < count - 1:
                a, b, c = total[y, x, d - 1], total[y, x, d], total[y, x, d + 1]
                bend = a - 2 * b + c
                if bend > 0:
                    place += 0.5 * (a - c) / bend
            out[y, x] = place
