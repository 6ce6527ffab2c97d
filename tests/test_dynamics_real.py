"""The mask on real images with a person composited in (semi-synthetic): kitchen_walk, true poses, sensor background."""

from __future__ import annotations

import json
import os
from pathlib import Path

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from mastd3r.camera.pinhole import Camera
from mastd3r.dynamics.config import DynamicsConfig
from mastd3r.dynamics.data import DynamicsInput
from mastd3r.dynamics.filter import LogOddsFilter

DATA = Path(os.environ.get("MASTD3R_DATA", Path(__file__).resolve().parents[2] / "shared" / "data"))
W, H, SCALE = 512, 384, 0.37  # the map's unit is arbitrary


def rows(path: Path) -> list[list[str]]:
    return [line.split() for line in path.read_text().splitlines() if line.strip() and line[0] != "#"]


def background(path: str, depth_scale: float) -> tuple[np.ndarray, np.ndarray]:
    """Coarse inverse depth of the empty kitchen in map units, from a 16 px grid, and its sigma; holes are unknown."""
    depth = cv2.resize(cv2.imread(path, -1).astype(np.float32) / depth_scale, (W // 16, H // 16), interpolation=0)
    inv = np.where(depth > 0, 1 / np.maximum(depth, 0.1), 0).astype(np.float32) / SCALE
    spread = cv2.dilate(inv, np.ones((3, 3))) - cv2.erode(inv, np.ones((3, 3)))
    sigma = np.where(depth > 0, 0.03 * inv + 0.25 * spread, 1e6).astype(np.float32)
    full = cv2.resize(sigma, (W, H))
    return cv2.resize(inv, (W, H)), np.where(full > 100, np.inf, full).astype(np.float32)


def play(config: DynamicsConfig, walk: bool, maps: bool, start: int, count: int) -> tuple[float, float, float]:
    """(mean IoU, mean IoU of the maps alone, mean share of false positives); IoU 0 where nothing moves."""
    if not (DATA / "kitchen_walk").is_dir():
        pytest.skip(f"no kitchen_walk in {DATA}")
    info = json.loads((DATA / "kitchen/info.json").read_text())
    lens = Camera(info["fx"], info["fy"], info["cx"], info["cy"], info["width"], info["height"], info["k1"])
    seq = DATA / ("kitchen_walk" if walk else "kitchen")
    truth = np.array([[float(v) for v in r] for r in rows(DATA / "kitchen/groundtruth.txt")])
    depth = dict(rows(DATA / "kitchen/depth.txt"))  # type: ignore[arg-type]
    mask_filter, ious, alone, false = LogOddsFilter(config, W, H), [], [], []
    for i, (stamp, name) in enumerate(rows(seq / "rgb.txt")[start : start + count]):
        pose = np.eye(4)
        row = truth[np.abs(truth[:, 0] - float(stamp)).argmin()]
        pose[:3, :3], pose[:3, 3] = Rotation.from_quat(row[4:8]).as_matrix(), row[1:4] * SCALE
        gray = cv2.resize(cv2.imread(str(seq / name), 0), (W, H), interpolation=cv2.INTER_AREA)
        inv, sigma = background(str(DATA / "kitchen" / depth[stamp]), info["depth_scale"])
        semantic = None
        if maps:
            semantic = cv2.resize(cv2.imread(str(seq / f"semantic/{stamp}.png"), 0), (W, H)).astype(np.float32) / 255
        mask_filter.prior(gray, semantic)
        mask = mask_filter.update(
            DynamicsInput(i, float(stamp), gray, lens.resized(W, H), pose, inv, sigma, None, semantic)
        )
        moving = np.zeros((H, W), bool)
        if walk:
            moving = cv2.resize(cv2.imread(str(seq / f"mask/{stamp}.png"), 0), (W, H)) > 127
        false.append((mask.moving & ~moving).mean())
        if moving.mean() >= 0.01:
            ious.append((mask.moving & moving).sum() / (mask.moving | moving).sum())
            if semantic is not None:
                alone.append(((semantic > 0.5) & moving).sum() / ((semantic > 0.5) | moving).sum())
    return float(np.mean(ious or [0])), float(np.mean(alone or [0])), float(np.mean(false))


def test_people_are_found_without_any_semantics() -> None:
    assert play(DynamicsConfig(), walk=True, maps=False, start=40, count=50)[0] > 0.6


@pytest.mark.slow
def test_with_maps_better_than_the_maps_alone() -> None:
    ours, alone, _ = play(DynamicsConfig(), walk=True, maps=True, start=0, count=200)
    assert ours > alone + 0.01


def test_the_empty_kitchen_stays_static() -> None:
    assert play(DynamicsConfig(), walk=False, maps=False, start=40, count=50)[2] < 0.01
