"""Reading a run folder back: for ``eval``, ``export``, ``view`` and the report."""

from __future__ import annotations

import os
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from ..camera.pinhole import Camera
from ..errors import InputError
from ..reading.files import is_closed, whole_bytes, whole_json, whole_text
from ..reading.pictures import decoded
from ..reading.yaml_text import MOST_YAML_BYTES
from ..types import State, StaticCloud, Trajectory
from .claim import PICTURE
from .point_cloud import read_cloud
from .run_folder import stamp
from .run_record import checked_camera, checked_metrics, read_record
from .tracks import Tracks, read_tracks
from .trajectory_files import read_tum

Array = NDArray[Any]
LATEST_S = 1e12  # a time beyond is none


@dataclass(frozen=True)
class Run:
    """What a run folder says. ``record`` is run.json; ``metrics`` is empty where there is no metrics.json."""

    path: Path
    trajectory: Trajectory
    record: dict[str, Any]
    metrics: dict[str, Any]
    config: str
    camera: Camera | None
    distortion: tuple[float, ...] = ()  # of the camera, OpenCV's order k1 k2 p1 p2 [k3 [k4 k5 k6]]
    lengths: float = 1.0  # what lengths of the folder's files are to be multiplied with, for ``trajectory``'s unit

    @property
    def metres_per_unit(self) -> float | None:
        """Metres a unit of the folder's files, as run.json says; None where nobody has measured it."""
        facts = self.record.get("scale") or {}
        return 1.0 if facts.get("applied") else facts.get("metres_per_unit")

    @property
    def unit(self) -> str:
        """Of ``trajectory``, and of what ``cloud`` and ``tracks`` give: m, or map units."""
        known = self.metres_per_unit
        return "m" if known is not None and known == self.lengths else "map units"

    def in_metres(self) -> Run:
        """The same in metres where run.json knows them, as it is where it does not; the folder is not changed."""
        factor = self.metres_per_unit
        if factor is None or factor == self.lengths:
            return self
        return replace(self, trajectory=self.trajectory.in_lengths(factor / self.lengths), lengths=factor)

    def cloud(self) -> StaticCloud:
        """cloud.ply. Raises InputError."""
        return read_cloud(self.path / "cloud.ply").in_lengths(self.lengths)

    def tracks(self) -> Tracks:
        """tracks.npz. Raises InputError."""
        return read_tracks(self.path / "tracks.npz").in_lengths(self.lengths)

    def mask_times_s(self) -> Array:
        """(n,) times of the frames that have a mask."""
        return _times(self.path / "masks")

    def render_times_s(self) -> Array:
        """(n,) times of the frames that have a render."""
        return _times(self.path / "renders")

    def mask(self, timestamp_s: float) -> Array:
        """P(moving) as (h, w) uint8, 255 = certain. Raises InputError."""
        return _read_image(self.path / "masks" / f"{stamp(timestamp_s)}.png", cv2.IMREAD_GRAYSCALE)

    def render(self, timestamp_s: float) -> Array:
        """The splat's image, (h, w, 3) uint8 RGB. Raises InputError."""
        image = _read_image(self.path / "renders" / f"{stamp(timestamp_s)}.png", cv2.IMREAD_COLOR)
        return np.ascontiguousarray(image[..., ::-1])


def read_run(path: Path | str) -> Run:
    """Load a run folder, complete or not. Raises InputError where run.json or trajectory.txt is missing."""
    folder = Path(path)
    if not os.path.lexists(folder / "run.json"):
        got = "one that may not be read" if is_closed(folder) else "no run.json in it"
        raise InputError(f"{folder}: expected a run folder, got {got}")
    record = read_record(folder)
    trajectory = _poses(folder / "trajectory.txt")
    if os.path.lexists(folder / "keyframes.txt"):
        times = {stamp(float(t)) for t in read_tum(folder / "keyframes.txt").timestamps_s}
        is_keyframe = np.array([stamp(float(t)) in times for t in trajectory.timestamps_s], bool)
        trajectory = replace(trajectory, is_keyframe=is_keyframe)
    if "states" in record:
        trajectory = replace(trajectory, states=_states(record["states"], trajectory, folder))
    camera_file, config_file = folder / "camera.json", folder / "config.yaml"
    camera, distortion = checked_camera(camera_file) if os.path.lexists(camera_file) else (None, ())
    return Run(
        path=folder,
        trajectory=trajectory,
        record=record,
        metrics=checked_metrics(folder / "metrics.json"),
        config=whole_text(config_file, "readable YAML", most=MOST_YAML_BYTES) if os.path.lexists(config_file) else "",
        camera=camera,
        distortion=distortion,
    )


def read_json(path: Path) -> dict[str, Any]:
    """A JSON object. Raises InputError."""
    return whole_json(path)


def _poses(path: Path) -> Trajectory:
    """The poses of a run, every one finite, each with a time of its own. Raises InputError."""
    trajectory = read_tum(path)
    times_s, poses = trajectory.timestamps_s, trajectory.world_from_cam
    wrong = ~(np.isfinite(poses).all((1, 2)) & (np.abs(times_s) < LATEST_S))
    wrong[1:] |= np.diff(times_s) <= 0
    if wrong.any():
        n = int(np.argmax(wrong))
        raise InputError(f"{path}: expected finite poses, each at a time of its own, got another at {times_s[n]} s")
    return trajectory


def _states(runs: Any, trajectory: Trajectory, folder: Path) -> tuple[State, ...]:
    poses, told = len(trajectory.timestamps_s), sum(count for _, count in runs)
    if told != poses:
        raise InputError(f"{folder}/run.json: expected states of {poses} poses, got {told}")
    return tuple(state for state, count in runs for _ in range(count))


def _times(folder: Path) -> Array:
    return np.array(sorted(float(p.stem) for p in folder.glob("*.png") if PICTURE.fullmatch(p.name)), float)


def _read_image(path: Path, mode: int) -> Array:
    return np.asarray(decoded(whole_bytes(path, "a readable image"), path, mode))
