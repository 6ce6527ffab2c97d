"""Numba kernels that compare depth maps of several views: who agrees, and what they say together."""

from __future__ import annotations

from typing import Any

import numba as nb
from numpy.typing import NDArray

from .projection import JIT, projected

Array = NDArray[Any]
ONE_SURFACE = 0.03  # relative difference of inverse depth up to which neighbouring pixels are one surface


@nb.njit(inline="always", **JIT)
def depth_at(inv_depth: Array, x: float, y: float) -> float:
    """Depth between pixels: of the four around where they are one surface, else of the nearest; 0 = none."""
    h, w = inv_depth.shape
    nearest = inv_depth[int(y + 0.5), int(x + 0.5)]
    if nearest <= 0:
        return 0.0
    x0, y0 = min(int(x), w - 2), min(int(y), h - 2)
    fx, fy = x - x0, y - y0
    a, b, c, d = inv_depth[y0, x0], inv_depth[y0, x0 + 1], inv_depth[y0 + 1, x0], inv_depth[y0 + 1, x0 + 1]
    low, high = min(a, b, c, d), max(a, b, c, d)
    if low <= 0 or high > low * (1 + ONE_SURFACE):
        return 1.0 / nearest
    return 1.0 / ((a * (1 - fx) + b * fx) * (1 - fy) + (c * (1 - fx) + d * fx) * fy)


@nb.njit(inline="always", **JIT)
def _moved(m: Array, k: Array, x: float, y: float, z: float) -> tuple[float, float, float]:
    """The pixel and depth in another view, by (3, 4) ``m``, of a pixel with depth; depth 0 where it lies behind."""
    return projected(m, k, (x - k[2]) / k[0] * z, (y - k[3]) / k[1] * z, z)


@nb.njit(**JIT)
def agreement(
    maps: Array,
    at: int,
    others: Array,
    k: Array,
    from_ref: Array,
    ref_from: Array,
    tolerance: float,
    reach_px: float,
    count: Array,
    merged: Array,
) -> None:
    """How many other views see every pixel's point where it stands, and the mean inverse depth of all that do.

    maps: (V, h, w) inverse depth of all views, 0 = none; ``at``: the view; others: (S,) numbers of the others.
    k: (4,) fx fy cx cy. from_ref, ref_from: (S, 3, 4) other from view and back. ``tolerance`` of relative depth,
    ``reach_px`` of the way there and back. count: (h, w) uint8; merged: (h, w) float32, the view's own counting as one.
    """
    h, w = maps.shape[1:]
    for v in range(h):
        for u in range(w):
            own = maps[at, v, u]
            count[v, u] = 0
            merged[v, u] = own
            if own <= 0:
                continue
            total, n = own, 0
            for s in range(len(others)):
                x, y, z = _moved(from_ref[s], k, u, v, 1.0 / own)
                if z <= 0 or not (-0.5 < x < w - 0.5 and -0.5 < y < h - 0.5):
                    continue
                x, y = min(max(x, 0.0), w - 1.0), min(max(y, 0.0), h - 1.0)
                there = depth_at(maps[others[s]], x, y)
                if there <= 0 or abs(there - z) > tolerance * z:
                    continue
                bx, by, back = _moved(ref_from[s], k, x, y, there)
                if back <= 0 or (bx - u) ** 2 + (by - v) ** 2 > reach_px * reach_px:
                    continue
                n += 1
                total += 1.0 / back
            count[v, u] = n
            merged[v, u] = total / (n + 1)


@nb.njit(**JIT)
def mark_shown(
    maps: Array, at: int, others: Array, k: Array, from_ref: Array, tolerance: float, keep: Array, taken: Array
) -> None:
    """Marks in ``taken`` (V, h, w) uint8 the pixels of other views that show what the view's pixels in ``keep`` show.

    maps, at, others, k, from_ref and ``tolerance`` as in ``agreement``; keep: (h, w) bool.
    """
    h, w = maps.shape[1:]
    for v in range(h):
        for u in range(w):
            if not keep[v, u]:
                continue
            for s in range(len(others)):
                x, y, z = _moved(from_ref[s], k, u, v, 1.0 / maps[at, v, u])
                if z <= 0 or not (-0.5 < x < w - 0.5 and -0.5 < y < h - 0.5):
                    continue
                column, row = int(x + 0.5), int(y + 0.5)
                there = maps[others[s], row, column]
                if there > 0 and abs(1.0 / there - z) <= tolerance * z:
                    taken[others[s], row, column] = 1
