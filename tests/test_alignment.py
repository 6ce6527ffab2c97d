"""Coarse-to-fine alignment of a pair whose motion is known."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from mastd3r.alignment.align import align
from mastd3r.alignment.coarse import icp, resect
from mastd3r.alignment.fine import OwnPoints, align_fine, chamfer_pairs, point_terms
from mastd3r.alignment.problem import AlignmentProblem
from mastd3r.alignment.reproject import StaticMatches, solve_pose
from mastd3r.alignment.result import Alignment
from mastd3r.alignment.scale import correct_scale, patch_scale
from mastd3r.config import AlignmentConfig, CorrectionKind
from mastd3r.geometry.se3 import inverse, se3_exp, se3_log, transform
from mastd3r.registry import ALIGNMENT
from mastd3r.types import PairPrediction, Pointmap

Array = NDArray[Any]
SIGMA_RATIO = 0.02
CORRECTIONS = ALIGNMENT.choices


class Pair:
    """Two views of the exact scene: noisy matches, noisy depths, and own points of new at a wrong scale."""

    def __init__(
        self,
        scene: Any,
        *,
        own_scale: float = 1.0,
        noise_px: float = 0.0,
        depth_noise: float = 0.0,
        outliers: float = 0.0,
        with_own: bool = True,
        seed: int = 0,
    ) -> None:
        rng = np.random.default_rng(seed)
        self.truth = scene.j_from_i(0, 1)
        matches = scene.matches(0, 1, noise_px, seed)
        wrong = rng.random(len(scene.px)) < outliers
        target = matches.new_px + wrong[:, None] * rng.uniform(-40, 40, matches.new_px.shape)
        self.wrong = wrong & (matches.weight > 0)
        inv_depth = (1 + depth_noise * rng.normal(size=len(scene.px))) / scene.depth(0)
        info = 1 / (max(depth_noise, 1e-3) * inv_depth) ** 2
        weight = matches.weight
        self.matches = StaticMatches(scene.px, inv_depth, info, target, weight, scene.lens)
        ref = scene.rays(scene.px) / inv_depth[:, None]
        depth = scene.depth(1, target) * (1 + depth_noise * rng.normal(size=len(target)))
        own = own_scale * scene.rays(target) * depth[:, None]
        flow = np.zeros((scene.height, scene.width, 2), np.float32)
        self.pair = PairPrediction(
            replace(matches, new_px=target),
            Pointmap(scene.px, ref, np.ones(len(ref))),
            Pointmap(target, own, weight) if with_own else None,
            flow,
        )
        self.ref, self.own, self.weight = ref, own, weight

    def align(self, correction: CorrectionKind, guess: Array | None = None) -> Alignment:
        start = np.eye(4) if guess is None else guess
        problem = AlignmentProblem(self.pair, self.matches.weight, self.matches, start, SIGMA_RATIO)
        return align(ALIGNMENT.create(correction, AlignmentConfig()), problem)

    def error(self, new_from_ref: Array) -> float:
        """Length of the twist between found and true pose, map units and radians."""
        return float(np.linalg.norm(se3_log(new_from_ref @ inverse(self.truth))))


@pytest.fixture(scope="module")
def scene(exact_scene: Callable[..., Any]) -> Any:
    return exact_scene(2, step=0.25, k=-0.05)


def test_a_cloud_scaled_by_1_7_comes_back_with_its_inverse(scene: Any) -> None:
    """Eq. (9), the right way round: s brings new's own points to ref's scale."""
    pair = Pair(scene, own_scale=1.7)
    found = correct_scale(pair.ref, pair.own, pair.matches.target, pair.weight, pair.truth)
    assert found == pytest.approx(1 / 1.7, rel=1e-6)
    for correction in ("coarse", "fine", "coarse-to-fine"):
        assert pair.align(correction).scale == pytest.approx(1 / 1.7, rel=0.02), correction


def test_patch_scale_is_a_median_of_patches_that_know_enough() -> None:
    rng = np.random.default_rng(0)
    new = rng.uniform(1, 3, 200)
    patch = np.repeat(np.arange(20), 10)
    pre = new / 1.7
    pre[patch < 6] *= 3.0  # a moving thing covers 6 of 20 patches
    weight = np.ones(200)
    assert patch_scale(pre, new, patch, weight) == pytest.approx(1 / 1.7)
    pre[patch == 7], weight[patch == 7] = 99.0, 0.0
    assert patch_scale(pre, new, patch, weight) == pytest.approx(1 / 1.7)
    assert patch_scale(pre, new, patch, np.zeros(200)) == 1.0
    assert patch_scale(pre[:4], new[:4], patch[:4], np.ones(4)) == 1.0


def test_icp_recovers_a_motion_under_30_percent_outliers(scene: Any) -> None:
    rng = np.random.default_rng(1)
    ref = scene.points(0)
    new = transform(scene.j_from_i(0, 1), ref) * (1 + 0.002 * rng.normal(size=(len(ref), 1)))
    wrong = rng.random(len(ref)) < 0.3
    new[wrong] += rng.uniform(-1.5, 1.5, (int(wrong.sum()), 3)) * new[wrong, 2:]
    report = icp(ref, new, np.ones(len(ref)), np.eye(4))
    off = se3_log(report.new_from_ref @ inverse(scene.j_from_i(0, 1)))
    assert np.linalg.norm(off) < 0.02
    assert report.inlier_ratio > 0.5


def test_icp_on_exact_points_is_exact_and_converges(scene: Any) -> None:
    ref, truth = scene.points(0), scene.j_from_i(0, 1)
    report = icp(ref, transform(truth, ref), np.ones(len(ref)), np.eye(4))
    np.testing.assert_allclose(report.new_from_ref, truth, atol=1e-9)
    assert report.converged and report.inlier_ratio == 1.0
    starved = icp(ref, ref, (np.arange(len(ref)) < 5).astype(float), truth)
    assert not starved.converged and (starved.new_from_ref == truth).all()


def test_resection_finds_the_pose_from_matches_alone(scene: Any) -> None:
    pair = Pair(scene, noise_px=0.3, depth_noise=0.02, outliers=0.3)
    report = resect(pair.matches, np.eye(4))
    assert pair.error(report.new_from_ref) < 0.02
    assert report.inlier_ratio == pytest.approx(0.7, abs=0.1)


def test_solve_pose_is_exact_on_exact_matches(scene: Any) -> None:
    pair = Pair(scene)
    report = solve_pose(pair.matches, np.eye(4), kernel_px=2.0, iterations=40)
    assert pair.error(report.new_from_ref) < 1e-5 and report.converged
    assert pair.matches.quality(report.new_from_ref)[1] < 1e-3


def test_unknown_depths_still_give_the_rotation(scene: Any) -> None:
    """Depths nobody knows: the epipolar lines alone fix rotation and the direction of the motion."""
    pair = Pair(scene)
    flat = np.full(len(scene.px), 1 / 3.0)
    matches = replace(pair.matches, inv_depth=flat, depth_info=np.full(len(flat), 1e-2))
    report = solve_pose(matches, np.eye(4), kernel_px=2.0, iterations=60)
    turn = se3_log(report.new_from_ref @ inverse(pair.truth))[3:]
    assert np.linalg.norm(turn) < 0.03 < np.linalg.norm(se3_log(pair.truth)[3:])


def cost_of(x: Array, pose: Array, ref: Array, own: Array, weight: Array, sigma: Array) -> float:
    moved = transform(se3_exp(x[:6]) @ pose, ref)
    return point_terms(moved, np.exp(x[6]) * own, weight, sigma)[2]


def test_point_terms_agree_with_finite_differences(scene: Any) -> None:
    rng = np.random.default_rng(2)
    pose = scene.j_from_i(0, 1)
    ref = scene.points(0)[::9]
    own = transform(pose, ref) + 0.05 * rng.normal(size=ref.shape)
    weight, sigma = rng.uniform(0.2, 1, len(ref)), 0.02 * own[:, 2]
    hess, rhs, _ = point_terms(transform(pose, ref), own, weight, sigma)
    gradient = np.zeros(7)
    for i in range(7):
        step = np.zeros(7)
        step[i] = 1e-6
        high, low = (cost_of(s * step, pose, ref, own, weight, sigma) for s in (1, -1))
        gradient[i] = (high - low) / 2e-6
    np.testing.assert_allclose(-2 * rhs, gradient, rtol=1e-5, atol=1e-5 * np.abs(gradient).max())
    np.testing.assert_allclose(hess, hess.T, rtol=1e-12)
    jac = np.zeros((len(ref), 3, 7))  # of moved - own, over sigma, without the kernel
    for i in range(7):
        step = np.zeros(7)
        step[i] = 1e-6
        ends = [transform(se3_exp(s * step[:6]) @ pose, ref) - np.exp(s * step[6]) * own for s in (1, -1)]
        jac[..., i] = (ends[0] - ends[1]) / 2e-6 / sigma[:, None]
    squared = ((own - transform(pose, ref)) ** 2).sum(1) / sigma**2
    kernel = weight / (1 + squared / 4)
    np.testing.assert_allclose(hess, np.einsum("p,pri,prj->ij", kernel, jac, jac), rtol=1e-4, atol=1e-2)


def test_chamfer_pairs_go_both_ways() -> None:
    moved = np.array([[0, 0, 1.0], [1, 0, 1], [5, 0, 1]])
    own = np.array([[0.1, 0, 1.0], [0.9, 0, 1], [9.0, 0, 1], [1.1, 0, 1]])
    i, j = chamfer_pairs(moved, own)
    pairs = set(zip(i.tolist(), j.tolist(), strict=True))
    assert len(i) == len(moved) + len(own)
    assert {(0, 0), (2, 2), (1, 3)} <= pairs  # the far own point pulls on its nearest, too
    assert set(i.tolist()) == {0, 1, 2} and set(j.tolist()) == {0, 1, 2, 3}


def test_fine_lowers_its_own_cost_and_ends_at_the_truth(scene: Any) -> None:
    pair = Pair(scene, own_scale=1.1)
    own = align_module_own(pair)
    off = se3_exp(np.array([0.03, -0.02, 0.02, 0.01, 0.01, -0.01])) @ pair.truth
    report, scale = align_fine(pair.matches, own, off, 1.0, chamfer_weight=0.0, iterations=40)
    assert pair.error(report.new_from_ref) < 1e-3 and scale == pytest.approx(1 / 1.1, rel=1e-3)
    alone, unit = align_fine(pair.matches, None, off, 1.0, chamfer_weight=0.1, iterations=40)
    assert pair.error(alone.new_from_ref) < 1e-3 and unit == 1.0


def align_module_own(pair: Pair) -> Any:
    from mastd3r.alignment.fine import OwnPoints

    return OwnPoints(pair.ref, pair.own, pair.weight, SIGMA_RATIO)


@pytest.mark.parametrize("with_own", [True, False])
@pytest.mark.parametrize("correction", CORRECTIONS)
def test_every_correction_runs_and_says_what_it_did(scene: Any, correction: CorrectionKind, with_own: bool) -> None:
    found = Pair(scene, noise_px=0.3, depth_noise=0.01, with_own=with_own).align(correction)
    assert found.stages[0] == "raw"
    assert ("coarse" in found.stages) == (correction in ("coarse", "coarse-to-fine"))
    assert ("scale" in found.stages) == (with_own and correction in ("coarse", "coarse-to-fine"))
    assert ("fine" in found.stages) == (correction in ("fine", "coarse-to-fine"))
    assert np.isfinite(found.new_from_ref).all()
    np.testing.assert_allclose(found.new_from_ref[:3, :3] @ found.new_from_ref[:3, :3].T, np.eye(3), atol=1e-9)
    assert found.inlier_ratio > 0.8 and found.error_px < 1.5
    if not with_own:
        assert found.scale == 1.0


def test_coarse_to_fine_is_at_least_as_good_as_each_alone(scene: Any) -> None:
    """Noisy pair, a fifth of it outliers, own points 1.3 times too large: median pose error over 7 seeds."""
    errors: dict[str, list[float]] = {c: [] for c in CORRECTIONS}
    for seed in range(7):
        pair = Pair(scene, own_scale=1.3, noise_px=0.4, depth_noise=0.02, outliers=0.2, seed=seed)
        for c in CORRECTIONS:
            errors[c].append(pair.error(pair.align(c).new_from_ref))
    median = {c: float(np.median(e)) for c, e in errors.items()}
    best_alone = min(median["coarse"], median["fine"])
    assert median["coarse-to-fine"] <= 1.05 * best_alone
    assert median["coarse-to-fine"] < 0.25 * median["none"]
    assert median["coarse-to-fine"] < 0.02


@pytest.mark.parametrize("left", [0, 1, 5, 39])
def test_a_starved_pair_fails_and_says_why(scene: Any, left: int) -> None:
    pair = Pair(scene)
    pair.matches = replace(pair.matches, weight=pair.matches.weight * (np.cumsum(pair.weight) <= left))
    guess = se3_exp(np.full(6, 0.01))
    for correction in CORRECTIONS:
        found = pair.align(correction, guess)
        assert not found.converged and found.inlier_ratio == 0 and found.error_px == np.inf
        assert (found.new_from_ref == guess).all() and "too few static matches" in found.stages[0]


def test_nonsense_matches_are_not_believed(scene: Any) -> None:
    pair = Pair(scene, outliers=1.0, with_own=False)
    for correction in CORRECTIONS:
        found = pair.align(correction)
        assert np.isfinite(found.new_from_ref).all()
        assert found.inlier_ratio < 0.35  # tracking.min_inlier_ratio


def test_the_fine_stage_as_printed_sees_points_alone_and_keeps_the_scale(scene: Any) -> None:
    """Eq. (11)(12): T in SE(3), residuals in space. Matches that lie all to one side pull ours, not the printed one."""
    pair = Pair(scene)
    shifted = replace(pair.matches, target=pair.matches.target + np.array([4.0, 0.0]))
    own = OwnPoints(pair.ref, pair.own, pair.weight, SIGMA_RATIO)
    start = se3_exp(np.array([0.01, -0.01, 0.02, 0.01, 0.0, -0.01])) @ pair.truth
    printed, scale = align_fine(shifted, own, start, 1.0, chamfer_weight=0.1, as_printed=True)
    ours, _ = align_fine(shifted, own, start, 1.0, chamfer_weight=0.1)
    assert pair.error(printed.new_from_ref) < 1e-3 < 0.2 * pair.error(ours.new_from_ref)
    larger = replace(own, new=1.02 * own.new)
    printed, scale = align_fine(pair.matches, larger, start, 1.0, chamfer_weight=0.1, as_printed=True)
    assert scale == 1.0 and pair.error(printed.new_from_ref) > 5e-3
    _, scale = align_fine(pair.matches, larger, start, 1.0, chamfer_weight=0.1)
    assert scale == pytest.approx(1 / 1.02, rel=2e-3)
