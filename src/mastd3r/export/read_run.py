"""Reading a run folder back: for ``eval``, ``export``, ``view`` and the report."""

from __future__ import annotations

import json
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, get_args

import cv2
import numpy as np
from numpy.typing import NDArray

from ..camera.pinhole import Camera
from ..errors import InputError
from ..types import State, Trajectory
from .claim import PICTURE
from .run_folder import stamp
from .trajectory_files import read_tum

Array = NDArray[Any]
NOT_OF_THE_LENS = ("found", "focal_sigma_ratio")  # of camera.json


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
    if not (folder / "run.json").is_file():
        raise InputError(f"{folder}: expected a run folder, got no run.json in it")
    record = read_json(folder / "run.json")
    trajectory = read_tum(folder / "trajectory.txt")
    if (folder / "keyframes.txt").is_file():
        times = {stamp(float(t)) for t in read_tum(folder / "keyframes.txt").timestamps_s}
        is_keyframe = np.array([stamp(float(t)) in times for t in trajectory.timestamps_s], bool)
        trajectory = replace(trajectory, is_keyframe=is_keyframe)
    if "states" in record:
        trajectory = replace(trajectory, states=_states(record["states"], trajectory, folder))
    camera_file, config_file = folder / "camera.json", folder / "config.yaml"
    camera, distortion = _camera(camera_file) if camera_file.is_file() else (None, ())
    return Run(
        path=folder,
        trajectory=trajectory,
        record=record,
        metrics=read_json(folder / "metrics.json") if (folder / "metrics.json").is_file() else {},
        config=config_file.read_text() if config_file.is_file() else "",
        camera=camera,
        distortion=distortion,
    )


def read_json(path: Path) -> dict[str, Any]:
    """A JSON object. Raises InputError."""
    try:
        data = json.loads(path.read_text())
    except (OSError, ValueError) as e:
        raise InputError(f"{path}: expected readable JSON, got {e}") from e
    if not isinstance(data, dict):
        raise InputError(f"{path}: expected a JSON object, got {type(data).__name__}")
    return data


def _states(runs: Any, trajectory: Trajectory, folder: Path) -> tuple[State, ...]:
    try:
        states: tuple[State, ...] = tuple(state for state, count in runs for _ in range(count))
    except (TypeError, ValueError) as e:
        raise InputError(f"{folder}/run.json: expected states as [state, count] pairs, got {str(runs)[:60]}") from e
    if not set(states) <= set(get_args(State)):
        raise InputError(f"{folder}/run.json: expected states {', '.join(get_args(State))}, got {set(states)}")
    if len(states) != len(trajectory.timestamps_s):
        raise InputError(
            f"{folder}/run.json: expected states of {len(trajectory.timestamps_s)} poses, got {len(states)}"
        )
    return states


def _camera(path: Path) -> tuple[Camera, tuple[float, ...]]:
    """The camera and its whole distortion; empty where camera.json has no such list."""
    data = read_json(path)
    try:
        distortion = tuple(float(v) for v in data.pop("distortion", []))
        return Camera(**{k: v for k, v in data.items() if k not in NOT_OF_THE_LENS}), distortion
    except (TypeError, ValueError) as e:
        raise InputError(f"{path}: expected the fields of a camera, got {e}") from e


def _times(folder: Path) -> Array:
    return np.array(sorted(float(p.stem) for p in folder.glob("*.png") if PICTURE.fullmatch(p.name)), float)


def _read_image(path: Path, mode: int) -> Array:
    try:
        data = np.frombuffer(path.read_bytes(), np.uint8)
    except OSError as e:
        raise InputError(f"{path}: expected a readable image, got {e.strerror or e}") from e
    image = cv2.imdecode(data, mode) if data.size else None
    if image is None:
        raise InputError(f"{path}: expected an image, got {data.size} bytes that are not one")
    return np.asarray(image)
