"""Numba kernels: where a pinhole sees a point."""

from __future__ import annotations

from typing import Any

import numba as nb
from numpy.typing import NDArray

Array = NDArray[Any]
JIT: dict[str, Any] = {"cache": True, "error_model": "numpy", "nogil": True}
LEAST_DEPTH = 1e-6


@nb.njit(inline="always", **JIT)
def projected(m: Array, k: Array, x: float, y: float, z: float) -> tuple[float, float, float]:
    """The pixel (x, y) and the depth of a point that (3, 4) ``m`` brings into the camera; depth 0 where it lies behind.

    k: (4,) fx fy cx cy; an integer is a pixel centre.
    """
    depth = m[2, 0] * x + m[2, 1] * y + m[2, 2] * z + m[2, 3]
    if depth <= LEAST_DEPTH:
        return 0.0, 0.0, 0.0
    px = k[0] * (m[0, 0] * x + m[0, 1] * y + m[0, 2] * z + m[0, 3]) / depth + k[2]
    py = k[1] * (m[1, 0] * x + m[1, 1] * y + m[1, 2] * z + m[1, 3]) / depth + k[3]
    return px, py, depth
