"""The one Levenberg-Marquardt loop: it ends in the minimum, refuses what rises, and gives up when it should."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.optimize import least_squares

from mastd3r.geometry.least_squares import Damping, damped_solve, levenberg_marquardt

Array = NDArray[Any]
AT = np.linspace(0, 2, 30)
MEASURED = 1.7 * np.exp(-1.3 * AT) + np.random.default_rng(0).normal(0, 0.01, len(AT))


@dataclass(frozen=True)
class Decay:
    """Amplitude and rate (2,) of a decay that was measured; ``calls`` counts what is asked for."""

    x: Array
    calls: dict[str, int] = field(default_factory=lambda: {"linearised": 0, "cost": 0})
    wrong_way: bool = False  # a step is taken backwards
    singular: bool = False

    def residual(self) -> Array:
        return np.asarray(MEASURED - self.x[0] * np.exp(-self.x[1] * AT))

    def linearised(self) -> tuple[Array, Array, float]:
        self.calls["linearised"] += 1
        falling = np.exp(-self.x[1] * AT)
        jac = np.stack([falling, -self.x[0] * AT * falling], 1)
        hess = jac.T @ jac
        if self.singular:
            hess[0, 1] = hess[1, 0] = 1e9
        r = self.residual()
        return hess, jac.T @ r, float(r @ r)

    def cost(self) -> float:
        self.calls["cost"] += 1
        return float((self.residual() ** 2).sum())

    def moved(self, step: Array) -> Decay:
        return replace(self, x=self.x - step if self.wrong_way else self.x + step)


START = np.array([0.3, 3.0])


@pytest.mark.parametrize("damping", [Damping(), Damping(least=1e-7, most=0.0, tries=6)])
def test_it_ends_in_the_minimum(damping: Damping) -> None:
    found = levenberg_marquardt(Decay(START), damping, iterations=60, tolerance=1e-14)
    wanted = least_squares(lambda x: Decay(x).residual(), START, xtol=1e-14, ftol=1e-14).x
    np.testing.assert_allclose(found.estimate.x, wanted, rtol=1e-6)
    assert found.converged and found.iterations < 60
    assert [found.cost_first, found.cost_last] == pytest.approx([Decay(START).cost(), Decay(wanted).cost()])
    assert found.hess is not None and found.hess.shape == (2, 2)


def test_a_loose_tolerance_ends_earlier() -> None:
    loose = levenberg_marquardt(Decay(START), Damping(), iterations=60, tolerance=0.5)
    tight = levenberg_marquardt(Decay(START), Damping(), iterations=60, tolerance=1e-12)
    assert loose.converged and loose.iterations < tight.iterations and loose.cost_last > tight.cost_last


def test_no_iteration_changes_nothing() -> None:
    found = levenberg_marquardt(Decay(START), Damping(), iterations=0, tolerance=1e-5)
    assert (found.estimate.x == START).all() and found.iterations == 0 and not found.converged
    assert found.cost_first == found.cost_last == -1 and found.hess is None
    assert found.estimate.calls == {"linearised": 0, "cost": 0}


@pytest.mark.parametrize(
    ("damping", "linearised", "tried"),
    [
        (Damping(first=1e-1, most=1e2), 4, 4),  # 0.1, 1, 10, 100: an iteration each
        (Damping(first=1e-1, most=0.0, tries=6), 1, 6),  # one system, six times
    ],
)
def test_a_step_that_raises_the_cost_is_not_taken(damping: Damping, linearised: int, tried: int) -> None:
    found = levenberg_marquardt(Decay(START, wrong_way=True), damping, iterations=60, tolerance=1e-9)
    assert (found.estimate.x == START).all() and not found.converged and found.hess is None
    assert found.estimate.calls == {"linearised": linearised, "cost": tried} and found.iterations == linearised
    assert found.cost_first == found.cost_last == pytest.approx(Decay(START).cost())


def test_a_system_that_cannot_be_solved_is_a_refused_step() -> None:
    start = Decay(START, singular=True)
    found = levenberg_marquardt(start, Damping(most=0.0, tries=6), iterations=9, tolerance=1e-9)
    assert (found.estimate.x == START).all() and start.calls == {"linearised": 1, "cost": 0}


def test_iterations_bound_the_systems() -> None:
    start = Decay(START)
    found = levenberg_marquardt(start, Damping(), iterations=3, tolerance=0.0)
    assert found.iterations == start.calls["linearised"] == 3 and not found.converged


def test_a_damped_step_leaves_out_what_is_not_observed() -> None:
    hess, rhs = np.diag([2.0, 0.0, 4.0]), np.array([1.0, 5.0, 1.0])
    step = damped_solve(hess, rhs, 0.5)
    assert step is not None
    np.testing.assert_allclose(step, [1 / 3, 0, 1 / 6], rtol=1e-6)
    assert (damped_solve(np.zeros((2, 2)), np.ones(2), 0.0) == np.zeros(2)).all()
    assert damped_solve(np.array([[1.0, 9.0], [9.0, 1.0]]), np.ones(2), 1e-4) is None
