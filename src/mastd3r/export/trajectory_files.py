"""Trajectory files: TUM's ``timestamp tx ty tz qx qy qz qw``, which we write, and those that other systems write."""

from __future__ import annotations

from pathlib import Path
from typing import Any, Literal, get_args

import numpy as np
from numpy.typing import NDArray

from ..errors import ConfigError, InputError
from ..geometry.quaternion import quaternion_from_rotation, rotation_from_quaternion
from ..reading.files import whole_text
from ..types import State, Trajectory
from .files import write_text

Array = NDArray[Any]
TrajectoryKind = Literal["tum", "kitti", "euroc"]
FARTHEST = 1e9  # map units or metres; a number beyond is no position
NOT_A_ROTATION = 0.01  # largest entry of R^T R - 1 that rounding in a file may leave
SHORTEST = 1e-6  # quaternion
HEADER = "# timestamp_s tx ty tz qx qy qz qw (world_from_cam)\n"


def write_tum(path: Path, trajectory: Trajectory) -> None:
    """Write every finite pose; a pose that is not finite has no row. Raises OutputError."""
    finite = np.isfinite(trajectory.world_from_cam).all((1, 2))
    write_text(path, HEADER + tum_rows(trajectory.timestamps_s[finite], trajectory.world_from_cam[finite]))


def tum_rows(times_s: Array, world_from_cam: Array) -> str:
    """A line each of times (n,) and poses (n, 4, 4)."""
    wxyz = quaternion_from_rotation(world_from_cam[:, :3, :3])
    return "".join(
        f"{t:.6f} {p[0]:.9f} {p[1]:.9f} {p[2]:.9f} {q[1]:.9f} {q[2]:.9f} {q[3]:.9f} {q[0]:.9f}\n"
        for t, p, q in zip(times_s, world_from_cam[:, :3, 3], wxyz, strict=True)
    )


def read_tum(path: Path, state: State = "tracked") -> Trajectory:
    """Read a TUM file, in order of time; every row takes ``state`` and is no keyframe.

    Raises InputError for a missing file, a row that is not eight numbers, or a quaternion of length 0.
    """
    rows: list[list[float]] = []
    for number, line in _lines(path):
        row = _floats(path, number, line, line.replace(",", " ").split())
        if len(row) != 8 or not any(row[4:]):
            raise InputError(f"{path} line {number}: expected t tx ty tz qx qy qz qw, got {line[:60]!r}")
        rows.append(row)
    data = np.array(rows, float).reshape(-1, 8)
    return _in_order(data[:, 0], data[:, 1:4], _rotations(data[:, [7, 4, 5, 6]]), state)


def read_trajectory(path: Path, kind: str, times_s: Array) -> Trajectory:
    """Another system's trajectory: poses of the camera in the world (world_from_cam), OpenCV axes.

    tum: eight numbers a row. kitti: twelve, the top of world_from_cam; row n belongs to frame n, whose time is
    ``times_s[n]`` (n,). euroc: commas, time in nanoseconds, position, quaternion wxyz; further columns are not read.
    Raises ConfigError for another kind, InputError for a file that is missing or not of its kind.
    """
    if kind not in get_args(TrajectoryKind):
        raise ConfigError(f"trajectory format: expected one of {', '.join(get_args(TrajectoryKind))}, got {kind!r}")
    read = {"tum": read_tum, "kitti": lambda p: _read_kitti(p, times_s), "euroc": _read_euroc}[kind]
    found = read(path)
    if not len(found.timestamps_s):
        raise InputError(f"{path}: expected poses, got none")
    return found


def read_states(path: Path) -> list[tuple[float, State]]:
    """(timestamp_s, state) of every frame, as a run folder's states.txt has them. Raises InputError."""
    rows: list[tuple[float, State]] = []
    for number, line in _lines(path):
        words = line.split()
        if len(words) != 2 or words[1] not in get_args(State):
            raise InputError(f"{path} line {number}: expected a time and a state, got {line[:60]!r}")
        rows.append((_floats(path, number, line, words[:1])[0], words[1]))  # type: ignore[arg-type]
    return rows


def _read_kitti(path: Path, times_s: Array) -> Trajectory:
    rows: list[list[float]] = []
    for number, line in _lines(path):
        row = _floats(path, number, line, line.split())
        if len(row) != 12:
            raise InputError(f"{path} line {number}: expected the 12 numbers of a KITTI pose, got {len(row)}")
        turn = np.array(row).reshape(3, 4)[:, :3]
        sound = bool((np.abs(turn) < 2).all())  # NaN is not
        if not sound or np.abs(turn.T @ turn - np.eye(3)).max() >= NOT_A_ROTATION:
            raise InputError(f"{path} line {number}: expected a rotation and a position, got {line[:60]!r}")
        rows.append(row)
    if len(rows) != len(times_s):
        raise InputError(
            f"{path}: expected a row for each of the {len(times_s)} frames, as KITTI rows have no time, got {len(rows)}"
        )
    data = np.array(rows, float).reshape(-1, 3, 4)
    return _in_order(np.asarray(times_s, float), data[:, :, 3], data[:, :, :3], "tracked")


def _read_euroc(path: Path) -> Trajectory:
    rows: list[list[float]] = []
    for number, line in _lines(path):
        row = _floats(path, number, line, line.rstrip(", \t").split(","))
        if len(row) < 8 or not any(row[4:8]):
            raise InputError(f"{path} line {number}: expected t_ns,x,y,z,qw,qx,qy,qz, got {line[:60]!r}")
        rows.append(row[:8])
    data = np.array(rows, float).reshape(-1, 8)
    return _in_order(data[:, 0] * 1e-9, data[:, 1:4], _rotations(data[:, 4:]), "tracked")


def _rotations(wxyz: Array) -> Array:
    """(n, 4) to (n, 3, 3); NaN where a quaternion has no length that a file could mean."""
    length = np.abs(wxyz).max(1, initial=0.0)
    sound = (length > SHORTEST) & (length < 1 / SHORTEST)
    out = np.full((len(wxyz), 3, 3), np.nan)
    out[sound] = rotation_from_quaternion(wxyz[sound])
    return out


def _lines(path: Path) -> list[tuple[int, str]]:
    """(number from 1, text) of every line that is neither empty nor a comment."""
    lines = whole_text(path, "a readable trajectory file").splitlines()
    return [(n, line) for n, line in enumerate(lines, 1) if line.strip() and not line.startswith("#")]


def _floats(path: Path, number: int, line: str, words: list[str]) -> list[float]:
    try:
        return [float(word) for word in words]
    except (ValueError, OverflowError) as e:
        raise InputError(f"{path} line {number}: expected numbers, got {line[:60]!r}") from e


def _in_order(times_s: Array, positions: Array, rotations: Array, state: State) -> Trajectory:
    """Poses (n, 4, 4) of their parts, in order of time; no keyframe among them. What is no pose becomes NaN."""
    order = np.argsort(times_s, kind="stable")
    poses = np.tile(np.eye(4), (len(order), 1, 1))
    poses[:, :3, 3], poses[:, :3, :3] = positions[order], rotations[order]
    poses[~(np.abs(poses) < FARTHEST).all((1, 2))] = np.nan
    return Trajectory(times_s[order], poses, (state,) * len(order), np.zeros(len(order), bool))
