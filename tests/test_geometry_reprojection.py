"""The solver's kernels against finite differences and dense algebra, and the damped solve."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from mastd3r.geometry.gauss_newton import damped_solve
from mastd3r.geometry.reprojection import (
    MIN_DEPTH,
    edge_residuals,
    host_cost,
    host_system,
    pose_system,
)
from mastd3r.geometry.se3 import se3_exp

Array = NDArray[Any]
QUICK = settings(max_examples=25, deadline=None)
WIDE_PX = 1e7  # a kernel so wide that it is none
seeds = st.integers(0, 10**6)


class Edges:
    """Random edges of one host: pixels, depths, targets a few pixels from their predictions, a bent lens."""

    def __init__(self, seed: int, edges: int = 2, points: int = 12) -> None:
        rng = np.random.default_rng(seed)
        self.g = np.array([np.log(rng.uniform(240, 500)), rng.uniform(-0.1, 0.15), 155.0, 118.0])
        self.px = rng.uniform([0, 0], [320, 240], (points, 2))
        self.depth = rng.uniform(0.1, 1.0, points)
        self.pose = np.stack([se3_exp(rng.uniform(-0.12, 0.12, 6)) for _ in range(edges)])
        self.weight = rng.uniform(0.1, 1, (edges, points))
        self.target = np.stack([self.px - self.residual(np.zeros(11), t, self.px) for t in self.pose]) + rng.normal(
            0, 3, (edges, points, 2)
        )

    def residual(self, x: Array, pose: Array, target: Array) -> Array:
        """(p, 2) residuals after a step x = [pose (6), lens (4), depth]."""
        r, z = edge_residuals(self.px, self.depth + x[10], target, se3_exp(x[:6]) @ pose, self.g + x[6:10])
        assert (z > MIN_DEPTH).all()
        return r

    def jacobian(self, e: int) -> Array:
        """(p, 2, 11) of the prediction, by central differences: minus that of the residual."""
        columns = []
        for i in range(11):
            step = np.zeros(11)
            step[i] = 1e-3 if i in (8, 9) else 1e-6
            high = self.residual(step, self.pose[e], self.target[e])
            low = self.residual(-step, self.pose[e], self.target[e])
            columns.append(-(high - low) / (2 * step[i]))
        return np.stack(columns, -1)

    def args(self) -> tuple[Array, ...]:
        return self.px, self.depth, self.target, self.weight, self.pose, self.g


def close(found: Array, wanted: Array, tolerance: float = 2e-5) -> None:
    """Equal up to ``tolerance`` of the largest entry of each column (units differ between columns)."""
    size = np.abs(wanted).reshape(-1, wanted.shape[-1]).max(0) + 1e-9
    np.testing.assert_allclose(found / size, wanted / size, atol=tolerance)


@QUICK
@given(seeds)
def test_all_ten_columns_and_the_depth_agree_with_finite_differences(seed: int) -> None:
    s = Edges(seed)
    hess, rhs, cross, hdd, bd, cost = host_system(*s.args(), WIDE_PX)
    for e in range(len(s.pose)):
        r = s.residual(np.zeros(11), s.pose[e], s.target[e])
        jac, w = s.jacobian(e), s.weight[e]
        j, jd = jac[..., :10], jac[..., 10]
        close(hess[e], np.einsum("p,pri,prj->ij", w, j, j))
        close(rhs[e][None], np.einsum("p,pri,pr->i", w, j, r)[None], 1e-4)
        close(cross[e], np.einsum("p,pri,pr->pi", w, j, jd))
        close(hdd[e][:, None], np.einsum("p,pr,pr->p", w, jd, jd)[:, None])
        np.testing.assert_allclose(bd[e], np.einsum("p,pr,pr->p", w, jd, r), rtol=1e-4, atol=1e-3)
        assert cost[e] == pytest.approx((w * (r**2).sum(1)).sum(), rel=1e-5)


@QUICK
@given(seeds)
def test_each_column_by_itself(seed: int) -> None:
    """One match at a time: H determines its two-row Jacobian up to a rotation, and b and E fix that."""
    s = Edges(seed, edges=1, points=1)
    jac = s.jacobian(0)[0]
    hess, rhs, cross, hdd, _, _ = host_system(*s.args(), WIDE_PX)
    w = s.weight[0, 0]
    close(np.sqrt(np.diag(hess[0]))[None], np.sqrt(w) * np.linalg.norm(jac[:, :10], axis=0)[None], 1e-4)
    close(cross[0], w * (jac[:, :10].T @ jac[:, 10])[None], 1e-4)
    r = s.residual(np.zeros(11), s.pose[0], s.target[0])[0]
    close(rhs[0][None], w * (jac[:, :10].T @ r)[None], 1e-3)
    assert hdd[0, 0] == pytest.approx(w * (jac[:, 10] ** 2).sum(), rel=1e-4)


@QUICK
@given(seeds, st.floats(0.3, 20))
def test_host_cost_is_the_cost_of_host_system(seed: int, kernel_px: float) -> None:
    s = Edges(seed)
    s.weight[0, :3] = 0
    s.pose[1, 2, 3] -= 1.5  # some points of the second edge come behind the camera
    cost = host_cost(*s.args(), kernel_px)
    np.testing.assert_allclose(cost, host_system(*s.args(), kernel_px)[5], rtol=1e-12)
    r, z = edge_residuals(s.px, s.depth, s.target[1], s.pose[1], s.g)
    behind, c2 = z < MIN_DEPTH, kernel_px**2
    each = np.where(behind, 4 * c2, c2 * np.log1p((r**2).sum(1) / c2))
    assert cost[1] == pytest.approx((s.weight[1] * each).sum(), rel=1e-9)
    assert (r[behind] == 1e3).all()


@QUICK
@given(seeds, st.floats(0.5, 10))
def test_the_step_descends(seed: int, kernel_px: float) -> None:
    """b is minus half the gradient of the robust cost, so a short step along it lowers the cost."""
    s = Edges(seed, edges=1)
    rhs = host_system(*s.args(), kernel_px)[1][0]
    step = np.zeros(6)
    for i in range(6):
        step[:] = 0
        step[i] = 1e-6
        ends = []
        for sign in (1, -1):
            pose = (se3_exp(sign * step) @ s.pose[0])[None]
            ends.append(host_cost(s.px, s.depth, s.target, s.weight, pose, s.g, kernel_px)[0])
        gradient = (ends[0] - ends[1]) / 2e-6
        assert gradient == pytest.approx(-2 * rhs[i], rel=1e-4, abs=1e-3 * np.abs(rhs).max())


@QUICK
@given(seeds)
def test_pose_system_is_the_schur_complement_of_the_joint_system(seed: int) -> None:
    s = Edges(seed, edges=1)
    n = len(s.px)
    info = 10 ** np.random.default_rng(seed).uniform(-2, 6, n)
    ones = np.ones(n)
    found_h, found_b, _ = pose_system(s.px, s.depth, info, s.target[0], ones, s.pose[0], s.g, WIDE_PX)
    jac = s.jacobian(0)
    rows = np.zeros((2 * n, 6 + n))
    rows[:, :6] = jac[..., :6].reshape(2 * n, 6)
    for k in range(n):
        rows[2 * k : 2 * k + 2, 6 + k] = jac[k, :, 10]
    r = s.residual(np.zeros(11), s.pose[0], s.target[0]).reshape(-1)
    joint, rhs = rows.T @ rows, rows.T @ r
    joint[range(6, 6 + n), range(6, 6 + n)] += info
    gain = joint[:6, 6:] @ np.linalg.inv(joint[6:, 6:])
    close(found_h, joint[:6, :6] - gain @ joint[6:, :6], 1e-4)
    close(found_b[None], (rhs[:6] - gain @ rhs[6:])[None], 1e-3)


def test_sure_and_unknown_depths_are_the_limits_of_pose_system() -> None:
    s = Edges(3, edges=1)
    args = (s.target[0], s.weight[0], s.pose[0], s.g, WIDE_PX)
    sure, b, cost = pose_system(s.px, s.depth, np.full(len(s.px), 1e12), *args)
    hess, rhs, _, _, _, whole = host_system(*s.args(), WIDE_PX)
    np.testing.assert_allclose(sure, hess[0, :6, :6], rtol=1e-5, atol=1e-2)
    np.testing.assert_allclose(b, rhs[0, :6], rtol=1e-5, atol=1e-2)
    assert cost == pytest.approx(whole[0], rel=1e-6)
    unknown, _, free = pose_system(s.px, s.depth, np.zeros(len(s.px)), *args)
    assert free < cost and np.linalg.eigvalsh(sure - unknown).min() > -1e-6 * np.abs(sure).max()


def test_weight_zero_has_no_say() -> None:
    s = Edges(5, edges=1)
    s.target[0, 4] = np.nan
    s.weight[0, 4] = 0
    hess, rhs, *_, cost = host_system(*s.args(), 1.0)
    assert np.isfinite(hess).all() and np.isfinite(rhs).all() and np.isfinite(cost).all()


def spd(seed: int, n: int = 6) -> Array:
    a = np.random.default_rng(seed).normal(size=(n + 3, n))
    return a.T @ a


@QUICK
@given(seeds)
def test_damped_solve_solves(seed: int) -> None:
    hess, rhs = spd(seed), np.arange(6.0)
    step = damped_solve(hess, rhs, 0.0)
    assert step is not None
    np.testing.assert_allclose(hess @ step, rhs, atol=1e-4)
    damped = damped_solve(hess, rhs, 10.0)
    assert damped is not None and np.linalg.norm(damped) < np.linalg.norm(step)
    np.testing.assert_allclose((hess + 10 * np.diag(np.diag(hess))) @ damped, rhs, atol=1e-4)


def test_damped_solve_leaves_unobserved_unknowns_alone() -> None:
    hess = np.zeros((8, 8))
    hess[np.ix_([0, 1, 3, 4, 6, 7], [0, 1, 3, 4, 6, 7])] = spd(1)
    step = damped_solve(hess, np.ones(8), 1e-4)
    assert step is not None and (step[[2, 5]] == 0).all() and (step[[0, 1, 3]] != 0).all()
    nothing = damped_solve(np.zeros((4, 4)), np.ones(4), 1.0)
    assert nothing is not None and (nothing == 0).all()


@pytest.mark.parametrize(
    "hess",
    [
        np.array([[1.0, 2.0], [2.0, 1.0]]),  # indefinite
        np.array([[1.0, np.nan], [np.nan, 1.0]]),
        np.array([[1.0, np.inf], [np.inf, 1.0]]),
    ],
)
def test_damped_solve_says_none_where_there_is_no_minimum(hess: Array) -> None:
    assert damped_solve(hess, np.ones(2), 1e-6) is None


def test_damped_solve_says_none_for_a_right_side_that_is_not_finite() -> None:
    assert damped_solve(np.eye(2), np.array([1.0, np.nan]), 0.0) is None


def test_damped_solve_of_a_rank_one_system_is_finite_or_refused() -> None:
    step = damped_solve(np.ones((3, 3)), np.ones(3), 0.0)
    assert step is None or np.abs(step).max() < 10
