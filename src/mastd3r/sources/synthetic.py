"""The demo's clip: a small furnished room with a moving ball, seeded, with exact truth."""

from __future__ import annotations

import json
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from ..camera.pinhole import Camera
from ..concurrency import on_two_threads
from ..errors import OutputError
from ..types import Frame
from .room import RayGrid, Room, camera_pose

Array = NDArray[Any]
CLIP_FPS = 30.0
DEPTH_SCALE = 5000  # units a metre of the written depth files
FOCAL_RATIO = 0.9375  # focal length over image width: 300 px at 320
SENSOR_NOISE = 1.6  # standard deviation, grey levels


@dataclass(frozen=True)
class SyntheticView:
    """One frame of the room and everything true about it."""

    frame: Frame  # carries no depth: what a camera alone gives
    depth_m: Array  # (h, w) float32, exact at pixel centres, ball included
    moving: Array  # (h, w) bool, the ball
    world_from_cam: Array  # (4, 4) float64, in metres


def room_camera(width: int = 320, height: int = 240) -> Camera:
    """The camera of the made room: no distortion, principal point in the middle."""
    return Camera.centred(FOCAL_RATIO * width, width, height)


class _Clip:
    """Views of a room by number; each can be made alone, in any order."""

    def __init__(self, width: int, height: int, seed: int) -> None:
        self.room, self.seed = Room(seed), seed
        camera = room_camera(width, height)
        self.grid, self.fine = RayGrid(camera), RayGrid(camera.resized(2 * width, 2 * height))

    def view(self, i: int) -> SyntheticView:
        time_s = i / CLIP_FPS
        pose = camera_pose(time_s)
        camera = self.grid.camera
        centre = self.room.cast(self.grid, pose, time_s)
        colour = self.room.shade(self.room.cast(self.fine, pose, time_s), self.fine, pose)
        image = colour.reshape(camera.height, 2, camera.width, 2, 3).mean((1, 3))  # 2x2 rays a pixel
        image += np.random.default_rng((self.seed, i)).normal(0, SENSOR_NOISE, image.shape)
        return SyntheticView(
            Frame(i, time_s, np.rint(image.clip(0, 255)).astype(np.uint8)),
            centre.depth.reshape(camera.height, camera.width),
            centre.ball.reshape(camera.height, camera.width),
            pose,
        )


def synthetic_frames(
    frames: int = 90, width: int = 320, height: int = 240, seed: int = 0, every: int = 1
) -> Iterator[SyntheticView]:
    """Frames of the room at 30 a second, one after another, or ``every`` such one of them.

    The same seed gives the same pixels.
    """
    return map(_Clip(width, height, seed).view, range(0, frames, every))


def make_room_clip(folder: Path, frames: int = 90, width: int = 320, height: int = 240, seed: int = 0) -> Path:
    """Write the clip as a TUM-layout folder with depth, masks and poses. Raises OutputError."""
    clip, kinds = _Clip(width, height, seed), ("rgb", "depth", "mask")

    def write(i: int) -> tuple[str, str]:
        """One view's files; its time stamp, and its line of groundtruth.txt."""
        view = clip.view(i)
        stamp = f"{view.frame.timestamp_s:.6f}"
        for name, image in _files_of(view).items():
            _write_png(folder / name / f"{stamp}.png", image)
        return stamp, _pose_line(stamp, view.world_from_cam)

    try:
        for name in kinds:
            (folder / name).mkdir(parents=True, exist_ok=True)
        written = on_two_threads(write, range(frames))
        for name in kinds:
            _write_lines(folder / f"{name}.txt", "timestamp_s filename", [f"{t} {name}/{t}.png" for t, _ in written])
        poses = [line for _, line in written]
        _write_lines(folder / "groundtruth.txt", "timestamp_s tx ty tz qx qy qz qw (world_from_cam)", poses)
        (folder / "info.json").write_text(json.dumps(_info(frames, width, height, seed), indent=1))
    except OSError as e:
        raise OutputError(f"{folder}: expected to write the demo's clip, got {e}") from e
    return folder


def _files_of(view: SyntheticView) -> dict[str, Array]:
    depth = np.rint(view.depth_m * DEPTH_SCALE).clip(0, 65535).astype(np.uint16)
    return {
        "rgb": cv2.cvtColor(view.frame.image, cv2.COLOR_RGB2BGR),
        "depth": depth,
        "mask": np.where(view.moving, np.uint8(255), np.uint8(0)),
    }


def _write_png(path: Path, image: Array) -> None:
    done, data = cv2.imencode(".png", image, [cv2.IMWRITE_PNG_COMPRESSION, 1])
    if not done:
        raise OutputError(f"{path}: expected to encode a PNG, got a refusal for {image.dtype} {image.shape}")
    path.write_bytes(data.tobytes())


def _write_lines(path: Path, head: str, lines: list[str]) -> None:
    path.write_text("\n".join([f"# {head}", *lines]) + "\n")


def _pose_line(stamp: str, world_from_cam: Array) -> str:
    xyzw = Rotation.from_matrix(world_from_cam[:3, :3]).as_quat()
    return " ".join([stamp, *(f"{v:.9f}" for v in (*world_from_cam[:3, 3], *xyzw))])


def _info(frames: int, width: int, height: int, seed: int) -> dict[str, Any]:
    camera = room_camera(width, height)
    return {
        "source": "made by mastd3r: a ray-cast room with a moving ball",
        "seed": seed,
        "fps": CLIP_FPS,
        "frames": frames,
        "width": width,
        "height": height,
        "fx": camera.fx_px,
        "fy": camera.fy_px,
        "cx": camera.cx_px,
        "cy": camera.cy_px,
        "depth_scale": DEPTH_SCALE,
    }
