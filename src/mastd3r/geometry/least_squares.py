"""One damped normal-equation step; the only place where a singular system is caught."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.linalg.lapack import dposv

Array = NDArray[Any]


def damped_solve(hess: Array, rhs: Array, damping: float) -> Array | None:
    """Solve (H + damping diag H) x = b for symmetric H (n, n); None where it is not positive definite.

    Unknowns with an empty row (no observation, or fixed) get a zero step.
    """
    diagonal = np.diag(hess)
    used = diagonal > 0
    step = np.zeros_like(rhs)
    if not used.any():
        return step
    system = hess.copy() if used.all() else hess[np.ix_(used, used)]
    system[np.diag_indices_from(system)] += damping * diagonal[used] + 1e-8
    _, step[used], fault = dposv(system, rhs[used], lower=1)  # Cholesky, without the checks of its wrappers
    return None if fault or not np.isfinite(step).all() else step
