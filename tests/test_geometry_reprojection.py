"""The solver's kernels against finite differences and dense algebra, and the damped solve."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from mastd3r.geometry.anchor_matches import AnchorMatches
from mastd3r.geometry.least_squares import damped_solve
from mastd3r.geometry.reprojection_kernels import (
    MIN_DEPTH,
    N_COLS,
    anchor_cost,
    anchor_system,
    edge_residuals,
    fold_radius,
    pose_system,
)
from mastd3r.geometry.se3 import se3_exp

Array = NDArray[Any]
QUICK = settings(max_examples=25, deadline=None)
WIDE_PX = 1e7  # a kernel so wide that it is none
DEPTH = N_COLS  # index of the depth's column, behind pose and lens
STEP = np.array([1e-6] * 6 + [1e-6, 1e-5, 1e-3, 1e-3, 1e-4, 3e-4] + [1e-6])  # of each unknown, for differences
seeds = st.integers(0, 10**6)


class Edges:
    """Random edges of one anchor: pixels, depths, targets a few pixels from their predictions, a lens of three terms.

    Drawn again where a point falls behind a camera or beyond the fold of the lens: nothing has a derivative there.
    """

    def __init__(self, seed: int, edges: int = 2, points: int = 12) -> None:
        rng = np.random.default_rng(seed)
        self._draw(rng, edges, points)
        while not self._all_seen():
            self._draw(rng, edges, points)
        self.target = np.stack(
            [self.px - self.residual(np.zeros(DEPTH + 1), t, self.px) for t in self.pose]
        ) + rng.normal(0, 3, (edges, points, 2))

    def _draw(self, rng: np.random.Generator, edges: int, points: int) -> None:
        focal, k, m, n = rng.uniform([240, -0.1, -0.08, -0.05], [500, 0.15, 0.1, 0.1])
        self.g = np.array([np.log(focal), k, *rng.uniform([150, 112], [165, 125]), m, n])
        self.px = rng.uniform([0, 0], [320, 240], (points, 2))
        self.depth = rng.uniform(0.1, 1.0, points)
        self.pose = np.stack([se3_exp(rng.uniform(-0.12, 0.12, 6)) for _ in range(edges)])
        self.weight = rng.uniform(0.1, 1, (edges, points))

    def _all_seen(self) -> bool:
        steps = [np.zeros(DEPTH + 1), *np.diag(STEP), *-np.diag(STEP)]
        return all((self._project(x, t, self.px)[1] > MIN_DEPTH).all() for x in steps for t in self.pose)

    def _project(self, x: Array, pose: Array, target: Array) -> tuple[Array, Array]:
        return edge_residuals(self.px, self.depth + x[DEPTH], target, se3_exp(x[:6]) @ pose, self.g + x[6:DEPTH])

    def residual(self, x: Array, pose: Array, target: Array) -> Array:
        """(p, 2) residuals after a step x = [pose (6), lens (6), depth]."""
        r, z = self._project(x, pose, target)
        assert (z > MIN_DEPTH).all()
        return r

    def jacobian(self, e: int) -> Array:
        """(p, 2, 13) of the prediction, by central differences: minus that of the residual.

        Richardson's extrapolation takes out their second-order error, which is large near the fold of a lens.
        """
        columns = []
        for i in range(DEPTH + 1):
            wide, narrow = (self._difference(e, i, h) for h in (STEP[i], STEP[i] / 2))
            columns.append(-(4 * narrow - wide) / 3)
        return np.stack(columns, -1)

    def _difference(self, e: int, i: int, h: float) -> Array:
        step = np.zeros(DEPTH + 1)
        step[i] = h
        high = self.residual(step, self.pose[e], self.target[e])
        return (high - self.residual(-step, self.pose[e], self.target[e])) / (2 * h)

    def args(self) -> tuple[Any, ...]:
        return self.px, self.depth, AnchorMatches.of(self.target, self.weight), self.pose, self.g

    def each(self, cross: Array) -> Array:
        """(m, p, 12) of what is one row a match with weight."""
        out = np.zeros((*self.weight.shape, N_COLS))
        out[self.weight > 0] = cross
        return out


def close(found: Array, wanted: Array, tolerance: float = 2e-5) -> None:
    """Equal up to ``tolerance`` of the largest entry of each column (units differ between columns).

    Differences carry the rounding of the whole residual, so a column below 1e-8 of the largest one says nothing.
    """
    size = np.abs(wanted).reshape(-1, wanted.shape[-1]).max(0) + 1e-8 * np.abs(wanted).max() + 1e-9
    np.testing.assert_allclose(found / size, wanted / size, atol=tolerance)


@QUICK
@given(seeds)
def test_all_columns_and_the_depth_agree_with_finite_differences(seed: int) -> None:
    s = Edges(seed)
    s.weight[:, 3] = 0
    hess, rhs, cross, hdd, bd, cost = anchor_system(*s.args(), WIDE_PX)
    own_info, own_b = np.zeros(len(s.px)), np.zeros(len(s.px))
    for e in range(len(s.pose)):
        r = s.residual(np.zeros(DEPTH + 1), s.pose[e], s.target[e])
        jac, w = s.jacobian(e), s.weight[e]
        j, jd = jac[..., :DEPTH], jac[..., DEPTH]
        close(hess[e], np.einsum("p,pri,prj->ij", w, j, j))
        close(rhs[e][None], np.einsum("p,pri,pr->i", w, j, r)[None], 1e-4)
        close(s.each(cross)[e], np.einsum("p,pri,pr->pi", w, j, jd))
        own_info += np.einsum("p,pr,pr->p", w, jd, jd)
        own_b += np.einsum("p,pr,pr->p", w, jd, r)
        assert cost[e] == pytest.approx((w * (r**2).sum(1)).sum(), rel=1e-5)
    close(hdd[:, None], own_info[:, None])
    np.testing.assert_allclose(bd, own_b, rtol=1e-4, atol=1e-3)


@QUICK
@given(seeds)
def test_without_the_lens_its_columns_stay_empty_and_all_else_is_the_same(seed: int) -> None:
    s = Edges(seed)
    for whole, part in zip(anchor_system(*s.args(), WIDE_PX), anchor_system(*s.args(), WIDE_PX, False), strict=True):
        own = np.zeros_like(whole)
        pose = (slice(None), *(slice(6) for _ in range(whole.ndim - 1)))
        own[pose] = whole[pose]
        np.testing.assert_allclose(part, own, rtol=1e-6, atol=1e-9 * np.abs(whole).max())


@QUICK
@given(seeds)
def test_each_column_by_itself(seed: int) -> None:
    """One match at a time: H determines its two-row Jacobian up to a rotation, and b and E fix that."""
    s = Edges(seed, edges=1, points=1)
    jac = s.jacobian(0)[0]
    hess, rhs, cross, hdd, _, _ = anchor_system(*s.args(), WIDE_PX)
    w = s.weight[0, 0]
    close(np.sqrt(np.diag(hess[0]))[None], np.sqrt(w) * np.linalg.norm(jac[:, :DEPTH], axis=0)[None], 1e-4)
    close(cross, w * (jac[:, :DEPTH].T @ jac[:, DEPTH])[None], 1e-4)
    r = s.residual(np.zeros(DEPTH + 1), s.pose[0], s.target[0])[0]
    close(rhs[0][None], w * (jac[:, :DEPTH].T @ r)[None], 1e-3)
    assert hdd[0] == pytest.approx(w * (jac[:, DEPTH] ** 2).sum(), rel=1e-4)


@QUICK
@given(seeds, st.floats(0.3, 20))
def test_host_cost_is_the_cost_of_host_system(seed: int, kernel_px: float) -> None:
    s = Edges(seed)
    s.weight[0, :3] = 0
    s.pose[1, 2, 3] -= 1.5  # some points of the second edge come behind the camera
    cost = anchor_cost(*s.args(), kernel_px)
    np.testing.assert_allclose(cost, anchor_system(*s.args(), kernel_px)[5], rtol=1e-12)
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
    rhs = anchor_system(*s.args(), kernel_px)[1][0]
    step = np.zeros(6)
    for i in range(6):
        step[:] = 0
        step[i] = 1e-6
        ends = []
        for sign in (1, -1):
            pose = (se3_exp(sign * step) @ s.pose[0])[None]
            ends.append(anchor_cost(*s.args()[:3], pose, s.g, kernel_px)[0])
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
        rows[2 * k : 2 * k + 2, 6 + k] = jac[k, :, DEPTH]
    r = s.residual(np.zeros(DEPTH + 1), s.pose[0], s.target[0]).reshape(-1)
    joint, rhs = rows.T @ rows, rows.T @ r
    joint[range(6, 6 + n), range(6, 6 + n)] += info
    gain = joint[:6, 6:] @ np.linalg.inv(joint[6:, 6:])
    close(found_h, joint[:6, :6] - gain @ joint[6:, :6], 1e-4)
    close(found_b[None], (rhs[:6] - gain @ rhs[6:])[None], 1e-3)


def plain_residual(s: Edges, e: int, n: int) -> Array:
    """One residual written out from the definition, the lens inverted by bisection."""
    f, k, centre, m, n3 = np.exp(s.g[0]), s.g[1], s.g[2:4], s.g[4], s.g[5]

    def distorted(r: float) -> float:
        return float(r * (1 + k * r**2 + m * r**4 + n3 * r**6))

    at = (s.px[n] - centre) / f
    radius = float(np.linalg.norm(at))
    point = s.pose[e][:3, :3] @ [*(at * distorted(radius) / radius), 1.0] + s.pose[e][:3, 3] * s.depth[n]
    q = point[:2] / point[2]
    low, high = 0.0, fold_radius(k, m, n3)[0]  # one root in there, as the slope is positive
    for _ in range(80):
        middle = 0.5 * (low + high)
        low, high = (middle, high) if distorted(middle) < np.linalg.norm(q) else (low, middle)
    return np.asarray(s.target[e, n] - centre - f * low * q / np.linalg.norm(q))


@QUICK
@given(seeds)
def test_the_residual_is_the_one_of_the_definition(seed: int) -> None:
    s = Edges(seed)
    for e in range(2):
        found, _ = edge_residuals(s.px, s.depth, s.target[e], s.pose[e], s.g)
        np.testing.assert_allclose(found, [plain_residual(s, e, n) for n in range(len(s.px))], atol=1e-4)


@pytest.mark.parametrize(
    "terms", [(-0.3, 0.0, 0.0), (-0.5, 0.0, 0.0), (0.0, -0.2, 0.0), (0.1, 0.0, -0.1), (0.2, -0.3, 0.02)]
)
def test_the_fold_is_where_the_slope_falls_below_a_tenth(terms: tuple[float, float, float]) -> None:
    k, m, n = terms

    def slope(r: float) -> float:
        return 1 + 3 * k * r**2 + 5 * m * r**4 + 7 * n * r**6

    bent_r, straight_r = fold_radius(*terms)
    assert 0 < bent_r < 2.99
    assert slope(bent_r) >= 0.1 > slope(bent_r + 0.0101)
    assert min(slope(r) for r in np.linspace(0, bent_r, 200)) >= 0.1 - 1e-6
    assert straight_r == pytest.approx(bent_r * (1 + k * bent_r**2 + m * bent_r**4 + n * bent_r**6), rel=1e-6)


def test_lenses_that_never_fold() -> None:
    assert min(fold_radius(0.0, 0.0, 0.0)) > 1e8
    assert fold_radius(0.1, 0.05, 0.0)[0] == pytest.approx(3.0, abs=0.011)  # as far as anything is looked for


def test_beyond_the_fold_a_point_costs_what_one_behind_the_camera_does() -> None:
    """No pixel shows it: it has a fixed cost and no slope, and points within the fold are not touched by it."""
    g = np.array([np.log(200.0), -0.3, 160.0, 120.0, 0.0, 0.0])
    _, straight_r = fold_radius(g[1], g[4], g[5])
    depth, pose = np.ones(2), np.eye(4)
    pose[0, 3] = straight_r + 0.05  # the principal point's ray lands just beyond the fold
    px = np.array([[160.0, 120.0], [160.0 - 150.0, 120.0]])
    target, weight = px[None].copy(), np.array([[0.5, 0.8]])
    r, z = edge_residuals(px, depth, target[0], pose, g)
    assert (r[0] == 1e3).all() and z[0] < MIN_DEPTH and z[1] == pytest.approx(1.0) and np.abs(r[1]).max() < 400
    both, one = AnchorMatches.of(target, weight), AnchorMatches.of(target[:, 1:], weight[:, 1:])
    hess, rhs, cross, hdd, bd, cost = anchor_system(px, depth, both, pose[None], g, 2.0)
    alone = anchor_system(px[1:], depth[1:], one, pose[None], g, 2.0)
    np.testing.assert_allclose(hess, alone[0])
    np.testing.assert_allclose(rhs, alone[1])
    assert (cross[0] == 0).all() and hdd[0] == bd[0] == 0
    assert cost[0] == pytest.approx(alone[5][0] + 0.5 * 4 * 2.0**2)
    np.testing.assert_allclose(anchor_cost(px, depth, both, pose[None], g, 2.0), cost)
    pose_hess, _, pose_cost = pose_system(px, depth, np.ones(2), target[0], weight[0], pose, g, 2.0)
    one_hess, _, one_cost = pose_system(px[1:], depth[1:], np.ones(1), target[0, 1:], weight[0, 1:], pose, g, 2.0)
    np.testing.assert_allclose(pose_hess, one_hess)
    assert pose_cost == pytest.approx(one_cost + 0.5 * 4 * 2.0**2)


def test_the_lens_is_inverted_up_to_the_fold() -> None:
    """Without a motion every pixel predicts itself, to where the lens is almost flat."""
    for k, m, n in ((-0.3, 0.0, 0.0), (-0.2, 0.05, -0.02), (0.3, 0.1, 0.05), (0.15, -0.3, 0.02)):
        g = np.array([np.log(200.0), k, 160.0, 120.0, m, n])
        fold, _ = fold_radius(k, m, n)
        radius = 200.0 * np.linspace(0.01, min(0.97 * fold, 1.4), 30)
        px = np.stack([160 + radius * 0.8, 120 + radius * 0.6], 1)
        r, z = edge_residuals(px, np.ones(30), px, np.eye(4), g)
        assert (z > MIN_DEPTH).all() and np.abs(r).max() < 1e-3


def test_sure_and_unknown_depths_are_the_limits_of_pose_system() -> None:
    s = Edges(3, edges=1)
    args = (s.target[0], s.weight[0], s.pose[0], s.g, WIDE_PX)
    sure, b, cost = pose_system(s.px, s.depth, np.full(len(s.px), 1e12), *args)
    hess, rhs, _, _, _, whole = anchor_system(*s.args(), WIDE_PX)
    np.testing.assert_allclose(sure, hess[0, :6, :6], rtol=1e-5, atol=1e-2)
    np.testing.assert_allclose(b, rhs[0, :6], rtol=1e-5, atol=1e-2)
    assert cost == pytest.approx(whole[0], rel=1e-6)
    unknown, _, free = pose_system(s.px, s.depth, np.zeros(len(s.px)), *args)
    assert free < cost and np.linalg.eigvalsh(sure - unknown).min() > -1e-6 * np.abs(sure).max()


def test_weight_zero_has_no_say() -> None:
    s = Edges(5, edges=1)
    s.target[0, 4] = np.nan
    s.weight[0, 4] = 0
    hess, rhs, *_, cost = anchor_system(*s.args(), 1.0)
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
