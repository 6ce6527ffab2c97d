"""Numba kernels of the camera, operation for operation what NumPy would do: the same to the last bit, in one pass."""

from __future__ import annotations

from typing import Any

import numba as nb
import numpy as np
from numpy.typing import NDArray

Array = NDArray[Any]
Lens = tuple[float, float, float, float, float, float, float]  # fx, fy, cx, cy in px; k1, k2, k3
ROUNDS = 10  # of fixed-point undistortion
_JIT: dict[str, Any] = {"cache": True, "error_model": "numpy", "nogil": True}


@nb.njit(**_JIT)
def rays_of(px: Array, lens: Lens, bent: bool) -> Array:
    """(n, 3) rays with z = 1 of pixels (n, 2)."""
    fx, fy, cx, cy, k1, k2, k3 = lens
    out = np.empty((len(px), 3))
    for n in range(len(px)):
        x_bent, y_bent = (px[n, 0] - cx) / fx, (px[n, 1] - cy) / fy
        x, y = x_bent, y_bent
        if bent:
            for _ in range(ROUNDS):
                r2 = x * x + y * y
                bend = 1 + r2 * (k1 + r2 * (k2 + k3 * r2))
                x, y = x_bent / bend, y_bent / bend
        out[n, 0], out[n, 1], out[n, 2] = x, y, 1.0
    return out


@nb.njit(**_JIT)
def pixels_of(points: Array, lens: Lens) -> Array:
    """(n, 2) pixels of points (n, 3) with z > 0."""
    fx, fy, cx, cy, k1, k2, k3 = lens
    out = np.empty((len(points), 2))
    for n in range(len(points)):
        x, y = points[n, 0] / points[n, 2], points[n, 1] / points[n, 2]
        r2 = x * x + y * y
        bend = 1 + r2 * (k1 + r2 * (k2 + k3 * r2))
        out[n, 0], out[n, 1] = x * bend * fx + cx, y * bend * fy + cy
    return out
