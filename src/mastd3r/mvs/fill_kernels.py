"""Numba kernel of the edge-aware membrane that fills bare surfaces from their outlines."""

from __future__ import annotations

from typing import Any

import numba as nb
from numpy.typing import NDArray

Array = NDArray[Any]


@nb.njit(cache=True, error_model="numpy", nogil=True)
def relax(value: Array, data: Array, weight: Array, right: Array, down: Array, over: float, sweeps: int) -> None:
    """Successive over-relaxation of sum weight (value - data)^2 + sum of right, down (differences)^2, in place.

    All (h, w); ``right`` and ``down`` weigh the difference to the next pixel there, 0 at the border. ``over`` in 1…2.
    Sweeps go forth and back in turn.
    """
    h, w = value.shape
    for sweep in range(sweeps):
        for n in range(h * w):
            at = n if sweep % 2 == 0 else h * w - 1 - n
            y, x = at // w, at % w
            total, by = weight[y, x] * data[y, x], weight[y, x]
            if x > 0:
                total += right[y, x - 1] * value[y, x - 1]
                by += right[y, x - 1]
            if x + 1 < w:
                total += right[y, x] * value[y, x + 1]
                by += right[y, x]
            if y > 0:
                total += down[y - 1, x] * value[y - 1, x]
                by += down[y - 1, x]
            if y + 1 < h:
                total += down[y, x] * value[y + 1, x]
                by += down[y, x]
            if by > 0:
                value[y, x] += over * (total / by - value[y, x])
