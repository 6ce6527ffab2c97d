"""Runs in metres: every file of a folder has one unit, exports are in metres, figures stay, and nothing is lost."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

import mastd3r
from colmap_reader import read_binary
from made_runs import MadeRun, edited_record, made_run
from mastd3r.camera.pinhole import Camera
from mastd3r.cli.commands import show
from mastd3r.cli.main import main
from mastd3r.errors import InputError
from mastd3r.export.point_cloud import read_cloud
from mastd3r.export.read_run import read_run
from mastd3r.export.report import report_html
from mastd3r.export.report_data import gather_report_data
from mastd3r.export.trajectory_files import read_tum
from mastd3r.geometry.se3 import inverse
from mastd3r.mapping.gaussian_arrays import GaussianArrays
from mastd3r.mapping.ply import write_gaussians_ply
from mastd3r.mapping.process import Outcome
from mastd3r.offline.job import RunJob
from mastd3r.offline.renders import gaussians_of

Array = NDArray[Any]
LENS = Camera(90.0, 90.0, 47.5, 35.5, 96, 72)
FACTOR = 2.5
LATER = {"asked": "factor=2.5", "metres_per_unit": FACTOR, "sigma_ratio": 0.01, "applied": False, "said": "so"}


# -- a run that has ended ----------------------------------------------------------------------------------------------


@pytest.fixture
def made(tmp_path: Path) -> MadeRun:
    """A run in map units, whose metres were measured later."""
    run = made_run(tmp_path, LENS)
    rng = np.random.default_rng(2)
    splat = GaussianArrays(
        rng.uniform([-0.8, -0.6, 4], [0.8, 0.6, 6], (40, 3)).astype(np.float32),
        rng.uniform(0.05, 0.2, (40, 3)).astype(np.float32),
        np.tile(np.array([1, 0, 0, 0], np.float32), (40, 1)),
        np.full(40, 0.9, np.float32),
        rng.random((40, 3)).astype(np.float32),
        np.zeros(40, np.int32),
        np.zeros((40, 0, 3), np.float32),
    )
    write_gaussians_ply(run.path / "gaussians.ply", splat)
    (run.path / "config.yaml").write_text("mapping:\n  width_px: 96\n")
    edited_record(run.path, scale=LATER, map={"median_depth": 5.0})
    return run


def exported(run: MadeRun, kind: str, name: str, **options: Any) -> Path:
    return mastd3r.load(run.path).export(kind, run.path.parent / name, **options)


def test_trajectories_are_in_metres(made: MadeRun) -> None:
    true = made.trajectory.world_from_cam[:, :3, 3] * FACTOR
    np.testing.assert_allclose(read_tum(exported(made, "tum", "p.txt")).world_from_cam[:, :3, 3], true, atol=1e-8)
    rows = np.loadtxt(exported(made, "kitti", "k.txt")).reshape(-1, 3, 4)
    np.testing.assert_allclose(rows[:, :, 3], true, atol=1e-8)
    np.testing.assert_allclose(rows[:, :, :3], made.trajectory.world_from_cam[:, :3, :3], atol=1e-8)
    csv = exported(made, "euroc", "e.csv").read_text().splitlines()
    assert "p_z [m]" in csv[0]
    np.testing.assert_allclose([float(w) for w in csv[1].split(",")[1:4]], true[0], atol=1e-8)


def test_pictures_are_in_metres_and_show_the_same(made: MadeRun) -> None:
    model = read_binary(exported(made, "colmap", "colmap") / "sparse" / "0")
    for image, pose in zip(model.images.values(), made.trajectory.in_lengths(FACTOR).world_from_cam, strict=True):
        np.testing.assert_allclose(image.cam_from_world, inverse(pose), atol=1e-7)
    np.testing.assert_allclose(model.errors_px(), made.error_px, atol=1e-4)  # where points are seen does not change
    found = np.array([p.xyz for p in model.points.values()])
    np.testing.assert_allclose(found, FACTOR * made.tracks.points_world, rtol=1e-6)
    studio = exported(made, "nerfstudio", "studio")
    poses = np.array([f["transform_matrix"] for f in json.loads((studio / "transforms.json").read_text())["frames"]])
    spread = np.linalg.norm(poses[1:, :3, 3] - poses[0, :3, 3], axis=1)
    places = made.trajectory.world_from_cam[:, :3, 3]
    np.testing.assert_allclose(spread, FACTOR * np.linalg.norm(places[1:] - places[0], axis=1), rtol=1e-6)
    mine, theirs = read_cloud(made.path / "cloud.ply"), read_cloud(studio / "cloud.ply")
    np.testing.assert_allclose(theirs.points_world, FACTOR * mine.points_world, rtol=1e-6)
    np.testing.assert_allclose(theirs.spacing, FACTOR * mine.spacing, rtol=1e-6)
    assert json.loads((studio / "export.json").read_text())["unit"] == "m"


def test_the_splat_and_its_depth_are_in_metres(made: MadeRun) -> None:
    run = read_run(made.path)
    before, after = gaussians_of(run), gaussians_of(run.in_metres())
    np.testing.assert_allclose(after.means, FACTOR * before.means, rtol=1e-6)
    np.testing.assert_allclose(after.scales, FACTOR * before.scales, rtol=1e-6)
    np.testing.assert_array_equal(after.colors, before.colors)
    begun = Outcome(before, 3, 2).in_lengths(FACTOR)  # while tracking, before anybody knew metres
    assert begun.gaussians is not None and (begun.steps, begun.views) == (3, 2)
    np.testing.assert_array_equal(begun.gaussians.means, after.means)

    def depth(name: str) -> Array:
        folder = exported(made, "depth", name)
        per_unit = json.loads((folder / "export.json").read_text())["depth_png_per_unit"]
        return np.stack([cv2.imread(str(p), cv2.IMREAD_UNCHANGED) for p in sorted(folder.glob("*.png"))]) / per_unit

    metres = depth("metres")
    edited_record(made.path, scale=None)
    units = depth("units")
    assert (units > 0).mean() > 0.1
    np.testing.assert_allclose(metres, FACTOR * units, atol=0.005)


def test_a_folder_that_is_in_metres_is_not_scaled_again(made: MadeRun) -> None:
    edited_record(made.path, scale={**LATER, "applied": True})
    found = read_tum(exported(made, "tum", "p.txt")).world_from_cam
    np.testing.assert_allclose(found, made.trajectory.world_from_cam, atol=1e-8)
    assert read_run(made.path).unit == "m" and "[m]" in exported(made, "euroc", "e.csv").read_text()


def test_metres_are_measured_later(made: MadeRun, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """The folder stays as it is, but for run.json and the line of the report."""
    edited_record(made.path, scale=None)
    run = read_run(made.path)
    (made.path / "report.html").write_text(report_html(gather_report_data(run, [], {})))
    kept = {p.name: p.read_bytes() for p in made.path.iterdir() if p.is_file()}
    times, places = made.trajectory.timestamps_s, made.trajectory.world_from_cam[:, :3, 3]
    at = np.linspace(times[0], times[-1], 17)
    known = np.stack([np.interp(at, times, places[:, axis]) for axis in range(3)], 1) * FACTOR
    np.savetxt(tmp_path / "gps.txt", np.concatenate([at[:, None], known], 1), fmt="%.9f")
    assert main(["scale", str(made.path), f"positions:{tmp_path / 'gps.txt'}"]) == 0
    shown = " ".join(capsys.readouterr().out.split())
    assert "1 map unit is 2.5" in shown and "from 17 known positions" in shown
    facts = mastd3r.load(made.path).scale
    assert facts["metres_per_unit"] == pytest.approx(FACTOR, rel=1e-4) and not facts["applied"]
    assert 0 <= facts["sigma_ratio"] < 1e-3 and facts["supports"] == 17
    changed = {p.name for p in made.path.iterdir() if p.is_file() and kept.get(p.name) != p.read_bytes()}
    assert changed == {"run.json", "report.html"}
    assert "from 17 known positions" in (made.path / "report.html").read_text()
    assert (made.path / "report.html").read_text().count('class="scale"') == 1

    assert main(["scale", str(made.path), "camera-height=1.6"]) == 2
    assert "expected a map whose +y is down" in " ".join(capsys.readouterr().err.split())
    assert mastd3r.load(made.path).scale == facts


@pytest.mark.parametrize(
    ("scale", "said"),
    [
        ({"metres_per_unit": 0}, "scale.metres_per_unit: expected metres of a map unit, got 0"),
        ({"metres_per_unit": "2"}, "scale.metres_per_unit: expected"),
        ({"applied": 1}, "scale.applied: expected true or false, got 1"),
        ({"sigma_ratio": -1}, "scale.sigma_ratio: expected a number, 0 or more, got -1"),
        ([], "scale: expected an object"),
    ],
)
def test_a_record_that_no_run_writes(made: MadeRun, scale: Any, said: str) -> None:
    edited_record(made.path, scale=scale)
    with pytest.raises(InputError, match=said):
        read_run(made.path)


# -- a run -------------------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def in_units(room_clip: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run whose ``--scale`` names a frame that it does not have: it ends with exit code 2, complete."""
    out = tmp_path_factory.mktemp("metric") / "units"
    assert main(words_of(room_clip, out, "--scale", "points:500:1,1:2,2=1")) == 2
    return out


def words_of(clip: Path, out: Path, *more: str) -> list[str]:
    return ["run", str(clip), "--out", str(out), "--no-map", "--end", "10", "--quiet", "--semantics", "none", *more]


def test_stopped_and_resumed_all_files_are_metres_and_figures_stay(
    in_units: Path, room_clip: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def stop(*_: Any) -> None:
        raise KeyboardInterrupt

    out = tmp_path / "metres"
    with monkeypatch.context() as patch:
        patch.setattr(RunJob, "smooth_masks", stop)
        assert main(words_of(room_clip, out, "--scale", f"positions:{room_clip / 'groundtruth.txt'}")) == 130
    begun = read_run(out)
    factor = begun.record["scale"]["metres_per_unit"]
    assert begun.unit == "m" and begun.record["scale"]["applied"] and begun.record["status"] == "incomplete"
    units = read_run(in_units)
    assert main(["resume", str(out), "--quiet"]) == 0
    run = read_run(out)
    assert run.record["scale"] == begun.record["scale"]
    for mine, theirs in (
        (run.trajectory.world_from_cam[:, :3, 3], units.trajectory.world_from_cam[:, :3, 3]),
        (run.cloud().points_world, units.cloud().points_world),
        (run.cloud().spacing, units.cloud().spacing),
        (run.tracks().points_world, units.tracks().points_world),
    ):
        np.testing.assert_allclose(mine, factor * theirs, atol=2e-3 * factor)
    assert run.metrics["ate_rmse_all"] == pytest.approx(units.metrics["ate_rmse_all"], rel=1e-3)
    assert set(run.metrics) - {"peak_rss_mib"} <= set(units.metrics) | {"core_s_per_frame"}
    assert "1 map unit is" in (out / "report.html").read_text()
    truth = np.loadtxt(room_clip / "groundtruth.txt")[:10, 1:4]
    path = np.linalg.norm(np.diff(run.trajectory.world_from_cam[:, :3, 3], axis=0), axis=1).sum()
    assert path == pytest.approx(np.linalg.norm(np.diff(truth, axis=0), axis=1).sum(), rel=0.05)


def test_what_cannot_be_measured_costs_nothing_but_the_metres(
    in_units: Path, room_clip: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """The run is complete, in map units, and says so; other ways are tried on it afterwards."""
    run = read_run(in_units)
    assert run.record["status"] == "complete" and run.unit == "map units"
    assert "a number below 10, got '500'" in run.record["scale"]["refused"] and not run.record["scale"]["applied"]
    assert "Lengths are map units: --scale points" in (in_units / "report.html").read_text()
    with pytest.raises(InputError, match="is complete, its lengths are map units: mastd3r scale"):
        show(mastd3r.load(in_units))
    assert main(["scale", str(in_units), f"depth:{room_clip}"]) == 0
    by_depth = mastd3r.load(in_units).scale
    mastd3r.load(in_units).measure_scale(f"positions:{room_clip / 'groundtruth.txt'}")
    by_positions = mastd3r.load(in_units).scale
    apart = abs(np.log(by_depth["metres_per_unit"] / by_positions["metres_per_unit"]))
    assert apart < 2 * np.hypot(by_depth["sigma_ratio"], by_positions["sigma_ratio"])


def test_a_live_run_gives_poses_out_before_it_knows() -> None:
    with pytest.raises(mastd3r.SlamError, match="live: expected no scale"):
        mastd3r.Slam(mastd3r.Config(scale="factor=2"), (64, 48), live=True)
