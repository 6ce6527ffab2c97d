"""TUM trajectory files: ``timestamp tx ty tz qx qy qz qw``. The only place that knows xyzw quaternions."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..errors import InputError
from ..types import State, Trajectory
from .files import write_text

Array = NDArray[Any]
HEADER = "# timestamp_s tx ty tz qx qy qz qw (world_from_cam)\n"


def write_tum(path: Path, trajectory: Trajectory) -> None:
    """Write every finite pose; a pose that is not finite has no row. Raises OutputError."""
    finite = np.isfinite(trajectory.world_from_cam).all((1, 2))
    poses = trajectory.world_from_cam[finite]
    wxyz = quaternion_from_rotation(poses[:, :3, :3])
    lines = [
        f"{t:.6f} {p[0]:.9f} {p[1]:.9f} {p[2]:.9f} {q[1]:.9f} {q[2]:.9f} {q[3]:.9f} {q[0]:.9f}\n"
        for t, p, q in zip(trajectory.timestamps_s[finite], poses[:, :3, 3], wxyz, strict=True)
    ]
    write_text(path, HEADER + "".join(lines))


def read_tum(path: Path, state: State = "tracked") -> Trajectory:
    """Read a TUM file, in order of time; every row takes ``state`` and is no keyframe.

    Raises InputError for a missing file, a row that is not eight numbers, or a quaternion of length 0.
    """
    try:
        lines = path.read_text().splitlines()
    except (OSError, UnicodeDecodeError) as e:
        raise InputError(f"{path}: expected a readable trajectory file, got {e}") from e
    rows: list[list[float]] = []
    for number, line in enumerate(lines, 1):
        if not line.strip() or line.startswith("#"):
            continue
        try:
            row = [float(word) for word in line.split()]
        except ValueError as e:
            raise InputError(f"{path} line {number}: expected numbers, got {line[:60]!r}") from e
        if len(row) != 8 or not any(row[4:]):
            raise InputError(f"{path} line {number}: expected t tx ty tz qx qy qz qw, got {line[:60]!r}")
        rows.append(row)
    data = np.array(rows, float).reshape(-1, 8)
    data = data[np.argsort(data[:, 0], kind="stable")]
    poses = np.tile(np.eye(4), (len(data), 1, 1))
    poses[:, :3, 3] = data[:, 1:4]
    poses[:, :3, :3] = rotation_from_quaternion(data[:, [7, 4, 5, 6]])
    return Trajectory(data[:, 0], poses, (state,) * len(data), np.zeros(len(data), bool))


def quaternion_from_rotation(rotation: Array) -> Array:
    """(n, 3, 3) rotations to (n, 4) unit quaternions wxyz with w >= 0, at every angle.

    Of the four columns of 4 q q^T (Shepperd 1978) the one with the largest diagonal is divided by its root,
    so nothing is ever divided by less than 1/2.
    """
    r = np.asarray(rotation, float)
    m = [[r[:, i, j] for j in range(3)] for i in range(3)]
    product = np.empty((len(r), 4, 4))
    product[:, 0, 0] = 1 + m[0][0] + m[1][1] + m[2][2]
    product[:, 1, 1] = 1 + m[0][0] - m[1][1] - m[2][2]
    product[:, 2, 2] = 1 - m[0][0] + m[1][1] - m[2][2]
    product[:, 3, 3] = 1 - m[0][0] - m[1][1] + m[2][2]
    product[:, 0, 1] = product[:, 1, 0] = m[2][1] - m[1][2]
    product[:, 0, 2] = product[:, 2, 0] = m[0][2] - m[2][0]
    product[:, 0, 3] = product[:, 3, 0] = m[1][0] - m[0][1]
    product[:, 1, 2] = product[:, 2, 1] = m[0][1] + m[1][0]
    product[:, 1, 3] = product[:, 3, 1] = m[0][2] + m[2][0]
    product[:, 2, 3] = product[:, 3, 2] = m[1][2] + m[2][1]
    largest = np.einsum("nii->ni", product).argmax(1)
    q = product[np.arange(len(r)), largest]
    q = q / np.linalg.norm(q, axis=1, keepdims=True)
    return np.asarray(np.where(q[:, :1] < 0, -q, q))


def rotation_from_quaternion(wxyz: Array) -> Array:
    """(n, 4) quaternions wxyz, of any length but 0, to (n, 3, 3) rotations."""
    w, x, y, z = (wxyz / np.linalg.norm(wxyz, axis=1, keepdims=True)).T
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    return np.stack([np.stack(row, -1) for row in rows], -2)
