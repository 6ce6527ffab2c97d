"""One damped normal-equation step; the only place where a singular system is caught."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import cho_factor, cho_solve

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
    system = hess[np.ix_(used, used)].copy()
    system[np.diag_indices_from(system)] += damping * diagonal[used] + 1e-8
    try:
        step[used] = cho_solve(cho_factor(system, lower=True), rhs[used])
    except (np.linalg.LinAlgError, ValueError):
        return None
    return step if np.isfinite(step).all() else None
