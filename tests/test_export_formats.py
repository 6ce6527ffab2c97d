"""Exports: what other tools will read must put every point where the run put it."""

from __future__ import annotations

import dataclasses
import json
import logging
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from mastd3r.camera.pinhole import Camera
from mastd3r.errors import ConfigError, InputError, OutputError
from mastd3r.export import formats
from mastd3r.export.formats import cameras_text, evenly, export_run
from mastd3r.export.point_cloud import write_cloud
from mastd3r.export.trajectory_files import write_tum
from mastd3r.geometry.se3 import inverse, transform
from mastd3r.types import StaticCloud, Trajectory

CAMERA = Camera(519.25, 519.25, 310.5, 242.75, 640, 480, k1=0.05)


def run_folder(path: Path, poses: int = 5, points: int = 40, frames: int | None = None) -> Trajectory:
    """A run folder with what exports read, and nothing else."""
    path.mkdir(parents=True)
    rng = np.random.default_rng(1)
    world_from_cam = np.tile(np.eye(4), (poses, 1, 1))
    world_from_cam[:, :3, :3] = Rotation.from_rotvec(rng.normal(0, 0.3, (poses, 3))).as_matrix()
    world_from_cam[:, :3, 3] = rng.normal(0, 0.2, (poses, 3))
    times = 1341841278.5 + np.arange(poses) / 30
    trajectory = Trajectory(times, world_from_cam, ("tracked",) * poses, np.zeros(poses, bool))
    write_tum(path / "trajectory.txt", trajectory)
    cloud = StaticCloud(
        rng.uniform([-1, -1, 4], [1, 1, 6], (points, 3)).astype(np.float32),
        rng.integers(0, 256, (points, 3)).astype(np.uint8),
        np.ones(points, np.float32),
        np.full(points, 0.01, np.float32),
        np.zeros(points, np.int32),
    )
    write_cloud(path / "cloud.ply", cloud)
    (path / "camera.json").write_text(json.dumps(dataclasses.asdict(CAMERA)))
    (path / "run.json").write_text(json.dumps({"status": "complete"}))
    (path / "metrics.json").write_text(json.dumps({"frames": poses if frames is None else frames}))
    return trajectory


def rows_of(path: Path) -> list[list[str]]:
    return [line.split() for line in path.read_text().splitlines() if line and not line.startswith("#")]


def colmap_simple_radial(params: NDArray[np.float64], points_cam: NDArray[np.float64]) -> NDArray[np.float64]:
    """COLMAP's own projection, written from its documentation; pixels with (0.5, 0.5) at the first centre."""
    f, cx, cy, k = params
    u, v = points_cam[:, 0] / points_cam[:, 2], points_cam[:, 1] / points_cam[:, 2]
    bend = 1 + k * (u * u + v * v)
    return np.stack([f * u * bend + cx, f * v * bend + cy], -1)


def test_a_colmap_reader_sees_every_point_where_we_do(tmp_path: Path) -> None:
    trajectory = run_folder(tmp_path / "run")
    out = export_run(tmp_path / "run", "colmap", tmp_path / "deep" / "model")
    assert sorted(p.name for p in out.iterdir()) == ["cameras.txt", "images.txt", "points3D.txt"]
    (camera,) = rows_of(out / "cameras.txt")
    assert camera[:4] == ["1", "SIMPLE_RADIAL", "640", "480"]
    images, points = rows_of(out / "images.txt"), rows_of(out / "points3D.txt")
    assert len(images) == 5 and len(points) == 40
    world = np.array([[float(w) for w in p[1:4]] for p in points])
    for row, pose, time_s in zip(images, trajectory.world_from_cam, trajectory.timestamps_s, strict=True):
        w, x, y, z, *t = map(float, row[1:8])
        cam_from_world = np.eye(4)
        cam_from_world[:3, :3] = Rotation.from_quat([x, y, z, w]).as_matrix()
        cam_from_world[:3, 3] = t
        theirs = colmap_simple_radial(np.array(camera[4:], float), transform(cam_from_world, world))
        ours = CAMERA.project(transform(inverse(pose), world))
        assert np.allclose(theirs, ours + 0.5, atol=1e-4)
        assert row[8] == "1" and row[9] == f"{time_s:.6f}.png"


def test_colmap_images_have_two_lines_each(tmp_path: Path) -> None:
    run_folder(tmp_path / "run", poses=3)
    out = export_run(tmp_path / "run", "colmap", tmp_path / "model")
    lines = [line for line in (out / "images.txt").read_text().split("\n") if not line.startswith("#")]
    assert [bool(line) for line in lines] == [True, False] * 3 + [False]


def test_colmap_points_keep_colour_and_have_no_track(tmp_path: Path) -> None:
    run_folder(tmp_path / "run", points=3)
    out = export_run(tmp_path / "run", "colmap", tmp_path / "model")
    rows = rows_of(out / "points3D.txt")
    assert [r[0] for r in rows] == ["1", "2", "3"]
    assert all(len(r) == 8 and 0 <= int(r[4]) <= 255 and r[7] == "-1" for r in rows)


def test_interpolated_poses_are_no_images_to_train_from(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level(logging.WARNING, logger="mastd3r.export.formats")  # a command that was quiet may have gone before
    trajectory = run_folder(tmp_path / "run")
    states = [["tracked", 2], ["interpolated", 2], ["tracked", 1]]
    (tmp_path / "run" / "run.json").write_text(json.dumps({"status": "complete", "states": states}))
    rows = rows_of(export_run(tmp_path / "run", "colmap", tmp_path / "model") / "images.txt")
    assert [row[-1] for row in rows] == [f"{trajectory.timestamps_s[n]:.6f}.png" for n in (0, 1, 4)]
    assert "2 of 5 poses are interpolated, and left out" in caplog.text
    assert len(rows_of(export_run(tmp_path / "run", "tum", tmp_path / "t.txt"))) == 5
    assert "2 of 5 poses are interpolated, and among the others" in caplog.text


def test_two_focal_lengths_are_not_joined() -> None:
    text = cameras_text(dataclasses.replace(CAMERA, fy_px=530.0))
    assert text.splitlines()[1] == "1 OPENCV 640 480 519.25 530 311 243.25 0.05 0 0 0"


@pytest.mark.parametrize(
    ("terms", "fy_px", "model"),
    [
        ((0.05, 0.0, 0.0), 519.25, "SIMPLE_RADIAL"),
        ((0.0, 0.0, 0.0), 519.25, "SIMPLE_RADIAL"),
        ((0.05, -0.02, 0.0), 519.25, "RADIAL"),
        ((0.05, -0.02, 0.0), 530.0, "OPENCV"),
        ((0.05, -0.02, 0.01), 519.25, "FULL_OPENCV"),
        ((0.0, 0.0, 0.01), 530.0, "FULL_OPENCV"),
    ],
)
def test_the_model_is_the_simplest_that_holds_the_lens(
    terms: tuple[float, float, float], fy_px: float, model: str
) -> None:
    """Read back by the model's own documentation, every point is where our camera has it."""
    camera = Camera(519.25, fy_px, 310.5, 242.75, 640, 480, *terms)
    words = cameras_text(camera).splitlines()[1].split()
    assert words[:4] == ["1", model, "640", "480"]
    points = np.random.default_rng(0).uniform([-2, -2, 4], [2, 2, 6], (50, 3))
    theirs = colmap_projection(model, np.array(words[4:], float), points)
    np.testing.assert_allclose(theirs, camera.project(points) + 0.5, atol=1e-6)


def colmap_projection(model: str, params: NDArray[np.float64], points_cam: NDArray[np.float64]) -> NDArray[np.float64]:
    """The radial part of COLMAP's models, written from its documentation; tangential terms must be zero."""
    if model == "SIMPLE_RADIAL":
        return colmap_simple_radial(params, points_cam)
    xy = points_cam[:, :2] / points_cam[:, 2:]
    r2 = (xy**2).sum(1, keepdims=True)
    if model == "RADIAL":
        f, cx, cy, k1, k2 = params
        fx, fy, bend = f, f, 1 + k1 * r2 + k2 * r2**2
    else:
        fx, fy, cx, cy, k1, k2, p1, p2 = params[:8]
        assert p1 == p2 == 0
        k3, k4, k5, k6 = params[8:] if model == "FULL_OPENCV" else np.zeros(4)
        bend = (1 + k1 * r2 + k2 * r2**2 + k3 * r2**3) / (1 + k4 * r2 + k5 * r2**2 + k6 * r2**3)
    return np.asarray(xy * bend * [fx, fy] + [cx, cy])


def test_kitti_rows_are_the_poses(tmp_path: Path) -> None:
    trajectory = run_folder(tmp_path / "run")
    out = export_run(tmp_path / "run", "kitti", tmp_path / "poses.txt")
    rows = np.loadtxt(out)
    assert rows.shape == (5, 12)
    assert np.allclose(rows.reshape(-1, 3, 4), trajectory.world_from_cam[:, :3], atol=1e-8)


def test_evo_reads_the_kitti_file(tmp_path: Path) -> None:
    from evo.tools.file_interface import read_kitti_poses_file

    trajectory = run_folder(tmp_path / "run")
    read = read_kitti_poses_file(export_run(tmp_path / "run", "kitti", tmp_path / "poses.txt"))
    assert np.allclose(read.poses_se3, trajectory.world_from_cam, atol=1e-8)


def test_kitti_refuses_frames_without_a_pose(tmp_path: Path) -> None:
    run_folder(tmp_path / "run", poses=5, frames=7)
    with pytest.raises(InputError, match="5 poses of 7 frames; use --to tum"):
        export_run(tmp_path / "run", "kitti", tmp_path / "poses.txt")


def test_tum_is_a_copy(tmp_path: Path) -> None:
    run_folder(tmp_path / "run")
    out = export_run(tmp_path / "run", "tum", tmp_path / "t.txt")
    assert out.read_bytes() == (tmp_path / "run" / "trajectory.txt").read_bytes()


@pytest.mark.parametrize(("count", "most"), [(0, 5), (4, 5), (5, 5), (6, 5), (1001, 100)])
def test_thinning_is_even(count: int, most: int) -> None:
    chosen = evenly(count, most)
    assert len(chosen) == min(count, most)
    assert len(set(chosen.tolist())) == len(chosen)
    if len(chosen) > 1:
        assert np.ptp(np.diff(chosen)) <= 1 and chosen[0] == 0 and count - chosen[-1] <= count // most + 1


def test_large_clouds_are_thinned(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(formats, "MAX_POINTS", 10)
    run_folder(tmp_path / "run", points=95)
    out = export_run(tmp_path / "run", "colmap", tmp_path / "model")
    assert len(rows_of(out / "points3D.txt")) == 10


@pytest.mark.parametrize(("missing", "kind"), [("camera.json", "colmap"), ("cloud.ply", "colmap"), ("run.json", "tum")])
def test_what_is_missing_is_named(tmp_path: Path, missing: str, kind: formats.ExportKind) -> None:
    run_folder(tmp_path / "run")
    (tmp_path / "run" / missing).unlink()
    with pytest.raises(InputError, match=missing.replace(".", r"\.")):
        export_run(tmp_path / "run", kind, tmp_path / "out")


def test_a_run_without_poses_is_refused(tmp_path: Path) -> None:
    run_folder(tmp_path / "run")
    (tmp_path / "run" / "trajectory.txt").write_text("# nothing\n")
    with pytest.raises(InputError, match="at least one pose"):
        export_run(tmp_path / "run", "tum", tmp_path / "t.txt")


def test_unknown_kind_is_refused(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="tum, kitti, colmap"):
        export_run(tmp_path, "bag", tmp_path / "x")  # type: ignore[arg-type]


@pytest.mark.parametrize("kind", ["tum", "kitti", "colmap"])
def test_a_place_that_cannot_be_written_is_one_line(tmp_path: Path, kind: formats.ExportKind) -> None:
    run_folder(tmp_path / "run")
    (tmp_path / "file").write_text("in the way")
    with pytest.raises(OutputError, match="expected to write"):
        export_run(tmp_path / "run", kind, tmp_path / "file" / "out")
    blocked = tmp_path / "blocked"
    if kind == "colmap":
        blocked.write_text("a file where a folder should be")
    else:
        blocked.mkdir()
    with pytest.raises(OutputError, match="blocked"):
        export_run(tmp_path / "run", kind, blocked)
