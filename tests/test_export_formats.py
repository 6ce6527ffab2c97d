"""TUM, KITTI and EuRoC: poses are ours, those that were not measured are left out or told, other readers agree."""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import mastd3r
from made_runs import MadeRun, edited_record, made_run
from mastd3r.camera.pinhole import Camera
from mastd3r.errors import ConfigError, InputError, MissingPackage, OutputError
from mastd3r.export.formats import evenly
from mastd3r.export.trajectory_files import read_trajectory

CAMERA = Camera(90.0, 90.0, 47.0, 36.5, 96, 72, k1=-0.05)
STATES = ("started", "tracked", "interpolated", "interpolated", "tracked")
MEASURED = [0, 1, 4]


@pytest.fixture
def run(tmp_path: Path) -> MadeRun:
    return made_run(tmp_path, CAMERA, STATES)  # type: ignore[arg-type]


def exported(run: MadeRun, kind: str, **options: object) -> Path:
    return mastd3r.load(run.path).export(kind, run.path.parent / "deep" / "poses", **options)  # type: ignore[arg-type]


@pytest.mark.parametrize("kind", ["tum", "euroc"])
def test_what_was_measured_is_read_back(run: MadeRun, kind: str, caplog: pytest.LogCaptureFixture) -> None:
    read = read_trajectory(exported(run, kind), kind, np.zeros(0))
    assert np.allclose(read.world_from_cam, run.trajectory.world_from_cam[MEASURED], atol=1e-8)
    assert np.allclose(read.timestamps_s, run.trajectory.timestamps_s[MEASURED], atol=1e-9)
    assert "2 of 5 poses are interpolated, and left out" in caplog.text
    whole = read_trajectory(exported(run, kind, all_poses=True), kind, np.zeros(0))
    assert np.allclose(whole.world_from_cam, run.trajectory.world_from_cam, atol=1e-8)
    assert "among the others" in caplog.text


def test_euroc_rows_are_nanoseconds_position_and_quaternion_wxyz(run: MadeRun) -> None:
    head, first, *rest = exported(run, "euroc").read_text().splitlines()
    assert head.startswith("#timestamp [ns]") and len(rest) == 2
    words = first.split(",")
    assert words[0] == "100000000000" and len(words) == 8
    assert np.allclose(np.array(words[1:4], float), run.trajectory.world_from_cam[0, :3, 3], atol=1e-8)
    assert float(words[4]) > 0.9  # w: the cameras hardly turn


def test_evo_reads_all_three(run: MadeRun) -> None:
    interface = pytest.importorskip("evo.tools.file_interface")
    poses = run.trajectory.world_from_cam
    assert np.allclose(interface.read_tum_trajectory_file(exported(run, "tum")).poses_se3, poses[MEASURED], atol=1e-8)
    assert np.allclose(interface.read_euroc_csv_trajectory(exported(run, "euroc")).poses_se3, poses[MEASURED])
    assert np.allclose(interface.read_kitti_poses_file(exported(run, "kitti")).poses_se3, poses, atol=1e-8)


def test_evo_reads_the_ros_bag_whose_map_is_upright(run: MadeRun) -> None:
    """Both topics say the same poses; gravity, along +y in our world, is along -z in the map."""
    rosbag2, typesys = (pytest.importorskip(f"rosbags.{n}") for n in ("rosbag2", "typesys"))
    interface = pytest.importorskip("evo.tools.file_interface")
    out = exported(run, "ros")
    ours = run.trajectory.world_from_cam[MEASURED]
    map_from_world = Rotation.from_euler("x", -90, degrees=True).as_matrix()
    assert np.allclose(map_from_world @ [0, 1, 0], [0, 0, -1])
    with rosbag2.Reader(out / "trajectory") as bag:
        read = interface.read_bag_trajectory(bag, "/camera/pose")
        store = typesys.get_typestore(typesys.Stores.ROS2_HUMBLE)
        said = [store.deserialize_cdr(raw, c.msgtype) for c, _, raw in bag.messages() if c.topic == "/tf"]
    assert np.allclose(read.timestamps, run.trajectory.timestamps_s[MEASURED], atol=1e-9)
    assert np.allclose(read.positions_xyz, ours[:, :3, 3] @ map_from_world.T, atol=1e-8)
    assert np.allclose([p[:3, :3] for p in read.poses_se3], map_from_world @ ours[:, :3, :3], atol=1e-8)
    for (placed,), position, wxyz in zip(
        [m.transforms for m in said], read.positions_xyz, read.orientations_quat_wxyz, strict=True
    ):
        assert (placed.header.frame_id, placed.child_frame_id) == ("map", "camera_optical_frame")
        t, q = placed.transform.translation, placed.transform.rotation
        assert np.allclose([t.x, t.y, t.z], position) and np.allclose([q.w, q.x, q.y, q.z], wxyz)


def test_a_bag_without_its_package_is_one_line(run: MadeRun, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "rosbags.rosbag2", None)
    with pytest.raises(MissingPackage, match=r"rosbags: pip install 'mastd3r-slam\[ros\]'"):
        exported(run, "ros")
    assert not (run.path.parent / "deep").exists()


def test_kitti_rows_are_all_poses(run: MadeRun, caplog: pytest.LogCaptureFixture) -> None:
    rows = np.loadtxt(exported(run, "kitti"))
    assert rows.shape == (5, 12)
    assert np.allclose(rows.reshape(-1, 3, 4), run.trajectory.world_from_cam[:, :3], atol=1e-8)
    assert "2 of 5 poses are interpolated, and among the others" in caplog.text


def test_kitti_refuses_frames_without_a_pose(run: MadeRun) -> None:
    (run.path / "metrics.json").write_text('{"frames": 7}')
    with pytest.raises(InputError, match="5 poses of 7 frames; use --to tum"):
        exported(run, "kitti")


@pytest.mark.parametrize(("count", "most"), [(0, 5), (4, 5), (5, 5), (6, 5), (1001, 100)])
def test_thinning_is_even(count: int, most: int) -> None:
    chosen = evenly(count, most)
    assert len(chosen) == min(count, most)
    assert len(set(chosen.tolist())) == len(chosen)
    if len(chosen) > 1:
        assert np.ptp(np.diff(chosen)) <= 1 and chosen[0] == 0 and count - chosen[-1] <= count // most + 1


@pytest.mark.parametrize("kind", ["tum", "colmap", "nerfstudio"])
def test_a_run_without_measured_poses_is_refused(run: MadeRun, kind: str) -> None:
    edited_record(run.path, states=[["interpolated", 5]])
    with pytest.raises(InputError, match=r"expected at least one pose, got none"):
        exported(run, kind)


def test_unknown_kinds_and_options_that_a_kind_does_not_have_are_refused(run: MadeRun) -> None:
    with pytest.raises(ConfigError, match=r"expected one of tum, kitti, euroc, .*colmap.* got 'bag'"):
        exported(run, "bag")
    for kind, options in {"tum": {"undistort": True}, "kitti": {"source": "x"}, "spz": {"all_poses": True}}.items():
        with pytest.raises(ConfigError, match=rf"expected --to .*, got --to {kind}"):
            exported(run, kind, **options)


@pytest.mark.parametrize("kind", ["tum", "kitti", "euroc", "colmap", "nerfstudio"])
def test_a_place_that_cannot_be_written_is_one_line(run: MadeRun, kind: str, tmp_path: Path) -> None:
    loaded = mastd3r.load(run.path)
    (tmp_path / "file").write_text("in the way")
    with pytest.raises(OutputError, match="expected to write"):
        loaded.export(kind, tmp_path / "file" / "out")
    blocked = tmp_path / "blocked"
    if kind in ("colmap", "nerfstudio"):
        blocked.write_text("a file where a folder should be")
    else:
        blocked.mkdir()
    with pytest.raises(OutputError, match="blocked"):
        loaded.export(kind, blocked)


@pytest.mark.parametrize("missing", ["camera.json", "cloud.ply"])
def test_what_is_missing_is_named(run: MadeRun, missing: str) -> None:
    (run.path / missing).unlink()
    with pytest.raises(InputError, match=missing.replace(".", r"\.")):
        exported(run, "nerfstudio")
    assert sorted(p.name for p in run.path.parent.iterdir()) in (["photos", "run"], ["deep", "photos", "run"])
