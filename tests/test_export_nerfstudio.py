"""The nerfstudio export: its cameras' rays, made as nerfstudio's documentation says, are those of ours."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

import mastd3r
from made_runs import NAMES, made_run, without_distortion
from mastd3r.camera.opencv_lens import OpenCvLens
from mastd3r.camera.pinhole import Camera
from mastd3r.errors import InputError
from mastd3r.reading.ply import read_vertices

Array = NDArray[Any]
BENT = Camera(90.0, 90.0, 47.0, 36.5, 96, 72, k1=-0.08, k2=0.01)
LENSES = {
    "straight": without_distortion(BENT),
    "radial": BENT,
    "opencv": OpenCvLens(90.0, 92.0, 47.0, 36.5, 96, 72, (-0.08, 0.01, 0.002, -0.001, 0.003)),
}


def their_rays(meta: dict[str, Any], transform_matrix: Array, columns_rows: Array) -> Array:
    """(n, 3) unit rays in the world through the centres of pixels (column, row).

    As nerfstudio describes it: pixel centres lie at +0.5; OpenCV's distortion with r = x² + y²; camera axes are
    OpenGL's, x right, y up, looking along -z; transform_matrix takes camera coordinates to the world.
    """
    x_d = (columns_rows[:, 0] + 0.5 - meta["cx"]) / meta["fl_x"]
    y_d = (columns_rows[:, 1] + 0.5 - meta["cy"]) / meta["fl_y"]
    k1, k2, k3, p1, p2 = (meta.get(k, 0.0) for k in ("k1", "k2", "k3", "p1", "p2"))
    x, y = x_d.copy(), y_d.copy()
    for _ in range(100):
        r = x * x + y * y
        bend = 1 + r * (k1 + r * (k2 + r * k3))
        dx, dy = 2 * p1 * x * y + p2 * (r + 2 * x * x), 2 * p2 * x * y + p1 * (r + 2 * y * y)
        x, y = (x_d - dx) / bend, (y_d - dy) / bend
    directions = np.stack([x, -y, -np.ones_like(x)], -1) @ transform_matrix[:3, :3].T
    return directions / np.linalg.norm(directions, axis=1, keepdims=True)


@pytest.mark.parametrize("undistort", [None, False])
@pytest.mark.parametrize("name", LENSES)
def test_rays_are_those_of_our_camera(name: str, undistort: bool | None, tmp_path: Path) -> None:
    run = made_run(tmp_path, LENSES[name])
    out = mastd3r.load(run.path).export("nerfstudio", tmp_path / "out", undistort=undistort)
    meta = json.loads((out / "transforms.json").read_text())
    kept = undistort is False or name == "straight"
    assert meta["camera_model"] == ("OPENCV" if kept and name != "straight" else "PINHOLE")
    px = np.random.default_rng(0).integers(0, [meta["w"], meta["h"]], (100, 2)).astype(float)
    focal, centre = np.array([meta["fl_x"], meta["fl_y"]]), np.array([meta["cx"] - 0.5, meta["cy"] - 0.5])
    ours = run.lens.rays(px) if kept else np.concatenate([(px - centre) / focal, np.ones((100, 1))], 1)
    for frame, pose in zip(meta["frames"], run.trajectory.world_from_cam, strict=True):
        matrix = np.array(frame["transform_matrix"])
        directions = ours @ pose[:3, :3].T
        directions /= np.linalg.norm(directions, axis=1, keepdims=True)
        angle = np.linalg.norm(np.cross(directions, their_rays(meta, matrix, px)), axis=1)
        assert angle.max() <= 1e-6 and (directions * their_rays(meta, matrix, px)).sum(1).min() > 0
        assert np.allclose(matrix[:, 3], pose[:, 3], atol=1e-8)


def test_its_files_are_there(tmp_path: Path) -> None:
    run = made_run(tmp_path, BENT)
    out = mastd3r.load(run.path).export("nerfstudio", tmp_path / "out")
    meta = json.loads((out / "transforms.json").read_text())
    assert [f["file_path"] for f in meta["frames"]][:4] == [f"images/{n}" for n in NAMES[:4]]
    for frame in meta["frames"]:
        for key in ("file_path", "mask_path"):
            assert cv2.imread(str(out / frame[key])).shape[:2] == (meta["h"], meta["w"])
    rows = read_vertices(out / meta["ply_file_path"])
    assert np.allclose(np.stack([rows[a] for a in "xyz"], -1), run.tracks.points_world)


def test_distortion_that_nerfstudio_cannot_hold_is_refused(tmp_path: Path) -> None:
    lens = OpenCvLens(90.0, 90.0, 47.0, 36.5, 96, 72, (-0.08, 0.01, 0.0, 0.0, 0.01, 0.02, 0.01, 0.001))
    run = made_run(tmp_path, lens)
    with pytest.raises(InputError, match=r"expected distortion of k1, k2, p1, p2 and k3.*use --undistort"):
        mastd3r.load(run.path).export("nerfstudio", tmp_path / "out", undistort=False)
    assert not (tmp_path / "out").exists()
    assert mastd3r.load(run.path).export("nerfstudio", tmp_path / "out").is_dir()
