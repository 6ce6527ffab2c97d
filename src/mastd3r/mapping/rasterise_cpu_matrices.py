"""Small matrices inside numba kernels: row-major tuples, 2 x 3 has 6 entries, 3 x 3 has 9; and how kernels compile."""

# mypy: disallow-untyped-defs=False
from __future__ import annotations

from typing import Any

from numba import njit

JIT: dict[str, Any] = {
    "fastmath": True,
    "cache": True,
    "nogil": True,
    "error_model": "numpy",
    "boundscheck": False,
}


@njit(**JIT)
def scaled_columns(r, s0, s1, s2):
    return (r[0] * s0, r[1] * s1, r[2] * s2, r[3] * s0, r[4] * s1, r[5] * s2, r[6] * s0, r[7] * s1, r[8] * s2)


@njit(**JIT)
def times(a, m):
    """(2 x 3) (3 x 3)."""
    return (
        a[0] * m[0] + a[1] * m[3] + a[2] * m[6],
        a[0] * m[1] + a[1] * m[4] + a[2] * m[7],
        a[0] * m[2] + a[1] * m[5] + a[2] * m[8],
        a[3] * m[0] + a[4] * m[3] + a[5] * m[6],
        a[3] * m[1] + a[4] * m[4] + a[5] * m[7],
        a[3] * m[2] + a[4] * m[5] + a[5] * m[8],
    )


@njit(**JIT)
def times_transposed(a, m):
    """(2 x 3) (3 x 3)^T."""
    return (
        a[0] * m[0] + a[1] * m[1] + a[2] * m[2],
        a[0] * m[3] + a[1] * m[4] + a[2] * m[5],
        a[0] * m[6] + a[1] * m[7] + a[2] * m[8],
        a[3] * m[0] + a[4] * m[1] + a[5] * m[2],
        a[3] * m[3] + a[4] * m[4] + a[5] * m[5],
        a[3] * m[6] + a[4] * m[7] + a[5] * m[8],
    )


@njit(**JIT)
def transposed_times(a, f):
    """(2 x 3)^T (2 x 3)."""
    return (
        a[0] * f[0] + a[3] * f[3],
        a[0] * f[1] + a[3] * f[4],
        a[0] * f[2] + a[3] * f[5],
        a[1] * f[0] + a[4] * f[3],
        a[1] * f[1] + a[4] * f[4],
        a[1] * f[2] + a[4] * f[5],
        a[2] * f[0] + a[5] * f[3],
        a[2] * f[1] + a[5] * f[4],
        a[2] * f[2] + a[5] * f[5],
    )
