"""Numba kernels of the planar prior: which points lie on a plane, and what speaks for one at every pixel of a view."""

from __future__ import annotations

from typing import Any

import numba as nb
from numpy.typing import NDArray

from .fusion_kernels import depth_at
from .projection import JIT, projected

Array = NDArray[Any]


@nb.njit(**JIT)
def count_near(points: Array, normals: Array, sigma: Array, planes: Array, least_cos: float, out: Array) -> None:
    """out (p,) int64: how many points (n, 3) lie on planes (p, 4), n . X = d.

    A point does within its own ``sigma`` (n,), where its normal (n, 3), if it has one, is the plane's: ``least_cos``.
    """
    for p in range(len(planes)):
        a, b, c, d = planes[p]
        found = 0
        for i in range(len(points)):
            if abs(a * points[i, 0] + b * points[i, 1] + c * points[i, 2] - d) < sigma[i]:
                x, y, z = normals[i]
                found += (x == 0 and y == 0 and z == 0) or abs(a * x + b * y + c * z) > least_cos
        out[p] = found


@nb.njit(**JIT)
def evidence(
    slopes: Array,
    rays: Array,
    axes: Array,
    grids: Array,
    sure: Array,
    others: Array,
    k: Array,
    from_ref: Array,
    tolerance: float,
    far_cells: float,
    out: Array,
) -> None:
    """What speaks against every plane at every pixel of a view, but for the pixel's own colours; out (h, w, P) float32.

    slopes: (P, 3), inverse depth = slope . ray of the planes in the view. rays: (h, w, 3), z = 1. axes: (P, 2, 4) of
    the planes' grids from the view: cell number along an axis = axis . (X, 1). grids: (P, G, G) float32 distance to the
    nearest cell with support, in cells. sure: (V, h, w) inverse depth of all views where it is sure, 0 elsewhere.
    others (S,), k, from_ref (S, 3, 4), ``tolerance``: as of ``agreement``. A sum of two parts: how far support is, 1 at
    ``far_cells``; and views that see through the plane, 1 each, less those that see it, 0 at least. 9 further away.
    """
    h, w = rays.shape[:2]
    size = grids.shape[1]
    for v in range(h):
        for u in range(w):
            for p in range(len(slopes)):
                rho = slopes[p, 0] * rays[v, u, 0] + slopes[p, 1] * rays[v, u, 1] + slopes[p, 2]
                if rho <= 1e-9:
                    out[v, u, p] = 9.0
                    continue
                cx, cy, cz = rays[v, u, 0] / rho, rays[v, u, 1] / rho, 1.0 / rho
                i = axes[p, 0, 0] * cx + axes[p, 0, 1] * cy + axes[p, 0, 2] * cz + axes[p, 0, 3]
                j = axes[p, 1, 0] * cx + axes[p, 1, 1] * cy + axes[p, 1, 2] * cz + axes[p, 1, 3]
                if not (0 <= i < size and 0 <= j < size):
                    out[v, u, p] = 9.0
                    continue
                away = grids[p, int(j), int(i)] / far_cells
                if away > 1:
                    out[v, u, p] = 9.0
                    continue
                through, seen = 0.0, 0.0
                for s in range(len(others)):
                    px, py, depth = projected(from_ref[s], k, cx, cy, cz)
                    if depth <= 0 or not (-0.5 < px < w - 0.5 and -0.5 < py < h - 0.5):
                        continue
                    there = depth_at(sure[others[s]], min(max(px, 0.0), w - 1.0), min(max(py, 0.0), h - 1.0))
                    if there <= 0:
                        continue
                    if there > depth * (1 + 2 * tolerance):
                        through += 1
                    elif there > depth * (1 - tolerance):
                        seen += 1
                out[v, u, p] = away + max(0.0, through - seen)
