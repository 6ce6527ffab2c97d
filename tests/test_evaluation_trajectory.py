"""ATE and RPE: held to evo on random and real paths, exact on made ones, calm on hopeless ones."""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from mastd3r.evaluation.trajectory_error import (
    associate,
    ate_rmse,
    drift_distance,
    rotation_angle_rad,
    rpe,
    rpe_over_distance,
    umeyama,
)
from mastd3r.types import Trajectory, Truth

DATA = Path(os.environ.get("MASTD3R_DATA", Path(__file__).parents[1] / "../shared/data"))


def random_poses(rng: np.random.Generator, n: int, step: float = 0.1) -> np.ndarray:
    poses = np.tile(np.eye(4), (n, 1, 1))
    poses[:, :3, :3] = Rotation.from_rotvec(rng.normal(0, 0.05, (n, 3)).cumsum(0)).as_matrix()
    poses[:, :3, 3] = rng.normal(0, step, (n, 3)).cumsum(0)
    return poses


def disturbed(rng: np.random.Generator, poses: np.ndarray, size: float) -> np.ndarray:
    """The same path seen from another world frame, at another scale, with errors."""
    turn = np.eye(4)
    turn[:3, :3] = Rotation.random(random_state=rng).as_matrix()
    turn[:3, 3] = rng.normal(0, 5, 3)
    out = turn @ poses
    noise = Rotation.from_rotvec(rng.normal(0, size, (len(poses), 3))).as_matrix()
    out[:, :3, :3] = out[:, :3, :3] @ noise
    out[:, :3, 3] = out[:, :3, 3] * rng.uniform(0.2, 5) + rng.normal(0, size, (len(poses), 3))
    return out


def trajectory(times_s: np.ndarray, poses: np.ndarray) -> Trajectory:
    return Trajectory(times_s, poses, ("tracked",) * len(poses), np.zeros(len(poses), bool))


def evo_figures(estimate: np.ndarray, truth: np.ndarray, times_s: np.ndarray) -> dict[str, float]:
    from evo.core import metrics
    from evo.core.trajectory import PoseTrajectory3D

    ref = PoseTrajectory3D(poses_se3=list(truth), timestamps=times_s)
    est = PoseTrajectory3D(poses_se3=list(estimate), timestamps=times_s)
    est.align(ref, correct_scale=True)
    out = {}
    ape = metrics.APE(metrics.PoseRelation.translation_part)
    ape.process_data((ref, est))
    out |= {key: float(ape.get_statistic(metrics.StatisticsType[key])) for key in ("rmse", "mean", "median", "max")}
    relations = metrics.PoseRelation
    for delta in (1, 5):
        for name, kind in (
            ("translation", relations.translation_part),
            ("rotation", relations.rotation_angle_rad),
        ):
            error = metrics.RPE(kind, delta=delta, delta_unit=metrics.Unit.frames, all_pairs=True)
            error.process_data((ref, est))
            out[f"{name}{delta}"] = float(error.get_statistic(metrics.StatisticsType.rmse))
    return out


def evo_drift(estimate: np.ndarray, truth: np.ndarray, times_s: np.ndarray, distance: float) -> tuple[float, float]:
    """RPE over a distance along the true path: translation, rotation in radians, RMSE over all pairs."""
    from evo.core import metrics
    from evo.core.trajectory import PoseTrajectory3D

    ref = PoseTrajectory3D(poses_se3=list(truth), timestamps=times_s)
    est = PoseTrajectory3D(poses_se3=list(estimate), timestamps=times_s)
    est.align(ref, correct_scale=True)
    found = []
    for kind in (metrics.PoseRelation.translation_part, metrics.PoseRelation.rotation_angle_rad):
        error = metrics.RPE(
            kind, delta=distance, delta_unit=metrics.Unit.meters, all_pairs=True, pairs_from_reference=True
        )
        error.process_data((ref, est))
        found.append(float(error.get_statistic(metrics.StatisticsType.rmse)))
    return found[0], found[1]


def assert_equals_evo(estimate: np.ndarray, truth: np.ndarray, times_s: np.ndarray) -> None:
    ours = ate_rmse(trajectory(times_s, estimate), Truth(times_s, truth))
    evo = evo_figures(estimate, truth, times_s)
    assert ours.reason is None
    assert [ours.rmse, ours.mean, ours.median, ours.max] == pytest.approx(
        [evo["rmse"], evo["mean"], evo["median"], evo["max"]], rel=1e-9
    )
    for delta in (1, 5):
        error = rpe(trajectory(times_s, estimate), Truth(times_s, truth), delta)
        assert error.n_pairs == len(times_s) - delta
        assert error.translation_rmse == pytest.approx(evo[f"translation{delta}"], rel=1e-9)
        assert error.rotation_rmse_rad == pytest.approx(evo[f"rotation{delta}"], rel=1e-9)
    made, true = trajectory(times_s, estimate), Truth(times_s, truth)
    distance = min(drift_distance(made, true), 0.3 * np.linalg.norm(np.diff(truth[:, :3, 3], axis=0), axis=1).sum())
    drift = rpe_over_distance(made, true, distance)
    expected = evo_drift(estimate, truth, times_s, distance)
    assert [drift.translation_rmse, drift.rotation_rmse_rad] == pytest.approx(expected, rel=1e-9)


@pytest.mark.parametrize("seed", range(20))
def test_equals_evo_on_random_paths(seed: int) -> None:
    rng = np.random.default_rng(seed)
    n = int(rng.integers(10, 200))
    truth = random_poses(rng, n)
    assert_equals_evo(disturbed(rng, truth, 0.05), truth, np.arange(n) / 30)


@pytest.mark.parametrize("name", ["kitchen", "lobby", "street", "tsukuba", "cabinet", "jam"])
def test_equals_evo_on_real_paths(name: str) -> None:
    from mastd3r.export.trajectory_files import read_tum

    if not (DATA / name / "groundtruth.txt").exists():
        pytest.skip(f"no sequence {name} at {DATA}")
    truth = read_tum(DATA / name / "groundtruth.txt")
    estimate = disturbed(np.random.default_rng(1), truth.world_from_cam, 0.02)
    assert_equals_evo(estimate, truth.world_from_cam, truth.timestamps_s)


@settings(max_examples=50, deadline=None)
@given(seed=st.integers(0, 10**6), scale=st.floats(1e-3, 1e3))
def test_a_similarity_is_found_exactly_and_undone(seed: int, scale: float) -> None:
    rng = np.random.default_rng(seed)
    source = rng.normal(size=(8, 3))
    rotation = Rotation.random(random_state=rng).as_matrix()
    target = scale * source @ rotation.T + scale * rng.normal(size=3)
    found = umeyama(source, target)
    assert found.scale == pytest.approx(scale, rel=1e-9)
    assert np.allclose(found.rotation, rotation, atol=1e-9)
    assert np.allclose(found.inverse().apply(target), source, atol=1e-9)


def test_mirrored_points_do_not_give_a_mirror() -> None:
    source = np.random.default_rng(0).normal(size=(20, 3))
    found = umeyama(source, source * [1, 1, -1])
    assert np.linalg.det(found.rotation) == pytest.approx(1)


def test_without_scale_the_scale_stays_one() -> None:
    source = np.random.default_rng(0).normal(size=(20, 3))
    assert umeyama(source, 3 * source, with_scale=False).scale == 1.0


def test_a_straight_path_is_scored() -> None:
    truth = np.tile(np.eye(4), (30, 1, 1))
    truth[:, 2, 3] = np.arange(30)
    estimate = truth.copy()
    estimate[:, :3, 3] *= 0.1
    result = ate_rmse(trajectory(np.arange(30.0), estimate), Truth(np.arange(30.0), truth))
    assert result.rmse == pytest.approx(0, abs=1e-12)
    assert result.scale == pytest.approx(10)


def test_a_known_error_has_its_size() -> None:
    """Two opposite errors of 0.3 m on a rigid frame of far points: the fit cannot absorb them."""
    rng = np.random.default_rng(0)
    truth = random_poses(rng, 400, step=1)
    estimate = truth.copy()
    estimate[100, 0, 3] += 0.3
    estimate[101, 0, 3] -= 0.3
    result = ate_rmse(trajectory(np.arange(400.0), estimate), Truth(np.arange(400.0), truth))
    assert result.max == pytest.approx(0.3, rel=0.01)
    assert result.rmse == pytest.approx(0.3 * np.sqrt(2 / 400), rel=0.01)


def test_association_takes_the_nearest_within_the_tolerance() -> None:
    rows, truth_rows = associate(np.array([0.0, 1.0, 2.011, 5.0]), np.array([2.0, 1.019, 0.001, 2.02]), 0.02)
    assert rows.tolist() == [0, 1, 2]
    assert truth_rows.tolist() == [2, 1, 3]


@pytest.mark.parametrize(
    ("spoil", "says"),
    [
        (lambda t, e, g: (t[:3], e[:3], g[:3]), "got 3"),
        (lambda t, e, g: (t[:0], e[:0], g[:0]), "got 0"),
        (lambda t, e, g: (t, e * 0 + np.eye(4), g), "estimated camera never moves"),
        (lambda t, e, g: (t, e, g * 0 + np.eye(4)), "true camera never moves"),
        (lambda t, e, g: (t, np.where(np.arange(20)[:, None, None] == 7, np.nan, e), g), "1 of 20"),
        (lambda t, e, g: (t, e, np.where(np.arange(20)[:, None, None] == 7, np.inf, g)), "true positions"),
    ],
)
def test_what_cannot_be_scored_says_why(spoil, says: str) -> None:
    rng = np.random.default_rng(0)
    truth = random_poses(rng, 20)
    times, estimate, truth = spoil(np.arange(20.0), disturbed(rng, truth, 0.01), truth)
    result = ate_rmse(trajectory(times, estimate), Truth(times, truth))
    assert result.rmse is None
    assert says in (result.reason or "")
    assert result.truth_in_map(len(times)) is None
    assert rpe(trajectory(times, estimate), Truth(times, truth)).reason == result.reason


def test_rpe_refuses_deltas_that_do_not_fit() -> None:
    poses = random_poses(np.random.default_rng(0), 10)
    arguments = trajectory(np.arange(10.0), poses), Truth(np.arange(10.0), poses)
    assert "more than 10 associated poses, got 10" in (rpe(*arguments, delta=10).reason or "")
    assert "got 0" in (rpe(*arguments, delta=0).reason or "")
    assert rpe(*arguments, delta=9).n_pairs == 1


@pytest.mark.parametrize(
    ("way", "corner", "distance"),
    [
        ([0, 0, 0, 1, 2, 2, 3, 4, 4, 4, 5, 6, 7, 7], 3.0, 2.0),
        ([0, 0.95, 0.95, 0.95, 2.1, 2.1, 3.05, 3.05, 4.1, 4.1, 5.05, 5.05], 3.05, 1.0),  # rests just short of it
    ],
)
def test_drift_is_measured_where_the_camera_rests_too(way: list[float], corner: float, distance: float) -> None:
    """Where several poses are equally far, the first of them is meant, as in evo."""
    truth = np.tile(np.eye(4), (len(way), 1, 1))
    truth[:, 0, 3], truth[:, 1, 3] = np.minimum(way, corner), np.maximum(np.array(way) - corner, 0)
    times = np.arange(len(way), dtype=float)
    estimate = disturbed(np.random.default_rng(3), truth, 0.02)
    drift = rpe_over_distance(trajectory(times, estimate), Truth(times, truth), distance)
    expected = evo_drift(estimate, truth, times, distance)
    assert [drift.translation_rmse, drift.rotation_rmse_rad] == pytest.approx(expected, rel=1e-9)
    assert drift.n_pairs < len(way) - 1  # no pair beyond the end


@pytest.mark.parametrize(("step_m", "distance"), [(0.01, 1), (0.19, 1), (0.21, 10), (1.9, 10), (3, 100), (30, 100)])
def test_drift_distance_has_five_steps(step_m: float, distance: float) -> None:
    truth = np.tile(np.eye(4), (50, 1, 1))
    truth[:, 0, 3] = step_m * np.arange(50)
    truth[:, 2, 3] = np.sin(np.arange(50)) * 1e-6
    times = np.arange(50.0)
    assert drift_distance(trajectory(times, truth), Truth(times, truth)) == distance


def test_drift_that_cannot_be_measured_says_why() -> None:
    poses = random_poses(np.random.default_rng(0), 10)
    arguments = trajectory(np.arange(10.0), poses), Truth(np.arange(10.0), poses)
    assert "apart along a true path" in (rpe_over_distance(*arguments, distance=1000).reason or "")
    assert "above 0" in (rpe_over_distance(*arguments, distance=0).reason or "")
    still = trajectory(np.arange(10.0), np.tile(np.eye(4), (10, 1, 1)))
    assert "never moves" in (rpe_over_distance(still, arguments[1], 1).reason or "")
    assert drift_distance(still, arguments[1]) == 1


def test_truth_in_the_map_lies_on_an_exact_estimate() -> None:
    rng = np.random.default_rng(0)
    truth = random_poses(rng, 20)
    estimate = disturbed(rng, truth, 0)
    result = ate_rmse(trajectory(np.arange(20.0), estimate), Truth(np.arange(3, 20.0), truth[3:]))
    placed = result.truth_in_map(20)
    assert placed is not None
    assert np.isnan(placed[:3]).all()
    assert np.allclose(placed[3:], estimate[3:, :3, 3], atol=1e-9)


@pytest.mark.parametrize("angle_rad", [0, 1e-12, 1e-6, 0.3, np.pi / 2, np.pi - 1e-6, np.pi])
def test_rotation_angle_holds_from_zero_to_a_half_turn(angle_rad: float) -> None:
    axis = np.array([0.6, 0, 0.8])
    rotation = Rotation.from_rotvec(axis * angle_rad).as_matrix()
    assert rotation_angle_rad(rotation) == pytest.approx(angle_rad, rel=1e-9, abs=1e-15)
