"""Numba kernel of point-to-point residuals on Sim(3): eq. (11), (12)."""

from __future__ import annotations

import math
from typing import Any

import numba as nb
import numpy as np
from numpy.typing import NDArray

Array = NDArray[Any]


@nb.njit(cache=True, error_model="numpy", nogil=True)
def point_system(moved: Array, own: Array, weight: Array, sigma: Array) -> tuple[Array, Array, float]:
    """Normal equations (7, 7), (7,) and cost of r = (own - moved)/sigma, Cauchy kernel of 2: the sums of
    ``alignment.fine.point_terms``."""
    hess, rhs, cost = np.zeros((7, 7)), np.zeros(7), 0.0
    jac, r = np.zeros((3, 7)), np.zeros(3)
    for n in range(len(moved)):
        inverse = 1 / sigma[n]
        for c in range(3):
            r[c] = (own[n, c] - moved[n, c]) * inverse
            jac[c, c] = inverse
            jac[c, 6] = -own[n, c] * inverse
        x, y, z = moved[n, 0] * inverse, moved[n, 1] * inverse, moved[n, 2] * inverse
        jac[0, 4], jac[0, 5], jac[1, 3], jac[1, 5], jac[2, 3], jac[2, 4] = z, -y, -z, x, y, -x
        squared = r[0] * r[0] + r[1] * r[1] + r[2] * r[2]
        w = weight[n] / (1 + squared / 4)
        cost += weight[n] * 4 * math.log1p(squared / 4)
        for c in range(3):
            for i in range(7):
                k = w * jac[c, i]
                rhs[i] += k * r[c]
                for j in range(i, 7):
                    hess[i, j] += k * jac[c, j]
    for i in range(7):
        for j in range(i):
            hess[i, j] = hess[j, i]
    return hess, rhs, cost
