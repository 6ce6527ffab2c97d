"""Trajectories of others as they come: a row without a pose, a byte order mark, commas, times in another unit."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from mastd3r.errors import InputError
from mastd3r.evaluation.evaluate import evaluate_trajectory as score
from mastd3r.pipeline import evaluate_trajectory
from mastd3r.types import Trajectory, Truth

CASES = Path(os.environ.get("MASTD3R_CASES", Path(__file__).parents[2] / "shared" / "cases"))
with_cases = pytest.mark.skipif(not CASES.is_dir(), reason="the folder of cases is not there")


def evaluated(folder: str, file: str) -> dict[str, Any]:
    return evaluate_trajectory(CASES / folder / file, "tum", CASES / folder)


@with_cases
def test_one_pose_that_is_none_costs_one_pose() -> None:
    found, without = (evaluated("eval_one_nan_pose", name) for name in ("est.txt", "est_without_it.txt"))
    assert found["ate_rmse_all"] == pytest.approx(without["ate_rmse_all"], abs=1e-9)
    assert found["ate_rmse_all"] == pytest.approx(0.0074, abs=5e-5)
    assert found["poses_not_finite"] == 1 and "poses_not_finite" not in without
    assert found["frames_posed"] == without["frames_posed"] == found["frames"] - 1


@with_cases
def test_marks_and_commas_are_read() -> None:
    bom, comma = (evaluated("eval_bom_and_commas", name) for name in ("est_bom.txt", "est_comma.txt"))
    assert bom == comma and bom["ate_rmse_all"] is not None and bom["frames_posed"] == bom["frames"]


@with_cases
def test_times_in_nanoseconds_are_named() -> None:
    with pytest.raises(InputError, match=r"expected poses at the times of the frames.*look like nanoseconds"):
        evaluated("eval_nothing_matches", "est_ns.txt")


def straight(times_s: Any) -> Trajectory:
    n = len(times_s)
    poses = np.tile(np.eye(4), (n, 1, 1))
    poses[:, :3, 3] = np.stack([np.arange(n), np.sin(np.arange(n)), np.zeros(n)], 1)
    return Trajectory(np.asarray(times_s, float), poses, ("tracked",) * n, np.zeros(n, bool))


@pytest.mark.parametrize(("unit", "name"), [(1e9, "nanoseconds"), (1e6, "microseconds"), (1e3, "milliseconds")])
def test_another_unit_of_time_is_named(unit: float, name: str) -> None:
    times_s = 100 + np.arange(8) / 10
    truth = Truth(times_s, straight(times_s).world_from_cam, {}, None)
    with pytest.raises(InputError, match=f"look like {name}$"):
        score(straight(times_s * unit), truth, times_s)
    with pytest.raises(InputError, match=r"got 500\.000000 to 500\.700000$"):
        score(straight(times_s + 400), truth, times_s)


def test_poses_that_are_not_finite_are_counted_and_left_out() -> None:
    times_s = np.arange(8) / 10
    given = straight(times_s)
    truth = Truth(times_s, given.world_from_cam.copy(), {}, None)
    given.world_from_cam[2, 0, 3], given.world_from_cam[5, :3, :3] = np.nan, np.inf
    metrics = score(given, truth, times_s).metrics
    assert metrics["poses_not_finite"] == 2 and metrics["frames_posed"] == 6
    assert metrics["ate_rmse_all"] == pytest.approx(0, abs=1e-9)
    given.world_from_cam[:] = np.nan
    with pytest.raises(InputError, match="got none that are finite"):
        score(given, truth, times_s)
