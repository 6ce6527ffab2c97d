"""The three nearest of many points in the plane, through a grid of buckets: exact, and quick where all lie close."""

from __future__ import annotations

from typing import Any

import numba as nb
import numpy as np
from numpy.typing import NDArray

Array = NDArray[Any]
COUNT = 3


def three_nearest(points: Array, at: Array, bucket: float) -> tuple[Array, Array]:
    """Distances (q, 3), ascending, and indices (q, 3) of the three ``points`` (n, 2) nearest to each of ``at`` (q, 2).

    ``bucket`` is about the distance of neighbours among the points: it decides the speed, not the answer. Raises
    ValueError for fewer than three points.
    """
    if len(points) < COUNT:
        raise ValueError(f"three_nearest: expected at least {COUNT} points, got {len(points)}")
    low = at.min(0)
    cols, rows = (np.ceil((at.max(0) - low) / bucket).astype(int) + 1).tolist()
    cell = np.clip(((points - low) / bucket).astype(int), 0, [cols - 1, rows - 1])  # what is outside: at the rim
    of = cell[:, 1] * cols + cell[:, 0]
    order = np.argsort(of, kind="stable")
    first = np.searchsorted(of[order], np.arange(rows * cols + 1))
    found: tuple[Array, Array] = _search(
        np.ascontiguousarray(points[order], float),
        order,
        first,
        rows,
        cols,
        np.ascontiguousarray(at, float),
        low,
        bucket,
    )
    return found


@nb.njit(cache=True, nogil=True, error_model="numpy")
def _search(
    points: Array, order: Array, first: Array, rows: int, cols: int, at: Array, low: Array, bucket: float
) -> tuple[Array, Array]:
    distance, index = np.full((len(at), COUNT), np.inf), np.zeros((len(at), COUNT), np.int64)
    for n in range(len(at)):
        x, y = at[n]
        i, j = int((x - low[0]) / bucket), int((y - low[1]) / bucket)
        d, k = distance[n], index[n]
        for ring in range(max(rows, cols) + 1):
            for b in range(max(j - ring, 0), min(j + ring, rows - 1) + 1):
                step = 1 if abs(b - j) == ring else max(2 * ring, 1)  # a whole row of the ring, or its two ends
                for a in range(i - ring, i + ring + 1, step):
                    if a < 0 or a >= cols:
                        continue
                    for m in range(first[b * cols + a], first[b * cols + a + 1]):
                        square = (points[m, 0] - x) ** 2 + (points[m, 1] - y) ** 2
                        for place in range(COUNT):
                            if square < d[place]:
                                for later in range(COUNT - 1, place, -1):
                                    d[later], k[later] = d[later - 1], k[later - 1]
                                d[place], k[place] = square, order[m]
                                break
            if d[COUNT - 1] <= (ring * bucket) ** 2:  # nothing outside the rings so far is nearer
                break
        for place in range(COUNT):
            d[place] = np.sqrt(d[place])
    return distance, index
