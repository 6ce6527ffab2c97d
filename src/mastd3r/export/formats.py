"""A run's trajectory in the file formats of other tools: TUM, KITTI and EuRoC."""

from __future__ import annotations

import logging
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..errors import ConfigError, InputError
from ..geometry.quaternion import quaternion_from_rotation
from ..types import Trajectory
from .export_folder import export_folder
from .files import write_text, writing
from .kinds import TRAJECTORIES
from .read_run import Run
from .ros import check_package, write_ros
from .trajectory_files import write_tum

Array = NDArray[Any]
log = logging.getLogger(__name__)
BAG = "trajectory"  # folder of the bag
EUROC_HEADER = "#timestamp [ns],p_x,p_y,p_z [{unit}],q_w,q_x,q_y,q_z (world_from_cam)\n"


def export_trajectory(run: Run, kind: str, out: Path, *, all_poses: bool = False) -> Path:
    """Write a run's poses (world_from_cam, OpenCV axes, ``run.unit``) to ``out``, a file, for ros a folder; gives it.

    tum: timestamp, position, quaternion xyzw. euroc: nanoseconds, position, quaternion wxyz, with commas. ros: a bag,
    see ``write_ros``. These have the poses that were measured, and with ``all_poses`` the interpolated ones. kitti:
    12 numbers a row, the top of world_from_cam; its rows have no time, so every frame has one, and all poses are there.
    Raises InputError for a run that lacks what the format needs, OutputError where ``out`` cannot be written,
    ConfigError for an unknown kind, MissingPackage for ros without rosbags.
    """
    if kind not in TRAJECTORIES:
        raise ConfigError(f"export: expected one of {', '.join(TRAJECTORIES)}, got {kind!r}")
    trajectory = exported_poses(run, all_poses or kind == "kitti")
    if kind == "kitti":
        _refuse_gaps(run)
    if kind == "ros":
        check_package()
        with export_folder(out, {"kind": kind, "run": str(run.path.resolve()), "unit": run.unit}, []) as staged:
            write_ros(staged / BAG, trajectory)
        return out
    with writing(out):
        out.parent.mkdir(parents=True, exist_ok=True)
    if kind == "tum":
        write_tum(out, trajectory)
    else:
        write_text(out, kitti_text(trajectory) if kind == "kitti" else euroc_text(trajectory, run.unit))
    return out


def exported_poses(run: Run, all_poses: bool) -> Trajectory:
    """The poses that were measured, or all; how many were interpolated goes to the log. Raises InputError for none."""
    whole, tracked = run.trajectory, run.trajectory.tracked()
    guessed = len(whole.timestamps_s) - len(tracked.timestamps_s)
    if guessed:
        what = "among the others: states.txt of the run says which" if all_poses else "left out"
        log.warning("%d of %d poses are interpolated, and %s", guessed, len(whole.timestamps_s), what)
    chosen = whole if all_poses else tracked
    if len(chosen.timestamps_s) == 0:
        raise InputError(f"{run.path}/trajectory.txt: expected at least one pose, got none that was measured")
    return chosen


def _refuse_gaps(run: Run) -> None:
    """KITTI's rows have no time: row n is frame n, so a frame without a pose cannot be left out."""
    frames, posed = run.metrics.get("frames"), len(run.trajectory.timestamps_s)
    if isinstance(frames, int) and frames != posed:
        raise InputError(
            f"{run.path}: expected a pose for every frame, as KITTI rows have no time, got {posed} poses of "
            f"{frames} frames; use --to tum"
        )


def kitti_text(trajectory: Trajectory) -> str:
    """One row a pose: the upper 3 x 4 of world_from_cam, row by row."""
    rows = trajectory.world_from_cam[:, :3, :].reshape(-1, 12)
    return "".join(" ".join(f"{v:.9e}" for v in row) + "\n" for row in rows)


def euroc_text(trajectory: Trajectory, unit: str) -> str:
    """One row a pose: nanoseconds, position, quaternion wxyz."""
    poses = trajectory.world_from_cam
    lines = [EUROC_HEADER.format(unit=unit)]
    for time_s, p, q in zip(
        trajectory.timestamps_s, poses[:, :3, 3], quaternion_from_rotation(poses[:, :3, :3]), strict=True
    ):
        lines.append(f"{round(time_s * 1e6) * 1000}," + ",".join(f"{v:.9f}" for v in (*p, *q)) + "\n")
    return "".join(lines)


def evenly(count: int, most: int) -> Array:
    """Ascending indices of at most ``most`` of ``count`` rows, evenly spaced, each once."""
    if count <= most:
        return np.arange(count)
    return np.arange(most) * count // most
