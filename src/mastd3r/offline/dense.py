"""Dense cloud of a run folder: its keyframes are read from the source again, with the poses, lens and masks written."""

from __future__ import annotations

import logging
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..camera.map_view import MapView
from ..errors import ConfigError, InputError
from ..export.dense_files import write_dense_cloud
from ..export.files import writing
from ..export.mesh_files import write_mesh
from ..export.read_run import Run
from ..export.run_folder import stamp
from ..mvs.depth_maps import DepthMaps, dense_depth
from ..mvs.fuse import fused
from ..mvs.mesh import meshed
from ..mvs.views import StereoView
from ..progress import Reporter
from ..types import Source, Trajectory
from .photographs import check_size
from .renders import lens_of

Array = NDArray[Any]
log = logging.getLogger(__name__)
WIDTH_PX = 640  # of the images that depth is found in, never enlarged
MOVING = 0.5  # P(moving) above which a pixel is left out
CLOUD_FILE = "cloud_dense.ply"


@dataclass(frozen=True)
class Dense:
    """Keyframes with depth, and what it took."""

    views: list[StereoView]
    maps: DepthMaps
    facts: dict[str, Any]


def stereo_views(run: Run, source: Source) -> list[StereoView]:
    """The tracked keyframes of a run as pinhole images. Raises InputError for another source and a run without lens.

    What the mask says moves, and what the pinhole image has no data for, is not static.
    """
    lens = lens_of(run)
    check_size(run, source, lens)
    map_view = MapView(lens, WIDTH_PX, 1.0)
    chosen = with_frames_between(run.trajectory.tracked())
    place = {stamp(float(t)): pose for t, pose in zip(chosen.timestamps_s, chosen.world_from_cam, strict=True)}
    views: list[StereoView] = []
    for frame in source.frames():
        pose = place.pop(stamp(frame.timestamp_s), None)
        if pose is None:
            continue
        image, inside = map_view.pinhole_image(frame.as_taken.image)
        moving = map_view.pinhole_map(run.mask(frame.timestamp_s).astype(np.float32) / 255)
        static = (inside > 0) & (moving <= MOVING)
        views.append(StereoView(frame.timestamp_s, image, static, pose, map_view.pinhole))
    if place:
        raise InputError(
            f"{source.name}: expected the {len(views) + len(place)} keyframes of the run in {run.path}, got none at "
            f"{min(place)} s"
        )
    return views


def with_frames_between(tracked: Trajectory) -> Trajectory:
    """The keyframes, and the frame halfway between each two: what a keyframe sees at its edges is seen again there."""
    keyframes = np.flatnonzero(tracked.is_keyframe)
    return tracked.rows(np.union1d(keyframes, (keyframes[1:] + keyframes[:-1]) // 2))


def densified(run: Run, source: Source, reporter: Reporter) -> Dense:
    """Depth maps of the keyframes. Raises InputError as ``stereo_views``, and for a run without a cloud."""
    began = time.perf_counter()
    points = run.cloud().points_world
    views = stereo_views(run, source)
    if len(views) < 2:
        raise InputError(f"{run.path}: expected at least 2 keyframes with a pose to compare, got {len(views)}")
    with reporter.stage("depth", len(views), "keyframes") as bar:
        maps = dense_depth(views, points, bar.advance)
    static = np.stack([view.static for view in views])
    facts = {
        "keyframes": len(views),
        "width_px": maps.camera.width,
        "seconds": time.perf_counter() - began,
        "covered_ratio": float((maps.trusted & static).sum() / max(1, static.sum())),
    }
    return Dense(views, maps, facts)


def write_dense_cloud_of(run: Run, source: Source, reporter: Reporter) -> dict[str, Any]:
    """cloud_dense.ply of a run folder; gives what run.json says of it. Raises as ``densified`` and OutputError."""
    dense = densified(run, source, reporter)
    return {**dense.facts, "points": write_dense(dense, run.path / CLOUD_FILE)}


def write_dense(dense: Dense, out: Path) -> int:
    """The fused cloud as a PLY; gives the number of points. Raises OutputError."""
    cloud = fused(dense.views, dense.maps)
    write_dense_cloud(out, cloud.points_world, cloud.normals, cloud.colors, cloud.confidence)
    log.info(
        "dense cloud: %d points, on %.0f%% of the static pixels of %d keyframes",
        len(cloud.points_world), 100 * dense.facts["covered_ratio"], len(dense.views),
    )  # fmt: skip
    return len(cloud.points_world)


def export_dense(run: Run, source: Source, kind: str, out: Path, reporter: Reporter) -> Path:
    """``mastd3r export --to cloud|mesh``; gives the path written.

    Raises ConfigError for a name with another ending than .ply, or .glb of a mesh, InputError as ``densified``,
    OutputError where ``out`` cannot be written.
    """
    endings = (".ply",) if kind == "cloud" else (".ply", ".glb")
    if out.suffix.lower() not in endings:
        raise ConfigError(f"export --to {kind}: expected a file name that ends in {' or '.join(endings)}, got {out}")
    with writing(out):
        out.parent.mkdir(parents=True, exist_ok=True)
    dense = densified(run, source, reporter)
    if kind == "cloud":
        write_dense(dense, out)
        return out
    mesh = meshed(dense.views, dense.maps)
    if not len(mesh.faces):
        raise InputError(f"{run.path}: expected surfaces that several keyframes see alike, got none to make a mesh of")
    log.info("mesh: %d triangles, voxels of %.3g %s", len(mesh.faces), mesh.voxel, run.unit)
    write_mesh(out, mesh.vertices_world, mesh.faces, mesh.colors)
    return out
