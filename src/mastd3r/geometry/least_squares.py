"""Levenberg-Marquardt: the one loop, and the one damped step, where a singular system is caught."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Generic, Protocol, Self, TypeVar

import numpy as np
from numpy.typing import NDArray
from scipy.linalg.lapack import dposv
from scipy.sparse import diags_array, issparse
from scipy.sparse.linalg import splu

Array = NDArray[Any]
FALL, GROWTH = 0.2, 10.0  # of the damping, after a step that is taken and one that is refused
NOISE = 1e-9  # relative rise of the cost that is rounding


def damped_solve(hess: Any, rhs: Array, damping: float) -> Array | None:
    """Solve (H + damping diag H) x = b for symmetric H (n, n), dense or sparse; None where not positive definite.

    b is (n,), or (n, m) for m of them at once.

    Unknowns with an empty row (no observation, or fixed) get a zero step.
    """
    if issparse(hess):
        return _sparse_step(hess, rhs, damping)
    diagonal = np.diag(hess)
    used = diagonal > 0
    step = np.zeros_like(rhs)
    if not used.any():
        return step
    system = hess.copy() if used.all() else hess[np.ix_(used, used)]
    system[np.diag_indices_from(system)] += damping * diagonal[used] + 1e-8
    _, step[used], fault = dposv(system, rhs[used], lower=1)  # Cholesky, without the checks of its wrappers
    return None if fault or not np.isfinite(step).all() else step


def _sparse_step(hess: Any, rhs: Array, damping: float) -> Array | None:
    diagonal = hess.diagonal()
    used = diagonal > 0
    system = hess + diags_array(np.where(used, damping * diagonal + 1e-8, 1.0))
    try:  # no pivoting: of a positive definite matrix none is needed, and U shows whether it is one
        factor = splu(system.tocsc(), "MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options={"SymmetricMode": True})
    except RuntimeError:  # exactly singular
        return None
    step = np.where(used.reshape(-1, *(1,) * (rhs.ndim - 1)), factor.solve(rhs), 0.0)
    return step if (factor.U.diagonal() > 0).all() and np.isfinite(step).all() else None


class Estimate(Protocol):
    """Values of all unknowns. It does not change: ``moved`` makes another one."""

    def linearised(self) -> tuple[Any, Array, float]:
        """Normal equations H (n, n), dense or sparse, b (n,) of a step, and the cost."""
        ...

    def cost(self) -> float:
        """The cost alone."""
        ...

    def moved(self, step: Array) -> Self:
        """The estimate after a step (n,). Asked for after ``linearised``."""
        ...


E = TypeVar("E", bound=Estimate)


@dataclass(frozen=True)
class Damping:
    """How the damping runs, and when a solver gives up."""

    least: float = 1e-8
    most: float = 1e4  # the loop ends where the damping is larger once all tries were refused
    tries: int = 1  # steps, each damped tenfold the one before, that are tried in one iteration
    first: float = 1e-4


@dataclass(frozen=True)
class Minimum(Generic[E]):
    """Where the loop ended."""

    estimate: E
    iterations: int
    converged: bool
    cost_first: float  # -1 without iterations
    cost_last: float
    hess: Any  # (n, n) of the last step that was taken; None: none was


def levenberg_marquardt(start: E, damping: Damping, *, iterations: int, tolerance: float) -> Minimum[E]:
    """Steps (H + damping diag H) x = b as long as they lower the cost.

    It has converged where a step lowers the cost by less than ``tolerance``, relative. A step that raises the cost, or
    a system that cannot be solved, is refused, and the damping grows.
    """
    at, amount, done, converged = start, damping.first, 0, False
    cost_first = cost = -1.0
    hess_taken = None
    for done in range(1, iterations + 1):
        hess, rhs, cost = at.linearised()
        cost_first = cost if done == 1 else cost_first
        for _ in range(damping.tries):
            step = damped_solve(hess, rhs, amount)
            trial = None if step is None else at.moved(step)
            trial_cost = np.inf if trial is None else trial.cost()
            if trial_cost <= cost * (1 + NOISE):
                break
            trial = None
            amount *= GROWTH
        if trial is None:
            if amount > damping.most:
                break
            continue
        amount = max(amount * FALL, damping.least)
        converged = cost - trial_cost < tolerance * max(cost, 1e-12)
        at, cost, hess_taken = trial, trial_cost, hess
        if converged:
            break
    return Minimum(at, done, converged, cost_first, cost, hess_taken)
