"""A run in the file formats of other tools: TUM, KITTI and COLMAP's text model."""

from __future__ import annotations

import logging
from collections.abc import Iterable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, Literal, get_args

import numpy as np
from numpy.typing import NDArray

from ..camera.pinhole import Camera
from ..errors import ConfigError, InputError
from ..geometry.quaternion import quaternion_from_rotation
from ..geometry.se3 import inverse
from ..types import Trajectory
from .files import write_bytes, write_text, writing
from .point_cloud import read_cloud
from .read_run import Run, read_run
from .run_folder import stamp

Array = NDArray[Any]
log = logging.getLogger(__name__)
ExportKind = Literal["tum", "kitti", "colmap"]
MAX_POINTS = 100_000  # of points3D.txt; more are thinned evenly
SAME_FOCAL_RATIO = 1e-6  # fx and fy that differ by less are one focal length
COLMAP_CAMERA_ID = 1
NO_ERROR_KNOWN = -1  # COLMAP's own mark for a point whose reprojection error was never computed


def export_run(run_dir: Path, kind: str, out: Path) -> Path:
    """Write a run folder's result in another format; gives the path written.

    tum: ``out`` is a copy of trajectory.txt. kitti: a file of 12 numbers a row, the top of world_from_cam, one
    row a frame. colmap: a folder with cameras.txt, images.txt and points3D.txt, images whose pose is interpolated left
    out: nothing can be trained from them. How many there are goes to the log. Lengths are map units.
    Raises InputError for a run that lacks what the format needs, OutputError where ``out`` cannot be written,
    ConfigError for an unknown kind.
    """
    if kind not in get_args(ExportKind):
        raise ConfigError(f"export: expected one of {', '.join(get_args(ExportKind))}, got {kind!r}")
    run = read_run(run_dir)
    if len(run.trajectory.timestamps_s) == 0:
        raise InputError(f"{run_dir}/trajectory.txt: expected at least one pose, got none")
    tracked = run.trajectory.tracked()
    guessed = len(run.trajectory.timestamps_s) - len(tracked.timestamps_s)
    if guessed:
        what = "left out" if kind == "colmap" else "among the others: states.txt of the run says which"
        log.warning("%d of %d poses are interpolated, and %s", guessed, len(run.trajectory.timestamps_s), what)
    with writing(out):
        out.parent.mkdir(parents=True, exist_ok=True)
    if kind == "tum":
        write_bytes(out, _bytes_of(run_dir / "trajectory.txt"))
    elif kind == "kitti":
        write_text(out, kitti_text(_without_gaps(run)))
    else:
        _write_colmap(replace(run, trajectory=tracked), out)
    return out


def _bytes_of(path: Path) -> bytes:
    try:
        return path.read_bytes()
    except OSError as e:
        raise InputError(f"{path}: expected a readable trajectory file, got {e.strerror or e}") from e


def _without_gaps(run: Run) -> Trajectory:
    """KITTI's rows have no time: row n is frame n, so a frame without a pose cannot be left out."""
    frames, posed = run.metrics.get("frames"), len(run.trajectory.timestamps_s)
    if isinstance(frames, int) and frames != posed:
        raise InputError(
            f"{run.path}: expected a pose for every frame, as KITTI rows have no time, got {posed} poses of "
            f"{frames} frames; use --to tum"
        )
    return run.trajectory


def kitti_text(trajectory: Trajectory) -> str:
    """One row a pose: the upper 3 x 4 of world_from_cam, row by row."""
    rows = trajectory.world_from_cam[:, :3, :].reshape(-1, 12)
    return "".join(" ".join(f"{v:.9e}" for v in row) + "\n" for row in rows)


def _write_colmap(run: Run, out: Path) -> None:
    if run.camera is None:
        raise InputError(f"{run.path}: expected camera.json, which a COLMAP model needs, got none")
    cloud = read_cloud(run.path / "cloud.ply")
    with writing(out):
        out.mkdir(exist_ok=True)
    write_text(out / "cameras.txt", cameras_text(run.camera, run.distortion))
    write_text(out / "images.txt", images_text(run.trajectory))
    chosen = evenly(len(cloud.points_world), MAX_POINTS)
    write_text(out / "points3D.txt", points_text(cloud.points_world[chosen], cloud.colors[chosen]))


def cameras_text(camera: Camera, distortion: Sequence[float] = ()) -> str:
    """cameras.txt with the one full-size lens: the simplest model that holds it.

    ``distortion`` (k1 k2 p1 p2 [k3 [k4 k5 k6]]) goes before the camera's own terms; COLMAP's order is OpenCV's.
    COLMAP's first pixel spans 0 to 1, so that its centre is (0.5, 0.5); ours is (0, 0): half a pixel is added.
    """
    c = camera
    centre = [c.cx_px + 0.5, c.cy_px + 0.5]
    k1, k2, p1, p2, k3, *rational = (*(distortion or (c.k1, c.k2, 0.0, 0.0, c.k3)), *(0.0,) * 8)[:8]
    same = abs(c.fx_px - c.fy_px) <= SAME_FOCAL_RATIO * c.fx_px
    if k3 != 0.0 or any(rational):
        model, parameters = "FULL_OPENCV", [c.fx_px, c.fy_px, *centre, k1, k2, p1, p2, k3, *rational]
    elif not same or p1 != 0.0 or p2 != 0.0:
        model, parameters = "OPENCV", [c.fx_px, c.fy_px, *centre, k1, k2, p1, p2]
    elif k2 == 0.0:
        model, parameters = "SIMPLE_RADIAL", [c.fx_px, *centre, k1]
    else:
        model, parameters = "RADIAL", [c.fx_px, *centre, k1, k2]
    words = [str(COLMAP_CAMERA_ID), model, str(c.width), str(c.height), *_numbers(parameters)]
    return "# CAMERA_ID MODEL WIDTH HEIGHT PARAMS[]\n" + " ".join(words) + "\n"


def images_text(trajectory: Trajectory) -> str:
    """images.txt: cam_from_world as quaternion wxyz and translation; images are named by timestamp, as renders are.

    Every image has two lines; the second, its observations, is empty.
    """
    cam_from_world = np.stack([inverse(pose) for pose in trajectory.world_from_cam])
    wxyz = quaternion_from_rotation(cam_from_world[:, :3, :3])
    lines = ["# IMAGE_ID QW QX QY QZ TX TY TZ CAMERA_ID NAME\n# POINTS2D[] as (X, Y, POINT3D_ID)\n"]
    for n, (time_s, q, t) in enumerate(zip(trajectory.timestamps_s, wxyz, cam_from_world[:, :3, 3], strict=True), 1):
        words = [str(n), *_numbers((*q, *t)), str(COLMAP_CAMERA_ID), f"{stamp(float(time_s))}.png"]
        lines.append(" ".join(words) + "\n\n")
    return "".join(lines)


def points_text(points_world: Array, colors: Array) -> str:
    """points3D.txt: (n, 3) points and (n, 3) uint8 colours, no reprojection error, no tracks."""
    lines = ["# POINT3D_ID X Y Z R G B ERROR TRACK[]\n"]
    for n, (point, color) in enumerate(zip(points_world.tolist(), colors.tolist(), strict=True), 1):
        words = [str(n), *(f"{v:.9g}" for v in point), *map(str, color), str(NO_ERROR_KNOWN)]
        lines.append(" ".join(words) + "\n")
    return "".join(lines)


def evenly(count: int, most: int) -> Array:
    """Ascending indices of at most ``most`` of ``count`` rows, evenly spaced, each once."""
    if count <= most:
        return np.arange(count)
    return np.arange(most) * count // most


def _numbers(values: Iterable[float]) -> list[str]:
    return [f"{float(v) + 0.0:.12g}" for v in values]  # + 0.0: no "-0"
