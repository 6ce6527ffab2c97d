"""The joint optimisation on keyframes of which everything is known."""

from __future__ import annotations

from collections.abc import Callable
from itertools import pairwise
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.sparse import csc_array

from mastd3r.geometry.least_squares import damped_solve
from mastd3r.geometry.reprojection_kernels import N_GLOBAL, edge_residuals
from mastd3r.geometry.se3 import inverse, se3_exp, se3_log
from mastd3r.geometry.sim3 import procrustes
from mastd3r.graph import bundle_adjustment
from mastd3r.graph.bundle_adjustment import solve
from mastd3r.graph.factors import KeyframeVariables, ReprojectionFactor, Variables
from mastd3r.graph.intrinsics import Intrinsics

Array = NDArray[Any]
VIEWS = 5


def edges_of(scene: Any, noise_px: float = 0.0, outliers: float = 0.0, seed: int = 5) -> list[ReprojectionFactor]:
    rng = np.random.default_rng(seed)
    edges = []
    for i in range(VIEWS):
        for j in range(VIEWS):
            if i == j:
                continue
            m = scene.matches(i, j, noise_px, seed)
            wrong = rng.random(len(scene.px)) < outliers
            target = m.new_px + wrong[:, None] * rng.uniform(-40, 40, m.new_px.shape)
            edges.append(ReprojectionFactor(i, j, target, m.weight))
    return edges


def blocks_of(scene: Any, pose_noise: float = 0.02, depth_noise: float = 0.15) -> Variables:
    """True blocks, disturbed; the first pose is exact and the depth priors are weak and wrong."""
    rng = np.random.default_rng(6)
    variables = {}
    for k in range(VIEWS):
        pose = scene.cam_from_world[k] @ inverse(scene.cam_from_world[0])
        if k:
            pose = se3_exp(rng.normal(0, pose_noise, 6)) @ pose
        inv_depth = np.exp(rng.normal(0, depth_noise, len(scene.px))) / scene.depth(k)
        variables[k] = KeyframeVariables(scene.px, inv_depth, inv_depth.copy(), np.full(len(scene.px), 1e-2), pose)
    return variables


def lens_of(scene: Any, focal_ratio: float = 1.0, k: float = 0.0, free: bool = True) -> Intrinsics:
    """A first lens of one term, centred where the scene's is; ``free``: focal length and k are unknown."""
    g = np.array([np.log(focal_ratio * scene.focal_px), k, *scene.lens[2:4], 0.0, 0.0])
    info = np.array([1e-6, 1.0, *[np.inf] * 4]) if free else np.full(N_GLOBAL, np.inf)
    return Intrinsics(g, g.copy(), info)


def whole_lens(scene: Any, focal_ratio: float = 1.1) -> Intrinsics:
    """Nothing known of any of the six: a centred pinhole as the first lens, weak priors."""
    centre = [(scene.width - 1) / 2, (scene.height - 1) / 2]
    g = np.array([np.log(focal_ratio * scene.focal_px), 0.0, *centre, 0.0, 0.0])
    return Intrinsics(g, g.copy(), np.array([1e-6, 1.0, 1e-4, 1e-4, 1.0, 1.0]))


def check(scene: Any, variables: Variables, position_ratio: float, turn_rad: float, depth_ratio: float) -> float:
    """Poses and depths against the truth after Sim(3); the limits are of the path and the depth. The scale."""
    found = np.stack([inverse(variables[k].cam_from_world) for k in range(VIEWS)])
    truth = np.stack([scene.cam_from_world[0] @ inverse(scene.cam_from_world[k]) for k in range(VIEWS)])
    path = np.linalg.norm(np.diff(truth[:, :3, 3], axis=0), axis=1).sum()
    fit = procrustes(truth[:, :3, 3], found[:, :3, 3], np.ones(VIEWS), with_scale=True)
    off = np.linalg.norm(fit.apply(found[:, :3, 3]) - truth[:, :3, 3], axis=1)
    assert off.max() < position_ratio * path
    for k in range(VIEWS):
        turn = se3_log(inverse(truth[k]) @ found[k])[3:]
        assert np.linalg.norm(turn) < turn_rad
        seen = variables[k].depth_info > 1
        assert seen.mean() > 0.5
        ratio = fit.scale / variables[k].inv_depth[seen] / scene.depth(k)[seen]
        assert np.median(np.abs(ratio - 1)) < depth_ratio
    return fit.scale


def test_exact_matches_give_the_exact_answer(exact_scene: Callable[..., Any]) -> None:
    scene = exact_scene(VIEWS, step=0.2)
    variables, lens = blocks_of(scene), lens_of(scene, free=False)
    for b in variables.values():
        b.prior_info = np.full(len(scene.px), 1e-9)
    report = solve(variables, edges_of(scene), lens, fixed=frozenset([0]), iterations=60, tolerance=1e-12)
    check(scene, variables, 1e-4, 1e-4, 1e-3)
    assert report.cost_last < 1e-6 * report.cost_first and report.focal_sigma_ratio == np.inf


@pytest.mark.parametrize("focal_error", [0.8, 1.2])
@pytest.mark.parametrize("k", [0.0, -0.06])
def test_unknown_lens_and_noise(exact_scene: Callable[..., Any], focal_error: float, k: float) -> None:
    """0.2 px of noise, a focal length 20 % off, an unknown radial term: all of it comes back."""
    scene = exact_scene(VIEWS, step=0.2, k=k, cell_px=12)
    variables, lens = blocks_of(scene), lens_of(scene, focal_error)
    report = solve(variables, edges_of(scene, 0.2), lens, fixed=frozenset([0]), iterations=60)
    assert np.exp(lens.values[0]) == pytest.approx(scene.focal_px, rel=0.01)
    assert lens.values[1] == pytest.approx(k, abs=0.015)
    assert (lens.values[2:] == scene.lens[2:]).all()
    check(scene, variables, 0.01, 0.005, 0.02)
    assert report.converged and report.cost_last < 0.05 * report.cost_first
    assert 0 < report.focal_sigma_ratio < 0.05


@pytest.mark.parametrize("held", [(2, 3, 4, 5), ()])
def test_sparse_equations_are_the_dense_ones(
    exact_scene: Callable[..., Any], monkeypatch: pytest.MonkeyPatch, held: tuple[int, ...]
) -> None:
    """The system of a long video, block by block and with parts made twice: the same steps, costs and sigma."""
    scene = exact_scene(VIEWS, step=0.2, k=-0.06, cell_px=12)
    ends = []
    for dense_most in (300, 0):
        monkeypatch.setattr(bundle_adjustment, "DENSE_MOST", dense_most)
        monkeypatch.setattr(bundle_adjustment, "AT_ONCE", 2 if dense_most == 0 else 64)
        variables, lens = blocks_of(scene), whole_lens(scene)
        lens.prior_info[list(held)] = np.inf
        edges = [e for e in edges_of(scene, 0.2) if abs(e.i - e.j) < 3]  # some blocks are empty
        report = solve(variables, edges, lens, fixed=frozenset([0]), iterations=6)
        ends.append((report, variables, lens.values))
    (dense, there, lens_there), (sparse, again, lens_again) = ends
    assert sparse.iterations == dense.iterations
    assert sparse.cost_last == pytest.approx(dense.cost_last, rel=1e-7)
    assert sparse.focal_sigma_ratio == pytest.approx(dense.focal_sigma_ratio, rel=1e-4)
    assert lens_again == pytest.approx(lens_there, rel=1e-5, abs=1e-6)
    for k in range(VIEWS):
        assert again[k].cam_from_world == pytest.approx(there[k].cam_from_world, abs=1e-5)
        assert again[k].inv_depth == pytest.approx(there[k].inv_depth, rel=1e-4)


def test_a_sparse_system_that_is_not_positive_is_refused() -> None:
    """As a dense one: by Cholesky there, by the signs of the pivots here; empty rows stay where they are."""
    rng = np.random.default_rng(0)
    root = rng.normal(size=(8, 8))
    good, rhs = root @ root.T, rng.normal(size=8)
    good[5], good[:, 5] = 0.0, 0.0
    bad = good.copy()
    bad[2, 3] = bad[3, 2] = 100.0
    for hess in (good, csc_array(good)):
        step = damped_solve(hess, rhs, 1e-3)
        assert step is not None and step[5] == 0
        assert step == pytest.approx(damped_solve(good, rhs, 1e-3), rel=1e-9)
    assert damped_solve(bad, rhs, 1e-3) is None and damped_solve(csc_array(bad), rhs, 1e-3) is None


def test_all_six_unknowns_of_the_lens_come_back(exact_scene: Callable[..., Any]) -> None:
    """Exact matches, three radial terms, a principal point 6 px off: the lens is right wherever there are pixels.

    Single terms share what they say over the picture, so the terms are held together: where they send its pixels.
    """
    scene = exact_scene(VIEWS, step=0.3, k=-0.08, higher=(0.06, -0.03), off_centre_px=(6.0, -4.0))
    variables, lens = blocks_of(scene, 0.01, 0.05), whole_lens(scene)
    for b in variables.values():
        b.prior_info = np.full(len(scene.px), 1e-6)
    lens.prior_info = 1e-6 * lens.prior_info
    report = solve(variables, edges_of(scene), lens, fixed=frozenset([0]), iterations=200, tolerance=1e-12)
    assert report.cost_last < 1e-6 * report.cost_first
    assert np.exp(lens.values[0]) == pytest.approx(scene.focal_px, rel=1e-3)
    np.testing.assert_allclose(lens.values[2:4], scene.centre_px, atol=0.1)
    np.testing.assert_allclose(rays_of(lens.values, scene.px), scene.rays(scene.px)[:, :2], atol=2e-4)
    check(scene, variables, 1e-3, 1e-3, 2e-3)


def rays_of(g: Array, px: Array) -> Array:
    e = (px - g[2:4]) / np.exp(g[0])
    r2 = (e**2).sum(1, keepdims=True)
    return np.asarray(e * (1 + g[1] * r2 + g[4] * r2**2 + g[5] * r2**3))


def test_noise_leaves_the_whole_lens_within_a_fraction_of_a_pixel(exact_scene: Callable[..., Any]) -> None:
    """0.2 px of noise, all six unknown: a pixel's ray is off by less than a pixel's width, in the median by a third."""
    scene = exact_scene(VIEWS, step=0.3, k=-0.08, higher=(0.03, 0.0), off_centre_px=(5.0, 3.0), cell_px=12)
    variables, lens = blocks_of(scene), whole_lens(scene)
    solve(variables, edges_of(scene, 0.2), lens, fixed=frozenset([0]), iterations=60)
    assert np.exp(lens.values[0]) == pytest.approx(scene.focal_px, rel=0.01)
    # a shift of all rays is a turn of all cameras: what is left after the mean is the lens's shape
    off_px = scene.focal_px * (rays_of(lens.values, scene.px) - scene.rays(scene.px)[:, :2])
    off_px = np.linalg.norm(off_px - off_px.mean(0), axis=1)
    assert np.median(off_px) < 0.35 and np.percentile(off_px, 95) < 1.0
    check(scene, variables, 0.02, 0.02, 0.03)


def dense_step(
    variables: Variables, edges: list[ReprojectionFactor], lens: Intrinsics, damping: float
) -> tuple[Array, Array]:
    """One damped Gauss-Newton step without a Schur complement: Jacobian by differences, every unknown in one system.

    Unknowns: poses of all blocks but the first, the lens, all depths. Returns (poses and lens, depths).
    """
    moving = sorted(variables)[1:]
    counts = [len(variables[k].px) for k in sorted(variables)]
    starts = dict(zip(sorted(variables), np.cumsum([0, *counts[:-1]]), strict=True))
    head = 6 * len(moving) + N_GLOBAL
    size = head + sum(counts)

    def residuals(x: Array) -> Array:
        poses = {k: b.cam_from_world for k, b in variables.items()}
        for n, k in enumerate(moving):
            poses[k] = se3_exp(x[6 * n : 6 * n + 6]) @ poses[k]
        out = []
        for e in edges:
            b = variables[e.i]
            depth = b.inv_depth + x[head + starts[e.i] :][: len(b.px)]
            r, _ = edge_residuals(
                b.px, depth, e.target, poses[e.j] @ inverse(poses[e.i]), lens.values + x[head - 6 : head]
            )
            out.append(np.sqrt(e.weight)[:, None] * r)
        return np.concatenate(out).reshape(-1)

    step = np.full(size, 1e-6)
    step[head - 4 : head - 2] = 1e-3
    jac = np.stack([-(residuals(d) - residuals(-d)) / (2 * h) for d, h in zip(np.diag(step), step, strict=True)], -1)
    hess, rhs = jac.T @ jac, jac.T @ residuals(np.zeros(size))
    lens_at = np.arange(head - N_GLOBAL, head)
    hess[lens_at, lens_at] += lens.prior_info
    rhs[lens_at] += lens.prior_info * (lens.prior - lens.values)
    depths = np.arange(head, size)
    info = np.concatenate([variables[k].prior_info for k in sorted(variables)])
    behind = np.concatenate([variables[k].prior_depth - variables[k].inv_depth for k in sorted(variables)])
    hess[depths, depths] += info
    rhs[depths] += info * behind
    reduced = hess[:head, :head] - hess[:head, head:] @ np.linalg.solve(hess[head:, head:], hess[head:, :head])
    hess[range(head), range(head)] += damping * np.diag(reduced)  # the solver damps what is left after the depths
    x = np.linalg.solve(hess, rhs)
    return x[:head], x[head:]


def test_one_step_is_that_of_the_dense_system(exact_scene: Callable[..., Any]) -> None:
    """All six lens unknowns, three views, a kernel so wide that it is none: the step of the plain twin."""
    scene = exact_scene(VIEWS, step=0.3, cell_px=60, k=-0.05, higher=(0.03, -0.02), off_centre_px=(3.0, 2.0))
    variables = {k: b for k, b in blocks_of(scene, 0.003, 0.02).items() if k < 3}
    for b in variables.values():
        b.prior_depth = 1.02 * b.inv_depth
        b.prior_info = np.full(len(b.px), 30.0)
    edges = [e for e in edges_of(scene, 0.2) if max(e.i, e.j) < 3]
    lens = whole_lens(scene, 1.02)
    lens.prior_info = np.array([50.0, 400.0, 0.5, 0.5, 100.0, 100.0])
    lens.values = lens.values + np.array([0.0, -0.03, 1.0, 1.0, 0.01, 0.01])
    before = {k: (b.cam_from_world, b.inv_depth) for k, b in variables.items()}
    g = lens.values.copy()
    poses_lens, depths = dense_step(variables, edges, lens, 1e-4)
    report = solve(variables, edges, lens, fixed=frozenset([0]), iterations=1, kernel_px=1e6)
    assert report.cost_last < report.cost_first
    np.testing.assert_allclose(lens.values - g, poses_lens[-N_GLOBAL:], rtol=2e-3, atol=2e-5)
    for n, k in enumerate((1, 2)):
        moved = se3_log(variables[k].cam_from_world @ inverse(before[k][0]))
        np.testing.assert_allclose(moved, poses_lens[6 * n : 6 * n + 6], rtol=2e-3, atol=2e-5)
    found = np.concatenate([variables[k].inv_depth - before[k][1] for k in range(3)])
    np.testing.assert_allclose(found, depths, rtol=5e-3, atol=5e-5)


def test_a_fifth_of_the_matches_may_be_wrong(exact_scene: Callable[..., Any]) -> None:
    scene = exact_scene(VIEWS, step=0.2, cell_px=12)
    variables, lens = blocks_of(scene), lens_of(scene, 1.1)
    edges = edges_of(scene, 0.2, outliers=0.2)
    solve(variables, edges, lens, fixed=frozenset([0]), iterations=30, kernel_px=2.0)
    solve(variables, edges, lens, fixed=frozenset([0]), iterations=40, kernel_px=0.5)
    assert np.exp(lens.values[0]) == pytest.approx(scene.focal_px, rel=0.01)
    check(scene, variables, 0.02, 0.01, 0.03)


@pytest.mark.parametrize("outliers", [0.0, 0.2])
def test_noise_does_not_pull_the_lens_one_way(exact_scene: Callable[..., Any], outliers: float) -> None:
    """The mean over eight draws of the noise is the truth: a cost that falls with k alone would not pass."""
    scene = exact_scene(VIEWS, step=0.3)
    focal, radial = [], []
    for seed in range(8):
        variables, lens = blocks_of(scene), lens_of(scene, 1.1)
        edges = edges_of(scene, 0.2, outliers, seed)
        solve(variables, edges, lens, fixed=frozenset([0]), iterations=25, kernel_px=2.0)
        solve(variables, edges, lens, fixed=frozenset([0]), iterations=25, kernel_px=0.5)
        focal.append(np.exp(lens.values[0]) / scene.focal_px - 1)
        radial.append(lens.values[1])
    assert abs(np.mean(focal)) < 0.003 and abs(np.mean(radial)) < 0.002


def test_without_matches_nothing_moves(exact_scene: Callable[..., Any]) -> None:
    scene = exact_scene(VIEWS)
    variables = blocks_of(scene)
    before = {k: (b.cam_from_world.copy(), b.inv_depth.copy()) for k, b in variables.items()}
    report = solve(variables, [], lens_of(scene), fixed=frozenset([0]), iterations=5)
    assert report.cost_last == 0
    for k, b in variables.items():
        assert (b.cam_from_world == before[k][0]).all() and (b.inv_depth == before[k][1]).all()


def test_a_scene_behind_the_cameras_is_turned_to_the_front(exact_scene: Callable[..., Any]) -> None:
    """Depths and translations negated explain every match as well; a solver may end there, nobody wants it to."""
    scene = exact_scene(VIEWS)
    variables, lens = blocks_of(scene, 0.0, 0.0), lens_of(scene, free=False)
    truth = {k: b.cam_from_world.copy() for k, b in variables.items()}
    for b in variables.values():
        b.cam_from_world[:3, 3] *= -1
        b.inv_depth, b.prior_info = -b.inv_depth, 1e-6 * b.prior_info
    solve(variables, edges_of(scene), lens, fixed=frozenset([0]), iterations=5)
    for k, b in variables.items():
        assert (b.inv_depth > 0).all()
        np.testing.assert_allclose(b.cam_from_world, truth[k], atol=1e-3)


def test_fixed_poses_stay_to_the_last_bit(exact_scene: Callable[..., Any]) -> None:
    scene = exact_scene(VIEWS, step=0.2)
    variables, lens = blocks_of(scene), lens_of(scene)
    before = {k: b.cam_from_world.copy() for k, b in variables.items()}
    solve(variables, edges_of(scene, 0.2), lens, fixed=frozenset([0, 2, 3]), iterations=5)
    for k in range(VIEWS):
        same = (variables[k].cam_from_world == before[k]).all()
        assert same == (k in (0, 2, 3))
        assert (variables[k].inv_depth > 0).all()


def test_fixed_intrinsics_stay(exact_scene: Callable[..., Any]) -> None:
    scene = exact_scene(VIEWS, step=0.2)
    lens = lens_of(scene, 1.2, free=False)
    before = lens.values.copy()
    solve(blocks_of(scene), edges_of(scene, 0.2), lens, fixed=frozenset([0]), iterations=5)
    assert (lens.values == before).all()
    half = Intrinsics(before.copy(), before, np.array([1e-6, *[np.inf] * 5]))
    solve(blocks_of(scene), edges_of(scene, 0.2), half, fixed=frozenset([0]), iterations=15)
    assert half.values[0] != before[0] and (half.values[1:] == before[1:]).all()


def test_measured_depths_fix_the_scale(exact_scene: Callable[..., Any]) -> None:
    """Depth priors of a sensor hold the metric scale, which matches alone leave free."""
    scene = exact_scene(VIEWS, step=0.2)
    variables = blocks_of(scene)
    for k, b in variables.items():
        b.prior_depth = 1 / scene.depth(k)
        b.prior_info = 1 / (0.02 * b.prior_depth) ** 2
    solve(variables, edges_of(scene, 0.2), lens_of(scene), fixed=frozenset([0]), iterations=40)
    assert check(scene, variables, 0.01, 0.005, 0.02) == pytest.approx(1.0, abs=0.01)


def test_the_cost_never_rises(exact_scene: Callable[..., Any]) -> None:
    scene = exact_scene(VIEWS, step=0.2)
    variables, lens, edges = blocks_of(scene), lens_of(scene, 0.8), edges_of(scene, 0.2, outliers=0.1)
    costs = []
    for _ in range(12):
        report = solve(variables, edges, lens, fixed=frozenset([0]), iterations=1)
        costs += [report.cost_first, report.cost_last]
    assert all(b <= a * (1 + 1e-6) for a, b in pairwise(costs))


def test_a_keyframe_without_matches_stays_where_it_is(exact_scene: Callable[..., Any]) -> None:
    scene = exact_scene(VIEWS, step=0.2)
    variables = blocks_of(scene)
    before, depth = variables[4].cam_from_world.copy(), variables[4].inv_depth.copy()
    edges = [e for e in edges_of(scene, 0.2) if 4 not in (e.i, e.j)]
    report = solve(variables, edges, lens_of(scene), fixed=frozenset([0]), iterations=20)
    np.testing.assert_allclose(variables[4].cam_from_world, before, atol=1e-12)
    np.testing.assert_allclose(variables[4].inv_depth, depth)
    assert np.isfinite(report.cost_last)


def with_points_at_infinity(scene: Any, edges: list[ReprojectionFactor], far: Array, noise_px: float) -> None:
    """Matches of the pixels ``far`` become those of points that no translation moves; all get noise."""
    rng = np.random.default_rng(7)
    rays = np.concatenate([(scene.px - scene.lens[2:4]) / scene.focal_px, np.ones((len(scene.px), 1))], 1)
    for e in edges:
        seen = rays @ scene.j_from_i(e.i, e.j)[:3, :3].T
        e.target[far] = (scene.lens[2:4] + scene.focal_px * seen[:, :2] / seen[:, 2:])[far]
        e.target += rng.normal(0, noise_px, e.target.shape)


def test_points_at_infinity_neither_bend_the_lens_nor_stop_the_solver(exact_scene: Callable[..., Any]) -> None:
    """Noise asks half of them to be further than infinity: from both sides the same lens is found, and the right one.

    Where an inverse depth can only be positive, poses and lens count on it to move and no step is good.
    """
    scene = exact_scene(VIEWS, step=0.2, cell_px=12)
    far = np.random.default_rng(3).random(len(scene.px)) < 0.7
    found, costs = [], []
    for focal_error in (1.15, 0.9):
        variables, lens, edges = blocks_of(scene), lens_of(scene, focal_error), edges_of(scene)
        with_points_at_infinity(scene, edges, far, 0.5)
        for b in variables.values():
            b.inv_depth[far] = b.prior_depth[far] = 1e-6
        report = solve(variables, edges, lens, fixed=frozenset([0]), iterations=60, tolerance=1e-5)
        assert report.converged
        assert all((b.inv_depth > 0).all() for b in variables.values())
        found.append(float(np.exp(lens.values[0])))
        costs.append(report.cost_last)
    assert found == pytest.approx([scene.focal_px] * 2, rel=0.003)
    assert costs[0] == pytest.approx(costs[1], rel=1e-3)
