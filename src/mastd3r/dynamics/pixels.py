"""Images between their pixels, and how this stage's kernels are compiled."""

from __future__ import annotations

from typing import Any

import numba as nb
import numpy as np
from numpy.typing import NDArray

Array = NDArray[Any]
_F = np.float32
FINITE = {"contract", "arcp", "nsz"}  # fast, but a number that is not finite stays one
JIT: dict[str, Any] = {"cache": True, "nogil": True, "error_model": "numpy", "fastmath": FINITE}


@nb.njit(inline="always", **JIT)
def between_pixels(image: Array, u: Any, v: Any) -> Any:
    """``image`` (h, w) at column ``u`` and row ``v``, float32 within its outermost pixels, bilinear."""
    a, b = min(int(u), image.shape[1] - 2), min(int(v), image.shape[0] - 2)
    p, q = u - _F(a), v - _F(b)
    top = _F(image[b, a]) * (_F(1) - p) + _F(image[b, a + 1]) * p
    low = _F(image[b + 1, a]) * (_F(1) - p) + _F(image[b + 1, a + 1]) * p
    return top * (_F(1) - q) + low * q
