"""Dense cloud and mesh of a run: the files open elsewhere, and what cannot be made is one clear line."""

from __future__ import annotations

import json
import shutil
import struct
from pathlib import Path

import numpy as np
import pytest

import mastd3r
from helpers import data_path
from mastd3r.camera.pinhole import Camera
from mastd3r.config import config_from_dict
from mastd3r.errors import ConfigError, InputError
from mastd3r.export.dense_files import write_dense_cloud
from mastd3r.export.mesh_files import linear, write_mesh
from mastd3r.export.point_cloud import read_points
from mastd3r.export.run_folder import RunFolder
from mastd3r.sources import synthetic
from mastd3r.sources.synthetic import SyntheticView, make_room_clip
from mastd3r.types import StaticCloud, Trajectory

VERTICES = np.array([[0, 0, 1], [1, 0, 2], [0, 2, 3], [1, 1, 1]], np.float32)
FACES = np.array([[0, 1, 2], [1, 3, 2]], np.int32)
COLORS = np.array([[255, 0, 0], [0, 255, 0], [0, 0, 255], [10, 128, 250]], np.uint8)


def test_the_cloud_opens_in_plyfile(tmp_path: Path) -> None:
    plyfile = pytest.importorskip("plyfile")
    normals = VERTICES / np.linalg.norm(VERTICES, axis=1, keepdims=True)
    write_dense_cloud(tmp_path / "c.ply", VERTICES, normals, COLORS, np.linspace(0, 1, 4))
    rows = plyfile.PlyData.read(str(tmp_path / "c.ply"))["vertex"].data
    assert rows.dtype.names == ("x", "y", "z", "nx", "ny", "nz", "red", "green", "blue", "confidence")
    np.testing.assert_array_equal(np.stack([rows[n] for n in "xyz"], 1), VERTICES)
    np.testing.assert_array_equal(np.stack([rows[n] for n in ("nx", "ny", "nz")], 1), normals)
    assert rows["blue"].tolist() == COLORS[:, 2].tolist()
    np.testing.assert_array_equal(read_points(tmp_path / "c.ply"), VERTICES)


def test_the_mesh_opens_in_plyfile(tmp_path: Path) -> None:
    plyfile = pytest.importorskip("plyfile")
    write_mesh(tmp_path / "m.ply", VERTICES, FACES, COLORS)
    data = plyfile.PlyData.read(str(tmp_path / "m.ply"))
    assert [list(f) for f in data["face"].data["vertex_indices"]] == FACES.tolist()
    assert data["vertex"].data["green"].tolist() == COLORS[:, 1].tolist()


@pytest.mark.parametrize("name", ["m.ply", "m.glb"])
def test_the_mesh_opens_in_trimesh(tmp_path: Path, name: str) -> None:
    trimesh = pytest.importorskip("trimesh")
    write_mesh(tmp_path / name, VERTICES, FACES, COLORS)
    mesh = trimesh.load(tmp_path / name, force="mesh", process=False)
    turned = VERTICES * ([1, -1, -1] if name.endswith("glb") else [1, 1, 1])
    np.testing.assert_allclose(mesh.vertices, turned)
    np.testing.assert_array_equal(mesh.faces, FACES)
    if name.endswith("ply"):
        np.testing.assert_array_equal(np.asarray(mesh.visual.vertex_colors)[:, :3], COLORS)
    else:
        assert "COLOR_0" in (tmp_path / name).read_bytes()[:2000].decode("ascii", "replace")


def test_a_glb_is_built_as_the_standard_says(tmp_path: Path) -> None:
    write_mesh(tmp_path / "m.glb", VERTICES, FACES, COLORS)
    data = (tmp_path / "m.glb").read_bytes()
    magic, version, length, json_length, kind = struct.unpack_from("<4sIIII", data)
    assert (magic, version, length, kind) == (b"glTF", 2, len(data), 0x4E4F534A)
    tree = json.loads(data[20 : 20 + json_length])
    blob_length, blob_kind = struct.unpack_from("<II", data, 20 + json_length)
    assert blob_kind == 0x004E4942 and blob_length == tree["buffers"][0]["byteLength"] and json_length % 4 == 0
    blob = data[28 + json_length :]
    views = tree["bufferViews"]
    assert all(v["byteOffset"] % 4 == 0 for v in views)
    light = np.frombuffer(blob, "<u2", 16, views[1]["byteOffset"]).reshape(-1, 4) / 65535
    np.testing.assert_allclose(light[:, :3], linear(COLORS / 255), atol=1e-4)
    indices = np.frombuffer(blob, "<u4", 6, views[2]["byteOffset"])
    np.testing.assert_array_equal(indices.reshape(-1, 3), FACES)
    places = np.frombuffer(blob, "<f4", 12, views[0]["byteOffset"]).reshape(-1, 3)
    assert tree["accessors"][0]["min"] == places.min(0).tolist()


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run folder of the room with true poses, and the clip it was made of beside it."""
    home = tmp_path_factory.mktemp("dense")
    made, view = dict[int, SyntheticView](), synthetic._Clip.view

    def kept(clip: synthetic._Clip, i: int) -> SyntheticView:
        made[i] = view(clip, i)
        return made[i]

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(synthetic._Clip, "view", kept)
        make_room_clip(home / "clip", frames=49)
    views = [made[i] for i in range(49)]
    folder = RunFolder(home / "run")
    times = np.round([v.frame.timestamp_s for v in views], 6)
    poses = np.stack([v.world_from_cam for v in views])
    states = ("started", *("tracked",) * 48)
    folder.write_trajectory(Trajectory(times, poses, states, np.arange(49) % 12 == 0))
    camera = Camera.centred(300.0, 320, 240)
    folder.write_camera(camera)
    points = []
    for v in views[::12]:
        folder.record["source"] = {"path": str(home / "clip"), "kind": "tum", "size": [320, 240]}
        at = camera.rays(camera.pixel_grid()) * v.depth_m[..., None]
        points.append((at @ v.world_from_cam[:3, :3].T + v.world_from_cam[:3, 3])[::10, ::10].reshape(-1, 3))
    p = np.concatenate(points).astype(np.float32)
    one = np.ones(len(p), np.float32)
    folder.write_cloud(StaticCloud(p, np.zeros((len(p), 3), np.uint8), one, one, np.zeros(len(p), np.int32)))
    for v in views:
        folder.write_mask(v.frame.timestamp_s, v.moving.astype(np.float32))
    folder.finish()
    return home / "run"


def test_a_finished_run_gives_cloud_and_mesh(run: Path, tmp_path: Path) -> None:
    rec = mastd3r.load(run)
    assert rec.export("cloud", tmp_path / "sub" / "c.ply") == tmp_path / "sub" / "c.ply"
    assert len(read_points(tmp_path / "sub" / "c.ply")) > 20_000
    rec.export("mesh", tmp_path / "m.glb")
    assert (tmp_path / "m.glb").stat().st_size > 100_000
    assert sorted(p.name for p in tmp_path.iterdir()) == ["m.glb", "sub"]


@pytest.mark.slow
def test_eval_scores_the_cloud_by_the_depth_of_the_sequence(run: Path, tmp_path: Path) -> None:
    scored = tmp_path / "run"
    shutil.copytree(run, scored)
    rec = mastd3r.load(scored)
    rec.export("cloud", scored / "cloud_dense.ply")
    found = rec.evaluate(run.parent / "clip")
    assert found["cloud_accuracy_m"] < 0.03 and found["cloud_accuracy_median_m"] < 0.015
    assert found["cloud_f_score_5cm"] > 0.8
    assert json.loads((scored / "metrics.json").read_text())["cloud_f_score_5cm"] == found["cloud_f_score_5cm"]


def test_bad_requests_are_one_clear_line(run: Path, tmp_path: Path) -> None:
    rec = mastd3r.load(run)
    with pytest.raises(
        ConfigError, match=r"export --to mesh: expected a file name that ends in .ply or .glb, got .*m.obj"
    ):
        rec.export("mesh", tmp_path / "m.obj")
    with pytest.raises(ConfigError, match=r"export --to cloud: expected a file name that ends in .ply, got"):
        rec.export("cloud", tmp_path / "c.glb")
    with pytest.raises(ConfigError, match=r"export --source: expected --to .*cloud, mesh, got --to tum"):
        rec.export("tum", tmp_path / "t.txt", source=run.parent / "clip")
    other = make_room_clip(tmp_path / "small", frames=4, width=160, height=120)
    with pytest.raises(InputError, match=r"expected photographs of 320x240, .* got 160x120"):
        rec.export("cloud", tmp_path / "c.ply", source=other)
    short = make_room_clip(tmp_path / "short", frames=4)
    with pytest.raises(InputError, match=r"expected the 9 keyframes .* got none at 0.200000 s"):
        rec.export("cloud", tmp_path / "c.ply", source=short)
    assert not (tmp_path / "c.ply").exists()
    without = tmp_path / "without"
    shutil.copytree(run, without)
    (without / "cloud.ply").unlink()
    with pytest.raises(InputError, match=r"cloud.ply: expected a readable PLY file"):
        mastd3r.load(without).export("cloud", tmp_path / "c.ply")


@pytest.mark.slow
def test_kitchen_is_dense_and_right(tmp_path: Path) -> None:
    """A whole run, sensor depth for the judgement alone: the figures of docs/results.md, with slack."""
    kitchen = data_path("kitchen")
    config = config_from_dict({"cloud": "dense", "mapping": {"enabled": False}})
    rec = mastd3r.reconstruct(kitchen, tmp_path / "run", config)
    found = rec.evaluate(kitchen)
    assert found["cloud_accuracy_median_m_registered"] < 0.015
    assert found["cloud_accuracy_m_registered"] < 0.025
    assert found["cloud_f_score_5cm_registered"] > 0.8
