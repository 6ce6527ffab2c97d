"""Trajectory and cloud files: what is written comes back, and what is broken is named."""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from mastd3r.errors import InputError, OutputError
from mastd3r.export.export_folder import export_folder
from mastd3r.export.files import write_json, write_text
from mastd3r.export.point_cloud import read_cloud, write_cloud
from mastd3r.export.report_files import run_files
from mastd3r.export.trajectory_files import read_tum, write_tum
from mastd3r.reading.ply import read_vertices
from mastd3r.types import StaticCloud, Trajectory


@pytest.mark.parametrize("out", [".", "", "..", "/"])
def test_what_has_no_name_of_its_own_is_refused(out: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    with pytest.raises(OutputError, match="expected a file with a name of its own"):
        write_text(Path(out), "x")
    with pytest.raises(OutputError, match="expected a folder with a name of its own"), export_folder(Path(out), {}, []):
        pass
    assert not list(tmp_path.iterdir())


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="needs named pipes")
def test_a_pipe_or_a_device_is_no_place_for_a_file(tmp_path: Path) -> None:
    pipe = tmp_path / "metrics.json"
    os.mkfifo(pipe)
    with pytest.raises(OutputError, match="a device or a pipe"):
        write_json(pipe, {"ate": 1.0})
    assert pipe.is_fifo() and list(tmp_path.iterdir()) == [pipe]


def test_the_list_of_files_leaves_out_what_cannot_be_looked_at(tmp_path: Path) -> None:
    (tmp_path / "link").symlink_to("nowhere")
    (tmp_path / "cloud.ply").write_text("x")
    assert [f.name for f in run_files(tmp_path)] == ["cloud.ply"]


def test_trajectory_comes_back(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    poses = np.tile(np.eye(4), (50, 1, 1))
    poses[:, :3, :3] = Rotation.random(50, random_state=rng).as_matrix()
    poses[:, :3, 3] = rng.normal(0, 100, (50, 3))
    times = 1341841278.8427 + np.arange(50) / 30
    write_tum(tmp_path / "t.txt", Trajectory(times, poses, ("tracked",) * 50, np.zeros(50, bool)))
    back = read_tum(tmp_path / "t.txt")
    assert np.allclose(back.timestamps_s, times, atol=6e-7, rtol=0)
    assert np.allclose(back.world_from_cam, poses, atol=1e-8, rtol=0)


def test_the_file_is_what_evo_reads(tmp_path: Path) -> None:
    from evo.tools.file_interface import read_tum_trajectory_file

    rng = np.random.default_rng(0)
    poses = np.tile(np.eye(4), (5, 1, 1))
    poses[:, :3, :3] = Rotation.random(5, random_state=rng).as_matrix()
    poses[:, :3, 3] = rng.normal(size=(5, 3))
    write_tum(tmp_path / "t.txt", Trajectory(np.arange(5.0), poses, ("tracked",) * 5, np.zeros(5, bool)))
    assert np.allclose(read_tum_trajectory_file(tmp_path / "t.txt").poses_se3, poses, atol=1e-8)
    first = (tmp_path / "t.txt").read_text().splitlines()[1].split()
    assert first[0] == "0.000000"
    assert len(first) == 8


def test_poses_that_are_not_finite_have_no_row(tmp_path: Path) -> None:
    poses = np.tile(np.eye(4), (3, 1, 1))
    poses[1, 0, 3] = np.nan
    write_tum(tmp_path / "t.txt", Trajectory(np.arange(3.0), poses, ("tracked",) * 3, np.zeros(3, bool)))
    assert read_tum(tmp_path / "t.txt").timestamps_s.tolist() == [0, 2]


@pytest.mark.parametrize("row", ["1 2 3", "1 2 3 4 0 0 0 0", "1 2 3 x 0 0 0 1", "1 2 3 4 0 0 0 1 9"])
def test_bad_rows_are_named(tmp_path: Path, row: str) -> None:
    (tmp_path / "t.txt").write_text(f"# header\n0 0 0 0 0 0 0 1\n{row}\n")
    with pytest.raises(InputError, match="line 3: expected"):
        read_tum(tmp_path / "t.txt")


def some_cloud(n: int) -> StaticCloud:
    rng = np.random.default_rng(0)
    return StaticCloud(
        rng.normal(size=(n, 3)).astype(np.float32),
        rng.integers(0, 256, (n, 3)).astype(np.uint8),
        rng.random(n).astype(np.float32),
        rng.random(n).astype(np.float32),
        rng.integers(0, 40, n).astype(np.int32),
    )


@pytest.mark.parametrize("n", [0, 1, 1000])
def test_cloud_comes_back_bit_for_bit(tmp_path: Path, n: int) -> None:
    cloud = some_cloud(n)
    write_cloud(tmp_path / "cloud.ply", cloud)
    back = read_cloud(tmp_path / "cloud.ply")
    for name in ("points_world", "colors", "confidence", "spacing", "kf_id"):
        ours, theirs = getattr(back, name), getattr(cloud, name)
        assert ours.dtype == theirs.dtype
        assert np.array_equal(ours, theirs)


def test_cloud_header_is_what_viewers_know(tmp_path: Path) -> None:
    write_cloud(tmp_path / "cloud.ply", some_cloud(2))
    head = (tmp_path / "cloud.ply").read_bytes().partition(b"end_header\n")[0].decode().splitlines()
    assert head[:9] == [
        "ply", "format binary_little_endian 1.0", "element vertex 2", "property float x", "property float y",
        "property float z", "property uchar red", "property uchar green", "property uchar blue",
    ]  # fmt: skip


def test_broken_clouds_are_named(tmp_path: Path) -> None:
    path = tmp_path / "cloud.ply"
    with pytest.raises(InputError, match="readable PLY"):
        read_cloud(path)
    write_cloud(path, some_cloud(10))
    whole = path.read_bytes()
    path.write_bytes(whole[:-5])
    with pytest.raises(InputError, match="expected 10 vertices of 27 bytes, got 265"):
        read_vertices(path)
    path.write_bytes(whole.replace(b"float spacing", b"float unknown"))
    with pytest.raises(InputError, match="spacing"):
        read_cloud(path)
    path.write_bytes(b"not a cloud")
    with pytest.raises(InputError, match="little-endian"):
        read_cloud(path)
    path.write_bytes(whole.replace(b"binary_little_endian", b"ascii"))
    with pytest.raises(InputError, match="little-endian"):
        read_cloud(path)
