"""The camera's path as line segments, coloured by how each frame came by its pose."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..camera.pinhole import Camera
from ..geometry.se3 import transform
from ..types import State

Array = NDArray[Any]
Colour = tuple[int, int, int]
STATE_COLOURS: dict[State, Colour] = {  # those of the report on a dark page; lost: bridges from pose to pose
    "started": (110, 168, 255),
    "tracked": (110, 168, 255),
    "interpolated": (240, 176, 79),
    "lost": (255, 114, 114),
}
SELECTED_COLOUR: Colour = (255, 255, 255)
MOVED_RATIO = 1.5  # of a frustum's length: how far the camera goes until the next one is drawn
TURNED_RAD = 0.35  # or turns
FOV_UNKNOWN_RAD = 1.0  # vertical, where there is no lens
ASPECT_UNKNOWN = 4 / 3


def corner_rays(camera: Camera | None) -> Array:
    """(4, 3) directions, z = 1, to the image's corners in order around it, lens distortion left out."""
    if camera is None:
        y = float(np.tan(FOV_UNKNOWN_RAD / 2))
        x = ASPECT_UNKNOWN * y
        return np.array([[-x, -y, 1], [x, -y, 1], [x, y, 1], [-x, y, 1]])
    right, below = camera.width - 0.5, camera.height - 0.5
    return camera.pinhole.rays(np.array([[-0.5, -0.5], [right, -0.5], [right, below], [-0.5, below]]))


def frustum(world_from_cam: Array, corners: Array, length: float) -> Array:
    """(8, 2, 3) segments of the pyramid from a camera (4, 4) to its image at ``length``."""
    ends = transform(world_from_cam, corners * length)
    starts = np.repeat(world_from_cam[None, :3, 3], 4, 0)
    return np.concatenate([np.stack([starts, ends], 1), np.stack([ends, np.roll(ends, -1, 0)], 1)])


class CameraPath:
    """Frames in order, and the segments that show them; no more frusta than the eye can tell apart."""

    def __init__(self, corners: Array, length: float) -> None:
        """``corners``: ``corner_rays`` of the lens. ``length``: of a frustum, in map units."""
        self._corners, self._length = corners, length
        self._poses: list[Array | None] = []
        self._states: list[State] = []
        self._has_frustum: list[bool] = []
        self._drawn: Array | None = None  # pose of the last frustum
        self._before: list[int] = []  # of every frame, the last one before it that has a pose; -1: none
        self._last_posed = -1

    def __len__(self) -> int:
        return len(self._poses)

    def add(self, world_from_cam: Array | None, state: State) -> None:
        """One more frame: its pose (4, 4), or None where it has none."""
        posed = world_from_cam is not None and bool(np.isfinite(world_from_cam).all())
        pose = np.asarray(world_from_cam, float) if posed else None
        self._before.append(self._last_posed)
        self._has_frustum.append(pose is not None and self._is_far(pose, state))
        self._poses.append(pose)
        self._states.append(state)
        if pose is not None:
            self._last_posed = len(self._poses) - 1
            self._drawn = pose if self._has_frustum[-1] else self._drawn

    def pose(self, index: int) -> Array | None:
        """(4, 4) world_from_cam of a frame; None where it has none."""
        return self._poses[index]

    def state(self, index: int) -> State:
        """How a frame came by its pose."""
        return self._states[index]

    def segments(self, first: int, last: int) -> tuple[Array, Array]:
        """Line segments (n, 2, 3) float32 of the frames first … last - 1, and their colours (n, 2, 3) uint8."""
        parts, colours = [np.empty((0, 2, 3))], [np.empty((0, 3), np.uint8)]
        for i in range(first, last):
            pose, before = self._poses[i], self._before[i]
            if pose is None:
                continue
            colour = STATE_COLOURS[self._states[i]]
            lines = frustum(pose, self._corners, self._length) if self._has_frustum[i] else np.empty((0, 2, 3))
            kinds = [colour] * len(lines)
            if before >= 0:
                from_before = np.stack([self._poses[before][:3, 3], pose[:3, 3]])  # type: ignore[index]
                lines = np.concatenate([lines, from_before[None]])
                kinds.append(STATE_COLOURS["lost"] if before < i - 1 else colour)
            parts.append(lines)
            colours.append(np.array(kinds, np.uint8).reshape(-1, 3))
        joined = np.concatenate(colours)
        return np.concatenate(parts).astype(np.float32), np.repeat(joined[:, None], 2, 1)

    def selected(self, index: int) -> Array:
        """(8, 2, 3) float32 segments of one frame's frustum; none where it has no pose."""
        pose = self._poses[index]
        lines = np.empty((0, 2, 3)) if pose is None else frustum(pose, self._corners, self._length)
        return lines.astype(np.float32)

    def _is_far(self, pose: Array, state: State) -> bool:
        """Whether a frame's frustum stands apart from the last that was drawn, or its state is another."""
        if self._drawn is None or STATE_COLOURS[state] != STATE_COLOURS[self._states[-1]]:
            return True
        apart = float(np.linalg.norm(pose[:3, 3] - self._drawn[:3, 3]))
        cosine = (float(np.trace(pose[:3, :3].T @ self._drawn[:3, :3])) - 1) / 2
        return apart > MOVED_RATIO * self._length or float(np.arccos(np.clip(cosine, -1, 1))) > TURNED_RAD


def upright(world_from_cam: Array, world_up: Sequence[float] = (0.0, -1.0, 0.0)) -> Array:
    """(3,) the up direction, nearest to the world's, with which a look along the camera's axis is the camera's pose.

    Orbiting goes around it: a camera that is not rolled orbits around the world's own.
    """
    right, own = world_from_cam[:3, 0], -world_from_cam[:3, 1]
    up = np.asarray(world_up, float) - (np.asarray(world_up, float) @ right) * right
    return up / np.linalg.norm(up) if up @ own > 0.05 else own
