"""Clean plates: the photograph where things stand still, the splat where they move."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest

import mastd3r
from made_runs import NAMES, edited_record, made_run, moving_of
from mastd3r.camera.pinhole import Camera
from mastd3r.errors import InputError
from mastd3r.mapping.gaussians import GaussianArrays
from mastd3r.mapping.ply import write_gaussians_ply
from mastd3r.offline.plates import feathered

LENS = Camera(90.0, 90.0, 47.0, 36.5, 96, 72, k1=-0.08)
RED = (0.9, 0.1, 0.1)


def red_wall(path: Path) -> None:
    """A splat that is the same red wherever one looks."""
    x, y = (v.ravel() for v in np.meshgrid(np.linspace(-6, 6, 25), np.linspace(-6, 6, 25)))
    n = len(x)
    means = np.stack([x, y, np.full(n, 5.0)], -1)
    upright, scales = np.tile([1.0, 0, 0, 0], (n, 1)), np.full((n, 3), 0.5)
    colors, ids = np.tile(RED, (n, 1)), np.zeros(n, np.int32)
    parts = (p.astype(np.float32) for p in (means, scales, upright, np.full(n, 0.99), colors))
    write_gaussians_ply(path, GaussianArrays(*parts, ids, np.zeros((n, 0, 3), np.float32)))


def test_what_moves_is_replaced_by_the_splat_and_nothing_else(tmp_path: Path) -> None:
    run = made_run(tmp_path, LENS)
    red_wall(run.path / "gaussians.ply")
    edited_record(run.path, map={"median_depth": 5.0})
    out = mastd3r.load(run.path).export("plates", tmp_path / "out")
    times = [f"{t:.6f}.png" for t in run.trajectory.timestamps_s]
    assert sorted(p.name for p in (out / "images").iterdir()) == times
    for n, (name, plate_name) in enumerate(zip(NAMES, times, strict=True)):
        photograph = cv2.imread(str(run.photographs / "shots" / name)).astype(int)
        plate = cv2.imread(str(out / "images" / plate_name)).astype(int)
        moving = cv2.resize(moving_of(n, LENS), (96, 72)) > 0.5
        far = cv2.dilate(moving.astype(np.uint8), np.ones((13, 13))) == 0
        assert np.abs(plate - photograph)[far].max() <= 1  # JPEG decoders differ by one level
        assert np.abs(plate[moving] - 255 * np.array(RED[::-1])).max() < 8


def test_the_rim_is_feathered() -> None:
    levels = np.zeros((60, 80), np.uint8)
    levels[20:40, 30:50] = 255
    share = feathered(levels, (640, 480))
    row = share[240]
    assert row[:200].max() == 0 and (row[250:390] == 1).all()
    rising = row[200:260]
    assert (np.diff(rising) >= -1e-6).all() and np.abs(np.diff(rising)).max() < 0.3


def test_a_run_without_a_map_is_refused(tmp_path: Path) -> None:
    run = made_run(tmp_path, LENS)
    with pytest.raises(InputError, match=r"gaussians\.ply"):
        mastd3r.load(run.path).export("plates", tmp_path / "out")
    assert not (tmp_path / "out").exists()
