"""Exports that need the photographs: COLMAP, nerfstudio and clean plates. What they write is whole or not there."""

from __future__ import annotations

import logging
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..errors import InputError
from ..export.colmap import NO_ERROR_KNOWN, ColmapModel, write_colmap
from ..export.export_folder import export_folder
from ..export.files import write_json
from ..export.formats import evenly, exported_poses
from ..export.lens_models import colmap_model
from ..export.nerfstudio import transforms
from ..export.point_cloud import write_cloud
from ..export.read_run import Run
from ..export.run_folder import stamp
from ..export.tracks import Tracks
from ..geometry.se3 import inverse
from ..reading.files import is_file
from ..types import Source, Trajectory
from .exported_view import KEEP, ExportedView
from .photographs import photographs, write_photograph
from .plates import Plates
from .renders import lens_of

Array = NDArray[Any]
log = logging.getLogger(__name__)
CLOUD = "cloud.ply"
MAX_POINTS = 100_000  # of a model; more are thinned evenly


@dataclass(frozen=True)
class Written:
    """The images of an export."""

    names: list[str]
    trajectory: Trajectory  # of them, in the same order


def export_pictures(
    run: Run,
    kind: str,
    out: Path,
    source: Source,
    source_path: Path,
    *,
    undistort: bool | None = None,
    all_poses: bool = False,
) -> Path:
    """Write ``kind``, colmap or nerfstudio, to the folder ``out``; gives it.

    undistort: whether images become those of a pinhole; None: where the lens is bent. all_poses: interpolated ones too.
    Raises InputError for a run that lacks what the format needs, or a source that is not the run's, and OutputError;
    nothing half-written stays.
    """
    trajectory = exported_poses(run, all_poses)
    view = ExportedView(lens_of(run), undistort)
    write = {"colmap": _write_colmap, "nerfstudio": _write_nerfstudio}[kind]
    facts = {"kind": kind, "run": str(run.path.resolve()), "unit": run.unit, "undistorted": view.undistorts}
    with export_folder(out, facts, [source_path]) as staged:
        write(staged, run, _write_images(staged, run, trajectory, source, view), view)
    if view.undistorts and undistort is None:
        size = f"{view.lens.width}x{view.lens.height}"
        log.warning("the lens is bent: images are undistorted to a pinhole of %s; or %s", size, KEEP)
    return out


def export_plates(run: Run, out: Path, source: Source, source_path: Path, *, all_poses: bool = False) -> Path:
    """Write every photograph to ``out``/images/<timestamp>.png, what moves replaced by the splat; gives ``out``.

    Raises as ``export_pictures``, and InputError for a run without a map.
    """
    trajectory, plates = exported_poses(run, all_poses), Plates(run)
    with export_folder(out, {"kind": "plates", "run": str(run.path.resolve())}, [source_path]) as staged:
        for p in photographs(run, trajectory, source, lens_of(run)):
            plate = plates.plate(p.image, run.mask(p.timestamp_s), p.world_from_cam)
            write_photograph(staged / "images" / f"{stamp(p.timestamp_s)}.png", plate)
    return out


def _write_images(staged: Path, run: Run, trajectory: Trajectory, source: Source, view: ExportedView) -> Written:
    """images/ and masks/, in which the mask of images/a/b.jpg is masks/a/b.jpg.png."""
    names: list[str] = []
    for photograph in photographs(run, trajectory, source, lens_of(run)):
        name = photograph.name
        file = None if view.undistorts else photograph.file
        write_photograph(staged / "images" / name, view.image(photograph.image), file)
        write_photograph(staged / "masks" / f"{name}.png", view.mask(run.mask(photograph.timestamp_s)))
        names.append(name)
    if len(set(names)) != len(names):
        raise InputError(f"{run.path}: expected images with names of their own, got some twice")
    return Written(names, trajectory)


def _write_colmap(staged: Path, run: Run, written: Written, view: ExportedView) -> None:
    if any(len(name.split()) > 1 for name in written.names):
        log.warning("some images have spaces in their names: COLMAP reads those from the binary model only")
    (staged / "sparse" / "0").mkdir(parents=True)
    write_colmap(staged / "sparse" / "0", colmap_of(run, written, view))


def _write_nerfstudio(staged: Path, run: Run, written: Written, view: ExportedView) -> None:
    poses = written.trajectory.world_from_cam
    write_json(staged / "transforms.json", transforms(view.lens, written.names, poses, CLOUD))
    write_cloud(staged / CLOUD, run.cloud())


def colmap_of(run: Run, written: Written, view: ExportedView) -> ColmapModel:
    """The model of exported images. A run without tracks gives the points of its cloud, which nothing observes."""
    cam_from_world = np.stack([inverse(pose) for pose in written.trajectory.world_from_cam])
    camera_model, parameters = colmap_model(view.lens)
    common = (camera_model, parameters, (view.lens.width, view.lens.height), written.names, cam_from_world)
    if not is_file(run.path / "tracks.npz"):
        log.warning(
            "%s has no tracks.npz (an older run): points are those of the cloud, without observations", run.path
        )
        cloud = run.cloud()
        chosen = evenly(len(cloud.points_world), MAX_POINTS)
        nothing = np.zeros(0, int)
        errors = np.full(len(chosen), NO_ERROR_KNOWN)
        points = cloud.points_world[chosen], cloud.colors[chosen]
        return ColmapModel(*common, *points, errors, nothing, nothing, np.zeros((0, 2)))
    tracks, image, px = _observed(run.tracks(), written.trajectory, view)
    points_world = tracks.points_world.astype(float)
    error = _errors_px(points_world[tracks.point], cam_from_world, image, px, view)
    count = np.bincount(tracks.point, minlength=len(points_world))
    mean = np.bincount(tracks.point, error, minlength=len(points_world)) / np.maximum(count, 1)
    return ColmapModel(*common, points_world, tracks.colors, mean, tracks.point, image, px + 0.5)


def _observed(tracks: Tracks, trajectory: Trajectory, view: ExportedView) -> tuple[Tracks, Array, Array]:
    """The tracks that the exported images see, the rows of those images (m,), and the pixels in them (m, 2)."""
    row = np.searchsorted(trajectory.timestamps_s, tracks.timestamps_s - 1e-6)
    row = np.minimum(row, len(trajectory.timestamps_s) - 1)
    there = np.abs(trajectory.timestamps_s[row] - tracks.timestamps_s) < 1e-6
    px = view.px(tracks.px)
    inside = ((px > -0.5) & (px < np.array([view.lens.width, view.lens.height]) - 0.5)).all(1)
    seen = tracks.seen(inside & there[tracks.frame])
    return seen, row[seen.frame], view.px(seen.px)


def _errors_px(points_world: Array, cam_from_world: Array, image: Array, px: Array, view: ExportedView) -> Array:
    """(m,) distance of each observation from where its point (m, 3) is seen."""
    pose = cam_from_world[image]
    points_cam = np.einsum("mij,mj->mi", pose[:, :3, :3], points_world) + pose[:, :3, 3]
    return np.asarray(np.linalg.norm(view.lens.project(points_cam) - px, axis=1))
