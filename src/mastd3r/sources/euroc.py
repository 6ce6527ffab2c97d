"""EuRoC MAV, left camera alone: a folder that holds mav0 (or mav0 itself), in the ASL layout.

Burri et al., "The EuRoC micro aerial vehicle datasets", IJRR 2016. cam0/data.csv: nanoseconds and file names;
cam0/sensor.yaml: T_BS from camera to body, row by row, and intrinsics fu fv cu cv with radial-tangential distortion,
which is OpenCV's k1 k2 p1 p2; state_groundtruth_estimate0/data.csv: nanoseconds, position of the body, quaternion wxyz.
world_from_cam = world_from_body T_BS, at the 200 Hz of the ground truth; each frame's is the nearest within 20 ms.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from ..errors import InputError
from ..reading.files import is_dir, is_file, short, whole_text
from ..reading.yaml_text import MOST_YAML_BYTES, yaml_value
from .sequence import Listed, Sequenced, check_times, read_lines, read_numbers, rigid, truth_or_note

Array = NDArray[Any]
KIND = "euroc"
EXPECTED = "EuRoC (mav0/cam0/data.csv, mav0/cam0/data/*.png)"
LENS_KEYS = {"camera_model": "pinhole", "distortion_model": "radial-tangential"}
TRUTH = "state_groundtruth_estimate0"


def looks_like(folder: Path) -> str | None:
    """What makes a folder a sequence of EuRoC, or None."""
    inner = _inner(folder)
    return f"{inner.name}/cam0/data.csv is there" if is_file(inner / "cam0" / "data.csv") else None


def find(folder: Path) -> Sequenced:
    """Frames of cam0, their times, poses and lens. Raises InputError."""
    inner = _inner(folder)
    cam = inner / "cam0"
    frames = _frames(cam)
    sensor = _sensor(cam / "sensor.yaml")
    body_from_cam = rigid(_values(sensor, "T_BS", 16, cam / "sensor.yaml").reshape(4, 4), f"{cam / 'sensor.yaml'} T_BS")
    resolution = _values(sensor, "resolution", 2, cam / "sensor.yaml")
    notes: list[str] = []
    times, poses = truth_or_note(lambda: _truth(inner / TRUTH / "data.csv", body_from_cam, notes), notes)
    here = folder.resolve()
    return Sequenced(
        KIND,
        here.parent.name if here.name == "mav0" else here.name,
        frames,
        "cam0, grey; lens of cam0/sensor.yaml",
        times,
        poses,
        _lens(sensor, cam / "sensor.yaml"),
        (int(resolution[0]), int(resolution[1])),
        notes=notes,
    )


def _truth(file: Path, body_from_cam: Array, notes: list[str]) -> tuple[Array, Array]:
    if not is_file(file):
        notes.append(f"no {TRUTH}/data.csv: no poses")
        return np.empty(0), np.empty((0, 4, 4))
    times, world_from_body = _body_poses(file)
    notes.append(f"{len(times)} poses of {TRUTH}, moved from the body to cam0 by T_BS")
    return times, world_from_body @ body_from_cam


def _inner(folder: Path) -> Path:
    return folder / "mav0" if is_dir(folder / "mav0") else folder


def _frames(cam: Path) -> list[Listed]:
    frames = []
    for number, line in read_lines(cam / "data.csv"):
        stamp, _, name = (part.strip() for part in line.partition(","))
        if not stamp.isdecimal() or not name:
            raise InputError(f"{cam / 'data.csv'} line {number}: expected 'nanoseconds,filename', got {line[:60]!r}")
        frames.append(Listed(int(stamp) / 1e9, cam / "data" / name))
    if not frames:
        raise InputError(f"{cam / 'data.csv'}: expected lines of 'nanoseconds,filename', got none")
    return frames


def _body_poses(path: Path) -> tuple[Array, Array]:
    """Times (n,) and world_from_body (n, 4, 4)."""
    rows = read_numbers(path, 8, "nanoseconds, position, quaternion wxyz, ...", ",", at_least=True)
    stamps = [int(line.partition(",")[0]) for _, line in read_lines(path)]  # exact, as the images' are
    times = np.array(stamps) / 1e9
    check_times(list(times), str(path))
    if not np.allclose(np.linalg.norm(rows[:, 4:8], axis=1), 1, atol=1e-2):
        raise InputError(f"{path}: expected unit quaternions in columns 5 to 8, got others")
    poses = np.tile(np.eye(4), (len(rows), 1, 1))
    poses[:, :3, 3] = rows[:, 1:4]
    poses[:, :3, :3] = Rotation.from_quat(rows[:, [5, 6, 7, 4]]).as_matrix()
    return times, poses


def _sensor(path: Path) -> dict[str, Any]:
    text = whole_text(path, "the camera's calibration", most=MOST_YAML_BYTES)
    data = yaml_value(text, str(path), InputError)
    if not isinstance(data, dict):
        raise InputError(f"{path}: expected key: value pairs, got {type(data).__name__}")
    return data


def _values(sensor: dict[str, Any], key: str, count: int, path: Path) -> Array:
    value = sensor.get(key)
    numbers = value.get("data") if isinstance(value, dict) else value
    try:
        array = np.array(numbers, float).ravel()
    except (TypeError, ValueError, OverflowError):
        array = np.empty(0)
    if len(array) != count or not np.isfinite(array).all():
        raise InputError(f"{path}: expected {key} of {count} numbers, got {short(repr(numbers))}")
    return array


def _lens(sensor: dict[str, Any], path: Path) -> tuple[float, ...]:
    for key, expected in LENS_KEYS.items():
        if sensor.get(key) != expected:
            raise InputError(f"{path}: expected {key} {expected}, got {short(repr(sensor.get(key)))}")
    intrinsics = _values(sensor, "intrinsics", 4, path)
    return (*map(float, intrinsics), *map(float, _values(sensor, "distortion_coefficients", 4, path)))
