"""III-C: the Gaussian map of a run, what is rendered of it, and the flight through it (Algorithm 1)."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import AbstractContextManager
from dataclasses import dataclass
from typing import Any

import numpy as np

from ..camera.map_view import MapView
from ..camera.opencv_lens import OpenCvLens
from ..camera.pinhole import Camera
from ..config import Config
from ..evaluation.image_error import psnr
from ..export.run_folder import RunFolder
from ..mapping.mapper import Mapper
from ..mapping.ply import write_gaussians_ply
from ..mapping.process import Outcome
from ..mapping.spz import write_gaussians_spz
from ..progress import Reporter
from ..types import StaticCloud, View
from .final_solve import FinalFrame
from .renders import depth_png_per_unit, flight_camera, flight_path, write_flight
from .smoothing import SmoothedMasks

Timed = Callable[[str], AbstractContextManager[None]]  # adds what a block takes to a stage's seconds
MAPPED_SAMPLES = 24  # training views that psnr_mapped is the mean over


@dataclass(frozen=True)
class TrainedMap:
    """A map, and its figures."""

    mapper: Mapper
    metrics: dict[str, Any]


def train_map(
    folder: RunFolder,
    config: Config,
    cloud: StaticCloud,
    views: list[View],
    device: str,
    begun: Outcome | None,
    reporter: Reporter,
) -> TrainedMap:
    """Train, from what ``begun`` left where a map was made while tracking, and write the splat."""
    m = config.mapping
    done = min(begun.steps, m.iterations // 2) if begun is not None else 0
    start = begun.gaussians if begun is not None else None
    mapper = Mapper(m, cloud, views, config.seed, device, start=start, steps_done=done)
    with reporter.stage("map", m.iterations - done, "steps") as bar:
        mapper.refine(m.iterations - done, lambda _step, _loss: bar.advance())
    write_gaussians_ply(folder.path / "gaussians.ply", mapper.gaussians)
    write_gaussians_spz(folder.path / "gaussians.spz", mapper.gaussians)
    per_unit = depth_png_per_unit(mapper.facts["median_depth"])
    folder.update(map={"device": device, **mapper.facts, "depth_png_per_unit": per_unit})
    figures = []
    for view in views[:: max(1, len(views) // MAPPED_SAMPLES)]:
        color, _, _ = mapper.render(view.world_from_cam, view.camera, view.timestamp_s)
        figures.append(psnr(color, view.image, view.static > 0.5))
    known = [f for f in figures if f is not None and np.isfinite(f)]
    mapped = float(np.mean(known)) if known else None
    return TrainedMap(mapper, {"gaussians": len(mapper.gaussians.means), "psnr_mapped": mapped})


def write_renders_and_flight(
    mapper: Mapper,
    folder: RunFolder,
    seen: SmoothedMasks,
    map_view: MapView,
    final: list[FinalFrame],
    lens: Camera | OpenCvLens,
    timed: Timed,
    reporter: Reporter,
) -> None:
    """renders/ and depth/ of the holdout frames; flight.mp4 along the smoothed trajectory, at neutral exposure."""
    per_unit = depth_png_per_unit(mapper.facts["median_depth"])
    with timed("renders"), reporter.stage("renders", len(seen.holdout), "frames") as bar:
        for place in seen.holdout:
            if not np.isfinite(place.world_from_cam).all():
                continue
            time_s = place.record.timestamp_s
            color, depth, _ = mapper.render(place.world_from_cam, map_view.pinhole, time_s)
            folder.write_render(time_s, map_view.as_photograph(color))
            folder.write_depth(time_s, map_view.depth_as_photograph(depth), per_unit)
            bar.advance()
    times_s = np.array([f.record.timestamp_s for f in final])
    poses = flight_path(times_s, np.stack([f.world_from_cam for f in final]))
    with timed("flight"), reporter.stage("flight", len(poses), "frames") as bar:
        write_flight(folder.path / "flight.mp4", mapper.render, flight_camera(lens), poses, bar.advance)
