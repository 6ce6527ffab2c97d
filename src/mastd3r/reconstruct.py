"""Source in, run folder out: the stages in order, their timings, and what is saved when one of them stops."""

from __future__ import annotations

import logging
import time
from collections import deque
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from .camera.map_view import MapView
from .camera.opencv_lens import OpenCvLens
from .camera.pinhole import Camera
from .camera.rectification import Rectifier, rectifier_for
from .concurrency import one_blas_thread
from .config import Config, config_to_yaml
from .errors import InputError, SlamError
from .evaluation.evaluate import evaluate
from .evaluation.image_error import psnr
from .export.evidence import EvidenceSample
from .export.machine import peak_rss_mib
from .export.mask_video import MaskVideo
from .export.read_run import read_run
from .export.report import write_report
from .export.report_data import gather_report_data
from .export.run_folder import RunFolder
from .mapping.mapper import Mapper
from .mapping.ply import write_gaussians_ply
from .mapping.process import Outcome
from .mapping.rasterise import accelerator
from .mapping.spz import write_gaussians_spz
from .offline.final_solve import FinalFrame, final_frames, finish_graph, trajectory_of
from .offline.live_map import LiveMap
from .offline.renders import depth_png_per_unit, flight_camera, flight_path, write_flight
from .offline.smoothing import FrameMask, Look, SmoothedMasks, smooth_masks
from .offline.static_cloud import static_cloud
from .parts import build_parts, chosen_map_device, with_dataset_lens
from .progress import Reporter, Silent
from .slam import Slam
from .sources import open_source
from .sources.rectified import RectifiedSource, tracked_frames
from .tracking.depth_prior import own_depth_spread
from .types import Frame, Source, StaticCloud

Array = NDArray[Any]
log = logging.getLogger(__name__)
MAPPED_SAMPLES = 24  # training views that psnr_mapped is the mean over


@dataclass(frozen=True)
class RunResult:
    """What a run leaves behind."""

    path: Path
    metrics: dict[str, Any]


@dataclass(frozen=True)
class MapMaterial:
    """What a map is made from."""

    cloud: StaticCloud
    seen: SmoothedMasks
    map_view: MapView


@one_blas_thread()
def run(
    source_path: str | Path,
    out: Path,
    config: Config,
    *,
    command: list[str] | None = None,
    reporter: Reporter | None = None,
    maps: Path | None = None,
) -> RunResult:
    """Do everything for one source. Raises SlamError children; what was computed until then is in the folder."""
    job = _job(source_path, out, config, command or [], reporter or Silent(), maps)
    try:
        job.everything()
    except SlamError as e:
        job.save_the_rest(str(e))
        raise
    except KeyboardInterrupt:
        job.save_the_rest("stopped by the user (Ctrl-C)")
        raise
    finally:
        job.close()
    return RunResult(job.folder.path, job.metrics)


@one_blas_thread()
def material_for_map(source_path: str | Path, out: Path, config: Config) -> MapMaterial:
    """Everything of ``run`` that comes before the map, for those who train several on the same. Raises as ``run``."""
    return _job(source_path, out, config, [], Silent(), None).before_map()[1]


def _job(
    source_path: str | Path, out: Path, config: Config, command: list[str], reporter: Reporter, maps: Path | None
) -> _Job:
    want_semantic = config.semantics in ("auto", "maps")
    source = open_source(
        source_path,
        config.source,
        want_depth=config.pointmaps == "depth",
        want_semantic=want_semantic,
        semantic_dir=maps,
    )
    config, told = with_dataset_lens(config, source)
    rectifier = rectifier_for(config.camera.intrinsics, source.size)
    tracked = _tracked(source, rectifier)
    parts = build_parts(config, tracked)  # refuses before anything is written
    device = chosen_map_device(config.mapping, parts.notes)
    slam = Slam(_config_of_slam(config, rectifier), parts, tracked.size)
    inputs = [Path(p).expanduser() for p in (source_path, maps) if p is not None]
    job = _Job(source, rectifier, config, slam, RunFolder(out, command, inputs), reporter, device)
    job.folder.note(*told)
    return job


def _tracked(source: Source, rectifier: Rectifier | None) -> Source:
    """What tracking is shown: photographs, or the pinhole images made of them."""
    return source if rectifier is None else RectifiedSource(source, rectifier)


def _config_of_slam(config: Config, rectifier: Rectifier | None) -> Config:
    """What tracking is told: where photographs are rectified, its lens is the pinhole."""
    if rectifier is None:
        return config
    c = rectifier.pinhole
    return replace(config, camera=replace(config.camera, intrinsics=(c.fx_px, c.fy_px, c.cx_px, c.cy_px)))


class _Job:
    """One run in progress."""

    def __init__(
        self,
        source: Source,
        rectifier: Rectifier | None,
        config: Config,
        slam: Slam,
        folder: RunFolder,
        reporter: Reporter,
        map_device: str = "cpu",
    ) -> None:
        self._map_device = map_device
        self.source, self.rectifier = source, rectifier  # frames of the source are photographs
        self.config, self.slam, self.folder, self.reporter = config, slam, folder, reporter
        self.metrics: dict[str, Any] = {}
        self.timings: dict[str, float] = {}
        self._started = time.perf_counter()
        self._final: list[FinalFrame] = []
        self._evidence: EvidenceSample | None = None  # of the frame that shows most
        realtime = config.mapping.enabled and config.mapping.realtime
        self._live = LiveMap(config, map_device) if realtime else None
        self._begun: Outcome | None = None  # the map that was made while tracking
        folder.write_config(config_to_yaml(config))
        folder.update(source={"path": source.name, "kind": source.kind, "size": list(source.size)})
        folder.note(*slam.parts.notes, *([rectifier.note] if rectifier is not None else []))

    def everything(self) -> None:
        """All stages in order."""
        frames, material = self.before_map()
        cloud, seen = material.cloud, material.seen
        if self.config.mapping.enabled and not (seen.views and len(cloud.points_world)):
            self.folder.note(f"no map: {len(seen.views)} frames can show it, {len(cloud.points_world)} points start it")
        elif self.config.mapping.enabled:
            with self._timed("map"):
                mapper = self._map(cloud, seen)
            with self._timed("renders"):
                self._render(mapper, seen, material.map_view)
            with self._timed("flight"):
                self._fly(mapper)
        self._finish(frames)

    def before_map(self) -> tuple[int, MapMaterial]:
        """Tracking, joint optimisation, masks and cloud: the number of frames, and what a map is made from."""
        with self._timed("tracking"):
            frames = self._track()
        with self._timed("joint optimisation"):
            self._solve()
        map_view = MapView(self.lens(), self.config.mapping.width_px, self.config.mapping.tau_uncertainty_px)
        with self._timed("masks"):
            seen = self._look_again(map_view)
        with self._timed("poses under the masks"):
            seen = self._place_again(seen)
        cloud = static_cloud(self.slam.graph, seen.colors, seen.moving)
        self.folder.write_cloud(cloud)
        return frames, MapMaterial(cloud, seen, map_view)

    def _track(self) -> int:
        count = 0
        with self.reporter.stage("tracking", self.source.length, "frames") as bar:
            photographs: deque[Frame] = deque()
            tracked = tracked_frames(self.source.frames(), self.rectifier, photographs)
            for frame in self.slam.parts.prefetched(tracked, self.slam.near):
                photograph = photographs.popleft()
                self.slam.step(frame)
                if self._live is not None:
                    self._live.after(count, photograph, frame, self.slam.graph, self.lens)
                count += 1
                bar.advance()
        self.slam.close()
        self.folder.note(*self.source.notes)
        if count < 2:
            raise InputError(f"{self.source.name}: expected at least 2 frames, got {count}")
        if not self.slam.graph.keyframes:
            raise InputError(f"{self.source.name}: expected pictures with something in them, got {count} blank frames")
        return count

    def _solve(self) -> None:
        provider = self.slam.parts.provider
        if not finish_graph(self.slam.graph, self.config, needs_motion=provider.depth_sigma_ratio is None):
            self.folder.note(
                f"pointmaps {provider.name}: no depth was measured, no frame could be followed; every frame is given "
                "one pose, and neither path, cloud nor map mean anything"
            )
        assumed, found = provider.depth_sigma_ratio, own_depth_spread(self.slam.graph)
        if assumed is not None and found is not None:
            self.folder.note(f"own depths differ from the solved ones by {found:.1%} (1 sigma), assumed {assumed:.1%}")
        self._final = final_frames(self.slam.graph)
        self._write_trajectory()
        if self._live is not None:
            self._begun, facts, note = self._live.finish(self.slam.graph, self.lens)
            self.folder.update(realtime=facts)
            self.folder.note(note)

    def _write_trajectory(self) -> None:
        graph = self.slam.graph
        self.folder.write_trajectory(trajectory_of(self._final))
        lens = self.lens()
        camera = lens.radial if isinstance(lens, OpenCvLens) else lens
        self.folder.write_camera(camera, lens.distortion if isinstance(lens, OpenCvLens) else None)
        report = graph.last_report
        sigma = report.focal_sigma_ratio if report is not None else None
        lost = [f for f in self._final if f.state == "interpolated"]
        facts: dict[str, Any] = {
            "focal_px": self._focal_px(),
            "focal_sigma_ratio": sigma if sigma is not None and np.isfinite(sigma) else None,
            "k1": camera.k1,
            "k2": camera.k2,
            "k3": camera.k3,
            "found": "given" if self.config.camera.intrinsics else "from the video",
        }
        if isinstance(lens, OpenCvLens):
            facts["distortion"] = list(lens.distortion)
        self.folder.update(
            camera=facts,
            graph={"keyframes": len(graph.keyframes), "edges": len(graph.edges)},
        )
        if lost:
            self.folder.note(f"{len(lost)} frames were lost; their poses are interpolated")

    def lens(self) -> Camera | OpenCvLens:
        """The lens over the photograph: the calibrated one where photographs are rectified."""
        if self.rectifier is not None:
            return self.rectifier.lens
        return self.slam.graph.camera().resized(*self.source.size)

    def _focal_px(self) -> float:
        lens = self.lens()
        return lens.focal_px if isinstance(lens, OpenCvLens) else lens.fx_px

    def _look_again(self, map_view: MapView) -> SmoothedMasks:
        slam, folder = self.slam, self.folder
        look = Look(self._final, slam.graph, slam.parts, self.config, map_view, self.rectifier, slam.belief.head)
        video = MaskVideo(folder.path / "masks.mp4", *slam.parts.size)
        best = 0.0
        with self.reporter.stage("masks", len(self._final), "frames") as bar:

            def on_mask(seen: FrameMask) -> None:
                nonlocal best
                folder.write_mask(seen.timestamp_s, seen.over_photograph)
                video.add(seen.timestamp_s, seen.image, seen.mask.probability)
                shown = float(np.minimum(seen.mask.moving.mean(), 0.3)) + 1e-3 * len(seen.mask.evidence)
                if shown > best:
                    best = shown
                    self._evidence = EvidenceSample(
                        seen.timestamp_s, seen.image, seen.mask.probability, dict(seen.mask.evidence)
                    )
                bar.advance()

            try:
                return smooth_masks(self.source.frames(), look, on_mask)
            finally:
                video.close()

    def _place_again(self, seen: SmoothedMasks) -> SmoothedMasks:
        if not self.slam.graph.started:
            return seen
        self._final = seen.late.poses(self.slam.graph)
        self._write_trajectory()
        return seen.with_poses(self._final)

    def _map(self, cloud: StaticCloud, seen: SmoothedMasks) -> Mapper:
        config, begun = self.config.mapping, self._begun
        done = min(begun.steps, config.iterations // 2) if begun is not None else 0
        start = begun.gaussians if begun is not None else None
        mapper = Mapper(config, cloud, seen.views, self.config.seed, self._map_device, start=start, steps_done=done)
        with self.reporter.stage("map", config.iterations - done, "steps") as bar:
            mapper.refine(config.iterations - done, lambda _step, _loss: bar.advance())
        write_gaussians_ply(self.folder.path / "gaussians.ply", mapper.gaussians)
        write_gaussians_spz(self.folder.path / "gaussians.spz", mapper.gaussians)
        per_unit = depth_png_per_unit(mapper.facts["median_depth"])
        self.folder.update(map={"device": self._map_device, **mapper.facts, "depth_png_per_unit": per_unit})
        self.metrics["gaussians"] = len(mapper.gaussians.means)
        few = seen.views[:: max(1, len(seen.views) // MAPPED_SAMPLES)]
        figures = []
        for view in few:
            color, _, _ = mapper.render(view.world_from_cam, view.camera, view.timestamp_s)
            figures.append(psnr(color, view.image, view.static > 0.5))
        known = [f for f in figures if f is not None and np.isfinite(f)]
        self.metrics["psnr_mapped"] = float(np.mean(known)) if known else None
        return mapper

    def _render(self, mapper: Mapper, seen: SmoothedMasks, map_view: MapView) -> None:
        per_unit = depth_png_per_unit(mapper.facts["median_depth"])
        with self.reporter.stage("renders", len(seen.holdout), "frames") as bar:
            for place in seen.holdout:
                if not np.isfinite(place.world_from_cam).all():
                    continue
                time_s = place.record.timestamp_s
                color, depth, _ = mapper.render(place.world_from_cam, map_view.pinhole, time_s)
                self.folder.write_render(time_s, map_view.as_photograph(color))
                self.folder.write_depth(time_s, map_view.depth_as_photograph(depth), per_unit)
                bar.advance()

    def _fly(self, mapper: Mapper) -> None:
        """flight.mp4: the splat along the smoothed trajectory, at neutral exposure."""
        times_s = np.array([f.record.timestamp_s for f in self._final])
        poses = flight_path(times_s, np.stack([f.world_from_cam for f in self._final]))
        with self.reporter.stage("flight", len(poses), "frames") as bar:
            path = self.folder.path / "flight.mp4"
            write_flight(path, mapper.render, flight_camera(self.lens()), poses, bar.advance)

    def _finish(self, frames: int) -> None:
        elapsed = time.perf_counter() - self._started
        evaluation = evaluate(self.folder.path, self.source.truth(), self.source.frames())
        self.metrics = {
            **evaluation.metrics,
            **self.metrics,
            "keyframes": len(self.slam.graph.keyframes),
            "focal_px": self._focal_px(),
            "fps_tracking": frames / self.timings["tracking"],
            "fps_total": frames / elapsed,
            "peak_rss_mib": peak_rss_mib(),
        }
        if (card := accelerator()) is not None:
            self.folder.update(accelerator=card[0])
            self.metrics["peak_gpu_mib"] = card[1]
        self.folder.write_metrics(self.metrics)
        if evaluation.ate is not None and (aligned := evaluation.ate.table()) is not None:
            self.folder.write_aligned(aligned)
        self.folder.update(timings_s=self.timings)
        self.folder.finish()
        recorded = read_run(self.folder.path)
        ate = evaluation.ate
        data = gather_report_data(
            recorded,
            self.source.frames(),
            {h.timestamp_s: h.psnr_db for h in evaluation.holdout},
            ate.truth_in_map(len(recorded.trajectory.timestamps_s)) if ate and ate.rmse is not None else None,
            ate.scale if ate and ate.rmse is not None else None,
            title=self.source.name,
            evidence=self._evidence,
        )
        write_report(self.folder.path, data)

    def close(self) -> None:
        """End what runs beside."""
        if self._live is not None:
            self._live.close()

    def save_the_rest(self, reason: str) -> None:
        """Write what is known and mark the run incomplete; never hides the error that brought us here."""
        self.folder.make_room()
        try:
            graph = self.slam.graph
            if not self._final and graph.records:
                if graph.initialised:
                    graph.solve_all(5, 1.0)
                self._final = final_frames(graph)
                self._write_trajectory()
            self.folder.note(*self.source.notes)
            self.folder.update(timings_s=self.timings)
            self.folder.finish("incomplete", reason)
        except SlamError as e:
            log.error("could not save everything: %s", e)

    @contextmanager
    def _timed(self, stage: str) -> Iterator[None]:
        began = time.perf_counter()
        try:
            yield
        finally:
            self.timings[stage] = time.perf_counter() - began
            self.folder.record["timings_s"] = self.timings
