"""The map on real photographs (kitchen, truth poses, seeds from sensor depth) draws unseen frames well."""

from __future__ import annotations

import os
from pathlib import Path

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from mastd3r.camera.pinhole import Camera
from mastd3r.config import MappingConfig
from mastd3r.mapping.mapper import Mapper
from mastd3r.types import StaticCloud, View

DATA = Path(os.environ.get("MASTD3R_DATA", Path(__file__).resolve().parents[2] / "shared" / "data")) / "kitchen"
FULL = Camera(519.0, 519.0, 319.5, 239.5, 640, 480)
SMALL = FULL.resized(160, 120)


def listed(name: str) -> list[str]:
    return [line.split()[1] for line in (DATA / name).read_text().splitlines() if not line.startswith("#")]


def poses() -> np.ndarray:
    table = np.loadtxt(DATA / "groundtruth.txt")
    world_from_cam = np.tile(np.eye(4), (len(table), 1, 1))
    world_from_cam[:, :3, :3] = Rotation.from_quat(table[:, 4:8]).as_matrix()
    world_from_cam[:, :3, 3] = table[:, 1:4]
    return world_from_cam


def undistorted(name: str, flag: int) -> np.ndarray:
    image = cv2.imread(str(DATA / name), cv2.IMREAD_UNCHANGED)
    distortion = np.array([-0.0326, 0, 0, 0])
    maps = cv2.initUndistortRectifyMap(FULL.matrix, distortion, None, FULL.matrix, (640, 480), cv2.CV_32FC1)
    return cv2.remap(image, *maps, flag)


def photograph(name: str) -> np.ndarray:
    image = cv2.cvtColor(undistorted(name, cv2.INTER_LINEAR), cv2.COLOR_BGR2RGB)
    return cv2.resize(image, (SMALL.width, SMALL.height), interpolation=cv2.INTER_AREA).astype(np.float32) / 255


def seeds(frames: list[int], world_from_cam: np.ndarray, colors: dict[int, np.ndarray]) -> StaticCloud:
    points, rgb, spacing, ids = [], [], [], []
    rows, columns = np.mgrid[4:480:8, 4:640:8]
    for i in frames:
        z = undistorted(listed("depth.txt")[i], cv2.INTER_NEAREST)[rows, columns] / 1000.0
        good = (z > 0.2) & (z < 8)
        px = np.stack([columns[good], rows[good]], -1)
        points_cam = FULL.rays(px) * z[good][:, None]
        points.append(points_cam @ world_from_cam[i, :3, :3].T + world_from_cam[i, :3, 3])
        rgb.append(colors[i][rows[good] // 4, columns[good] // 4])
        spacing.append(z[good] * 8 / FULL.fx_px)
        ids.append(np.full(int(good.sum()), i))
    xyz, spread = np.concatenate(points).astype(np.float32), np.concatenate(spacing).astype(np.float32)
    color = (np.concatenate(rgb) * 255).astype(np.uint8)
    return StaticCloud(xyz, color, np.ones(len(xyz), np.float32), spread, np.concatenate(ids).astype(np.int32))


@pytest.mark.slow
def test_unseen_frames_of_a_real_room_are_drawn_well() -> None:
    if not (DATA / "rgb.txt").exists():
        pytest.skip(f"no data at {DATA}; set MASTD3R_DATA")
    names, world_from_cam = listed("rgb.txt"), poses()
    images = {i: photograph(names[i]) for i in range(0, 96, 2)}
    train = [i for i in images if i % 8 != 0]
    ones = np.ones((SMALL.height, SMALL.width), np.float32)
    views = [View(i / 30, np.rint(images[i] * 255).astype(np.uint8), ones, world_from_cam[i], SMALL, i) for i in train]
    cloud = seeds(train[::4], world_from_cam, images)
    mapper = Mapper(MappingConfig(iterations=300, max_gaussians=20000), cloud, views, seed=0)
    mapper.refine(300)
    quality = []
    for i in range(8, 96, 8):
        color, _, alpha = mapper.render(world_from_cam[i], SMALL)
        quality.append(-10 * np.log10(np.square(color - images[i]).mean()))
        assert alpha.mean() > 0.9
    assert np.mean(quality) > 23, quality
    assert min(quality) > 20, quality
