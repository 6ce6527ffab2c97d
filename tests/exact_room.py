"""A run over the made room in which everything is exact: what maps are saved of in tests."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from mastd3r.config import Config, config_to_yaml
from mastd3r.export.run_folder import RunFolder
from mastd3r.export.tracks import Tracks
from mastd3r.geometry.se3 import inverse, transform
from mastd3r.sources import synthetic
from mastd3r.types import Trajectory

Array = NDArray[Any]
WIDTH, HEIGHT = 200, 150
KEYFRAMES, QUERY = (0, 1, 3, 4), 2  # of frames 0.2 s apart
SEEN_EVERY_PX = 5
LENS = synthetic.room_camera(WIDTH, HEIGHT)


def room_views(count: int = KEYFRAMES[-1] + 1, fps: float = 5.0) -> list[synthetic.SyntheticView]:
    """The first frames of the room's clip, ``fps`` a second."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(synthetic, "CLIP_FPS", fps)
        return list(synthetic.synthetic_frames(count, WIDTH, HEIGHT))


def photographs(folder: Path, views: list[synthetic.SyntheticView]) -> Path:
    """The frames as a sequence in TUM's layout."""
    folder.mkdir()
    lines = []
    for v in views:
        cv2.imwrite(str(folder / f"{v.frame.index}.png"), v.frame.image[..., ::-1])
        lines.append(f"{v.frame.timestamp_s:.6f} {v.frame.index}.png\n")
    (folder / "rgb.txt").write_text("".join(lines))
    return folder


def exact_run(root: Path, views: list[synthetic.SyntheticView]) -> Path:
    """``root``/run over ``root``/photos: points of every keyframe seen from all others."""
    photos = photographs(root / "photos", views)
    folder = RunFolder(root / "run", ["mastd3r", "run"])
    poses = np.stack([v.world_from_cam for v in views])
    times = np.array([v.frame.timestamp_s for v in views])
    is_keyframe = np.isin(np.arange(len(views)), KEYFRAMES)
    folder.write_trajectory(Trajectory(times, poses, ("tracked",) * len(views), is_keyframe))
    folder.write_camera(LENS)
    folder.write_tracks(_exact_tracks(views, times))
    for v in views:
        folder.write_mask(v.frame.timestamp_s, v.moving.astype(float))
    folder.write_config(config_to_yaml(Config()))
    folder.update(source={"path": str(photos), "kind": "tum"})
    folder.finish()
    return root / "run"


def _exact_tracks(views: list[synthetic.SyntheticView], times: Array) -> Tracks:
    x, y = np.meshgrid(np.arange(3, WIDTH, SEEN_EVERY_PX), np.arange(3, HEIGHT, SEEN_EVERY_PX))
    grid = np.stack([x, y], -1).reshape(-1, 2)
    points, point, frame, px = [], [], [], []
    for k in KEYFRAMES:
        still = ~views[k].moving[grid[:, 1], grid[:, 0]]
        at = grid[still]
        depth = views[k].depth_m[at[:, 1], at[:, 0]].astype(float)
        world = transform(views[k].world_from_cam, LENS.rays(at) * depth[:, None])
        first = sum(map(len, points))
        points.append(world)
        for f in KEYFRAMES:
            cam = transform(inverse(views[f].world_from_cam), world)
            seen = LENS.project(np.where(cam[:, 2:] > 0.1, cam, 1.0))
            inside = (cam[:, 2] > 0.1) & (seen >= 0).all(1) & (seen <= [WIDTH - 1, HEIGHT - 1]).all(1)
            row = np.rint(np.where(inside[:, None], seen, 0)).astype(int)
            inside &= np.abs(views[f].depth_m[row[:, 1], row[:, 0]] / cam[:, 2] - 1) < 0.05  # nothing stands before it
            point.append(first + np.flatnonzero(inside))
            frame.append(np.full(int(inside.sum()), f))
            px.append(seen[inside])
    world = np.concatenate(points).astype(np.float32)
    p, f = np.concatenate(point).astype(np.int32), np.concatenate(frame).astype(np.int32)
    order = np.lexsort((f, p))
    colors = np.zeros((len(world), 3), np.uint8)
    return Tracks(world, colors, times, p[order], f[order], np.concatenate(px)[order].astype(np.float32))
