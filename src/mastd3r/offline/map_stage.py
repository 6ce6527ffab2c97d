"""III-C: the Gaussian map of a run, what is rendered of it, and the flight through it (Algorithm 1)."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass
from typing import Any

import numpy as np

from ..camera.map_view import MapView
from ..camera.opencv_lens import OpenCvLens
from ..camera.pinhole import Camera
from ..config import Config
from ..evaluation.image_error import psnr
from ..export.files import replacing
from ..export.run_folder import RunFolder
from ..mapping.carried import with_unseen
from ..mapping.gaussian_arrays import GaussianArrays
from ..mapping.mapper import Mapper
from ..mapping.ply import read_gaussians_ply, write_gaussians_ply
from ..mapping.process import Outcome
from ..mapping.splat import NEAR_RATIO, Splat
from ..mapping.spz import write_gaussians_spz
from ..progress import Reporter
from ..types import StaticCloud, View
from .final_solve import FinalFrame
from .map_progress import MapProgress
from .renders import depth_png_per_unit, flight_camera, flight_path, write_flight

Timed = Callable[[str], AbstractContextManager[None]]  # adds what a block takes to a stage's seconds
MAPPED_SAMPLES = 24  # training views that psnr_mapped is the mean over


@dataclass(frozen=True)
class TrainedMap:
    """What the file holds, read back from disk, and what training learned beside it."""

    mapper: Mapper
    splat: Splat
    median_depth: float
    metrics: dict[str, Any]


def train_map(
    folder: RunFolder,
    config: Config,
    cloud: StaticCloud,
    views: list[View],
    device: str,
    begun: Outcome | None,
    reporter: Reporter,
    before: GaussianArrays | None = None,
) -> TrainedMap:
    """Train, from what ``begun`` left where a map was made while tracking, and write the splat.

    What no view shows of ``before``, the splat of the saved map that the video goes on in, stays as it is.
    Stopped by the user, the splat is written as it is.
    """
    m = config.mapping
    steps = m.iterations or 0
    done = min(begun.steps, steps // 2) if begun is not None else 0
    start = begun.gaussians if begun is not None else None
    mapper = Mapper(m, cloud, views, config.seed, device, start=start, steps_done=done)
    total, unit = (round(60 * m.minutes), "seconds") if m.minutes else (steps - done, "steps")
    with reporter.stage("map", total, unit) as bar:
        progress = MapProgress(mapper, views, steps - done, bar)
        try:
            if m.minutes:
                mapper.refine_for(60 * m.minutes, progress)
            else:
                mapper.refine(steps - done, progress)
        finally:
            median_depth = write_splat(folder, mapper, device, progress.steps, before, views)
    splat = Splat(read_gaussians_ply(folder.path / "gaussians.ply"), NEAR_RATIO * median_depth, device=device)
    figures = []
    for view in views[:: max(1, len(views) // MAPPED_SAMPLES)]:
        pose = mapper.refined_pose(view.world_from_cam, view.timestamp_s)
        color, _, _ = splat.render(pose, view.camera)
        figures.append(psnr(color, view.image / 255, view.static > 0.5))
    known = [f for f in figures if f is not None and np.isfinite(f)]
    mapped = float(np.mean(known)) if known else None
    metrics = {"gaussians": splat.count, "psnr_mapped": mapped}
    return TrainedMap(mapper, splat, median_depth, metrics)


def write_splat(
    folder: RunFolder, mapper: Mapper, device: str, steps: int, before: GaussianArrays | None, views: Sequence[View]
) -> float:
    """gaussians.ply and gaussians.spz, and what run.json says of them; gives the map's median depth.

    ``steps`` is what this training took. ``before``: a splat of which what no view shows goes on. Files that are there
    are replaced once both new ones are whole.
    """
    mapper.settle()
    median_depth = float(mapper.facts["median_depth"])
    gaussians, facts = mapper.gaussians, dict(mapper.facts)
    if before is not None:
        gaussians = with_unseen(gaussians, before, views, NEAR_RATIO * median_depth, device)
        facts["carried"] = len(gaussians.means) - len(mapper.gaussians.means)
    with replacing(folder.path / "gaussians.ply") as ply, replacing(folder.path / "gaussians.spz") as spz:
        write_gaussians_ply(ply, gaussians)
        write_gaussians_spz(spz, gaussians)
    per_unit = depth_png_per_unit(median_depth)
    folder.update(map={"device": device, "steps": steps, **facts, "depth_png_per_unit": per_unit})
    return median_depth


def write_renders_and_flight(
    trained: TrainedMap,
    folder: RunFolder,
    holdout: list[FinalFrame],
    map_view: MapView,
    final: list[FinalFrame],
    lens: Camera | OpenCvLens,
    timed: Timed,
    reporter: Reporter,
) -> None:
    """renders/, alpha/ and depth/ of the holdout frames, and flight.mp4: the file alone, over black."""
    per_unit, render = depth_png_per_unit(trained.median_depth), trained.splat.render
    with timed("renders"), reporter.stage("renders", len(holdout), "frames") as bar:
        for place in holdout:
            if not np.isfinite(place.world_from_cam).all():
                continue
            time_s = place.record.timestamp_s
            color, depth, alpha = render(place.world_from_cam, map_view.pinhole)
            folder.write_render(time_s, map_view.as_photograph(color))
            folder.write_alpha(time_s, map_view.as_photograph(alpha))
            folder.write_depth(time_s, map_view.depth_as_photograph(depth), per_unit)
            bar.advance()
    times_s = np.array([f.record.timestamp_s for f in final])
    poses = flight_path(times_s, np.stack([f.world_from_cam for f in final]))
    with timed("flight"), reporter.stage("flight", len(poses), "frames") as bar:
        write_flight(folder.path / "flight.mp4", render, flight_camera(lens), poses, bar.advance)
