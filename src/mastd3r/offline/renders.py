"""What is shown of a finished map beside its renders: depth images and the flight; from a run, or from its folder."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..camera.map_view import MapView
from ..camera.opencv_lens import OpenCvLens
from ..camera.pinhole import Camera
from ..config import config_from_text
from ..errors import InputError
from ..export.export_folder import export_folder
from ..export.files import replacing, writing
from ..export.formats import exported_poses
from ..export.read_run import Run
from ..export.run_folder import write_depth_png
from ..export.video import write_video
from ..geometry.path import smoothed_path
from ..mapping.gaussian_arrays import GaussianArrays
from ..mapping.ply import read_gaussians_ply

Array = NDArray[Any]
Draw = Callable[[Array, Camera], tuple[Array, Array, Array]]
FLIGHT_FPS = 30
FLIGHT_WIDTH_PX = 480
FLIGHT_S = (2.0, 10.0)  # the flight is as long as the video, within these
FLIGHT_SIGMA_RATIO = 0.02  # of the video's length: what the path is smoothed over
DEPTH_RANGE = 16  # times the median depth that a depth image must hold


def depth_png_per_unit(median_depth: float) -> float:
    """Steps of a 16-bit depth image a map unit: a power of two, so that 16 median depths fit."""
    return float(2.0 ** np.floor(np.log2(65535 / (DEPTH_RANGE * median_depth))))


def flight_path(times_s: Array, world_from_cam: Array) -> Array:
    """(m, 4, 4) poses of the flight: the given trajectory, smoothed, evenly in time. InputError without a pose."""
    known = np.isfinite(world_from_cam).all((1, 2))
    times_s, world_from_cam = times_s[known], world_from_cam[known]
    if len(times_s) == 0:
        raise InputError("flight: expected a trajectory with at least one pose, got none")
    length_s = float(times_s[-1] - times_s[0])
    count = round(float(np.clip(length_s, *FLIGHT_S)) * FLIGHT_FPS)
    at_s = np.linspace(times_s[0], times_s[-1], count)
    spacing_s = length_s / max(1, len(times_s) - 1)
    return smoothed_path(times_s, world_from_cam, at_s, max(FLIGHT_SIGMA_RATIO * length_s, spacing_s, 1e-6))


def write_flight(
    path: Path, draw: Draw, camera: Camera, poses: Array, advance: Callable[[], None] | None = None
) -> str:
    """The splat along a path as a video, with the lens ``camera`` (a pinhole); names the codec. Raises OutputError."""

    def frames() -> Iterator[Array]:
        for pose in poses:
            yield draw(pose, camera)[0]
            if advance is not None:
                advance()

    return write_video(path, frames(), FLIGHT_FPS)


def flight_camera(full: Camera | OpenCvLens) -> Camera:
    """The flight's pinhole: the photograph's field of view, at the width of a small video."""
    width = min(FLIGHT_WIDTH_PX, full.width)
    return full.pinhole.resized(width, max(2, round(full.height * width / full.width)))


def export_splat(run: Run, kind: str, out: Path, *, all_poses: bool = False) -> Path:
    """``mastd3r export --to spz|flight|depth``: the splat of a run; gives the path written.

    spz: a file. flight: an .mp4. depth: a folder of 16-bit images <timestamp>.png of every pose that was measured, and
    with ``all_poses`` of the interpolated ones; its export.json says ``depth_png_per_unit``, steps a ``unit``.
    Raises InputError for a run without a map, OutputError where ``out`` cannot be written; it is whole or not there.
    """
    gaussians = gaussians_of(run)
    if kind == "spz":
        with writing(out):
            out.parent.mkdir(parents=True, exist_ok=True)
        with replacing(out) as part:
            from ..mapping.spz import write_gaussians_spz  # loads torch

            write_gaussians_spz(part, gaussians)
        return out
    lens, median_depth = lens_of(run), median_depth_of(run)
    from ..mapping.splat import NEAR_RATIO, Splat  # loads torch

    splat = Splat(gaussians, NEAR_RATIO * median_depth)
    if kind == "flight":
        with writing(out):
            out.parent.mkdir(parents=True, exist_ok=True)
        poses = flight_path(run.trajectory.timestamps_s, run.trajectory.world_from_cam)
        with replacing(out, out.suffix) as part:
            write_flight(part, splat.render, flight_camera(lens), poses)
        return out
    trajectory, per_unit = exported_poses(run, all_poses), depth_png_per_unit(median_depth)
    mapping = config_from_text(run.config, f"{run.path}/config.yaml").mapping
    map_view = MapView(lens, mapping.width_px, mapping.tau_uncertainty_px)
    facts = {"kind": kind, "run": str(run.path.resolve()), "unit": run.unit, "depth_png_per_unit": per_unit}
    with export_folder(out, facts, []) as staged:
        for time_s, pose in zip(trajectory.timestamps_s, trajectory.world_from_cam, strict=True):
            depth = splat.render(pose, map_view.pinhole)[1]
            write_depth_png(staged, float(time_s), map_view.depth_as_photograph(depth), per_unit)
    return out


def lens_of(run: Run) -> Camera | OpenCvLens:
    """The lens of camera.json; one with more than radial terms is OpenCV's."""
    c = run.camera
    if c is None:
        raise InputError(f"{run.path}: expected camera.json, which drawing the splat needs, got none")
    if not any(run.distortion[2:4] + run.distortion[5:]):
        return c
    return OpenCvLens(c.fx_px, c.fy_px, c.cx_px, c.cy_px, c.width, c.height, run.distortion)


def gaussians_of(run: Run) -> GaussianArrays:
    """The splat of a run, in the unit of its trajectory. Raises InputError where there is none."""
    return read_gaussians_ply(run.path / "gaussians.ply").in_lengths(run.lengths)


def median_depth_of(run: Run) -> float:
    """What run.json says of the map, in the unit of the trajectory. Raises InputError where there is none."""
    facts = run.record.get("map")
    if not isinstance(facts, dict) or "median_depth" not in facts:
        raise InputError(f"{run.path}/run.json: expected what was written of the map (key map), got none")
    return float(run.lengths * facts["median_depth"])
