"""What a run leaves behind: its stages after tracking, their timings, and what is saved when one of them stops."""

from __future__ import annotations

import logging
import time
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import asdict
from types import TracebackType
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from ..camera.map_view import MapView
from ..camera.opencv_lens import OpenCvLens
from ..camera.pinhole import Camera
from ..concurrency import undivided
from ..config import config_to_yaml
from ..errors import InputError, SlamError, reason_of
from ..evaluation.evaluate import evaluate
from ..export.evidence import EvidenceSample
from ..export.frame_names import names_by_time
from ..export.machine import peak_rss_mib
from ..export.mask_video import MaskVideo
from ..export.read_run import read_run
from ..export.run_folder import RunFolder
from ..graph.focal_sigma import focal_facts
from ..graph.initialisation import bootstrap
from ..graph.starting import drop_let_go
from ..parts import used_accelerator
from ..progress import Reporter
from ..tracking.depth_prior import own_depth_spread
from ..tracking.memory import TrackingMemory
from ..types import MEASURED, Frame
from .checkpoints import Checkpoints, JobMemory, Stage
from .dense import write_dense_cloud_of
from .final_solve import FinalFrame, final_frames, finish_graph, trajectory_of, turned_upright
from .metres import in_lengths, scale_notes, scale_of_run
from .run_report import write_run_report
from .smoothing import FrameMask, SmoothedMasks, SmoothingContext, smooth_masks
from .static_cloud import static_cloud
from .tracked import MapMaterial, Tracked
from .tracks import static_tracks

if TYPE_CHECKING:  # they load torch, which takes seconds: methods bring what a map needs
    from ..mapping.process import Outcome
    from .live_map import LiveMap
    from .map_stage import TrainedMap

Array = NDArray[Any]
log = logging.getLogger(__name__)
TURNS_ONLY = "the camera only turns: rotations and the lens are found, no depth, no translation, no map"
NO_MAP_PX = 64  # width of the map's images where there is no map, which nothing is drawn in


class RunJob:
    """One run in progress, as a context: whatever stops it, what was computed until then is written."""

    def __init__(
        self, tracked: Tracked, folder: RunFolder, reporter: Reporter, checkpoints: Checkpoints | None = None
    ) -> None:
        self.tracked, self.folder, self.reporter = tracked, folder, reporter
        self.config, self.graph, self.source = tracked.config, tracked.graph, tracked.source
        self.frames = 0  # that were tracked
        self.metrics: dict[str, Any] = {}
        self.timings: dict[str, float] = {}
        self.processor_s: dict[str, float] | None = {}  # of all threads; None: part of it was another process's
        self._began = time.perf_counter()
        self._final: list[FinalFrame] = []
        self._turns_only = False  # the camera has one place: there is no depth
        self._scale: dict[str, Any] | None = None  # run.json's: what metres were taken from
        self._evidence: EvidenceSample | None = None  # of the frame that shows most
        realtime = self.config.mapping.enabled and self.config.mapping.realtime
        self._live: LiveMap | None = None
        if realtime:
            from .live_map import LiveMap

            self._live = LiveMap(self.config, tracked.map_device)
        self._begun: Outcome | None = None  # the map that was made while tracking
        self.checkpoints = checkpoints
        folder.write_config(config_to_yaml(self.config))
        source, rectifier = self.source, tracked.rectifier
        known = folder.record.get("source") or {"path": source.name}
        folder.update(source={**known, "kind": source.kind, "size": list(source.size)})
        folder.note(*tracked.parts.notes, *([rectifier.note] if rectifier is not None else []))

    # -- while tracking ------------------------------------------------------------------------------------

    def after(self, frame: Frame) -> None:
        """One frame has been tracked: the map that is made meanwhile may take something of it."""
        if self._live is not None:
            self._live.after(self.frames, frame, self.graph, self.tracked.lens)
        self.frames += 1

    def keep(self, stage: Stage, tracking: Callable[[], TrackingMemory]) -> None:
        """Write down how far the run is: at once where a stage has ended, else where it is time."""
        if self.checkpoints is None or (stage == "tracking" and not self.checkpoints.due()):
            return
        spent = time.perf_counter() - self._began
        tracked_s = self.timings.get("tracking", 0.0) if stage != "tracking" else spent
        self.checkpoints.write(
            stage, tracking, JobMemory(self.frames, tracked_s, self._final, self._turns_only, self._scale)
        )

    def go_on(self, memory: JobMemory) -> None:
        """From what an earlier process has written down; a map that was begun while tracking is not among it."""
        self.already_tracked(memory.frames, memory.tracking_s)
        self._final, self._turns_only, self._scale = memory.final, memory.turns_only, memory.scale
        if self._live is not None:
            self._live.close()
            self._live = None

    def already_tracked(self, frames: int, seconds: float) -> None:
        """So many frames were tracked, in so long, before this job began: they count as its own."""
        self.frames, self.timings["tracking"], self.processor_s = frames, seconds, None
        self._began -= seconds

    def check_tracked(self) -> None:
        """Raise InputError for a source that had too little in it."""
        self.folder.note(*self.source.notes)
        name, count = self.source.name, self.frames
        if count < 2:
            raise InputError(f"{name}: expected at least 2 frames, got {count}")
        if not self.graph.keyframes:
            raise InputError(f"{name}: expected pictures with something in them, got {count} blank frames")

    # -- the stages after it ---------------------------------------------------------------------------------

    def solve(self) -> None:
        """The joint optimisation over everything, and every frame's pose from it."""
        graph, provider = self.graph, self.tracked.parts.provider
        with self.timed("joint optimisation"):
            self.folder.update(loops=[{"frames": [i, j], "verdict": said} for i, j, said in graph.loops])
            seen = finish_graph(graph, self.config, needs_motion=provider.depth_sigma_ratio is None)
            may_turn_only = provider.depth_sigma_ratio is None and not graph.held
            self._turns_only = seen is not None and seen.kind == "rotation" and may_turn_only
            if seen is not None:
                said = TURNS_ONLY if self._turns_only else None
                self.folder.update(observability={**asdict(seen), "said": said})
            if self._turns_only:
                self.folder.note(TURNS_ONLY)
            if seen is None:
                self.folder.note(
                    f"pointmaps {provider.name}: no depth was measured, no frame could be followed; every frame is "
                    "given one pose, and neither path, cloud nor map mean anything"
                )
            assumed, found = provider.depth_sigma_ratio, own_depth_spread(graph)
            if assumed is not None and found is not None:
                self.folder.note(f"own depths differ from the solved by {found:.1%} (1 sigma), assumed {assumed:.1%}")
            note, facts = turned_upright(graph)
            self.folder.note(note)
            self.folder.update(world=facts)
            final = final_frames(graph)
            if self._live is not None:
                self._begun, facts, note = self._live.finish(graph, self.tracked.lens)
                self.folder.update(realtime=facts)
                self.folder.note(note)
            self._set_unit(final)

    def smooth_masks(self, appearance: Any) -> MapMaterial:
        """Masks under the final poses, every frame placed once more under them, and the static cloud."""
        m = self.config.mapping
        map_view = MapView(self.tracked.lens(), m.width_px or NO_MAP_PX, m.tau_uncertainty_px)
        with self.timed("masks"):
            seen = self._masks(map_view, appearance)
        with self.timed("poses under the masks"):
            if self.graph.started:
                self._final = seen.reweighting.poses(self.graph)
                self._write_trajectory()
                seen = seen.with_poses(self._final)
        colors = {} if self._turns_only else seen.colors
        cloud = self.tracked.whole_cloud(static_cloud(self.graph, colors, seen.moving))
        if not self._turns_only:
            self.folder.write_cloud(cloud)
            px = self.tracked.photograph_px
            self.folder.write_tracks(static_tracks(self.graph, self._final, colors, seen.moving, px))
        return MapMaterial(cloud, seen, map_view)

    def make_map(self, material: MapMaterial) -> None:
        """The Gaussian map, its renders of the holdout frames, and the flight through it."""
        cloud, views = self.tracked.seeds(material), material.seen.views
        if not self.config.mapping.enabled or self._turns_only:
            return
        if not views or not len(cloud.points_world):
            self.folder.note(f"no map: {len(views)} frames can show it, {len(cloud.points_world)} points start it")
            return
        from .map_stage import train_map, write_renders_and_flight

        with self.timed("map"):
            where, before = self.tracked.map_device, self.tracked.splat_before()
            trained = train_map(self.folder, self.config, cloud, views, where, self._begun, self.reporter, before)
        self.metrics |= trained.metrics
        if self.config.mapping.refine_poses and self.graph.started:
            self._place_frames(trained)
        place = {f.record.index: f for f in self._final}
        write_renders_and_flight(
            trained,
            self.folder,
            [place[f.record.index] for f in material.seen.holdout],
            material.map_view,
            self._final,
            self.tracked.lens(),
            self.timed,
            self.reporter,
        )

    def dense_cloud(self) -> None:
        """Depth of every keyframe pixel, where that is asked for."""
        if self.config.cloud != "dense" or self._turns_only or not self.graph.started:
            return
        with self.timed("dense cloud"):
            facts = write_dense_cloud_of(read_run(self.folder.path), self.source, self.reporter)
        self.folder.update(dense=facts)

    def _place_frames(self, trained: TrainedMap) -> None:
        """Every frame's pose read off the finished map, so that the trajectory agrees with the splat."""
        from .placement import place_frames

        folder = self.folder

        def start(frame: FinalFrame) -> Array:
            return trained.mapper.refined_pose(frame.world_from_cam, frame.record.timestamp_s)

        with self.timed("poses in the map"), self.reporter.stage("poses", len(self._final), "frames") as bar:
            placement = place_frames(
                self.source.frames(),
                self._final,
                trained.splat,
                self.tracked.lens(),
                start,
                folder.path / "masks",
                bar.advance,
            )
        self._final = placement.final
        self._write_trajectory()
        folder.update(placement=placement.facts)

    def report(self) -> None:
        """Figures against the truth, where there is one, and the report."""
        elapsed = time.perf_counter() - self._began
        times_s = np.array([f.record.timestamp_s for f in self._final])
        evaluation = evaluate(self.folder.path, self.source.truth(), self.source.frames(), times_s)
        states = Counter("tracked" if f.state == "started" else f.state for f in self._final)
        self.metrics = {
            **evaluation.metrics,
            **self.metrics,
            **{f"frames_{s}": states[s] for s in ("tracked", "interpolated", "lost")},
            "keyframes": len(self.graph.keyframes) - self.graph.held,
            "focal_px": _focal_px(self.tracked.lens()),
            "fps_tracking": self.frames / self.timings["tracking"],
            "fps_total": self.frames / elapsed,
            "peak_rss_mib": peak_rss_mib(),
        }
        if self.processor_s is not None:
            self.metrics["core_s_per_frame_tracking"] = self.processor_s["tracking"] / self.frames
            self.metrics["core_s_per_frame"] = sum(self.processor_s.values()) / self.frames
        if (sigma_ratio := self.folder.record["camera"]["focal_sigma_ratio"]) is not None:
            self.metrics["focal_sigma_ratio"] = sigma_ratio
        if (card := used_accelerator()) is not None:
            self.folder.update(accelerator=card[0])
            self.metrics["peak_gpu_mib"] = card[1]
        self.folder.write_metrics(self.metrics)
        self.folder.note(*self.source.notes)  # what the truth had to say too
        if evaluation.ate is not None and (aligned := evaluation.ate.table()) is not None:
            self.folder.write_aligned(aligned)
        self.folder.update(timings_s=self.timings)
        if self.checkpoints is not None:
            self.folder.update(checkpoints=self.checkpoints.facts())
        record = self.folder.record | self.folder.ending()
        write_run_report(self.folder.path, self.source, evaluation, self._evidence, record)
        self.folder.finish()
        if self.checkpoints is not None:
            self.checkpoints.remove()

    @contextmanager
    def timed(self, stage: str) -> Iterator[None]:
        """Adds what the block takes to the stage's seconds in run.json."""
        began, busy = time.perf_counter(), time.process_time()
        try:
            yield
            log.info("%s: %.1f s", stage, time.perf_counter() - began)
        finally:
            self.timings[stage] = self.timings.get(stage, 0.0) + time.perf_counter() - began
            self.folder.record["timings_s"] = self.timings
            if self.processor_s is not None:
                self.processor_s[stage] = self.processor_s.get(stage, 0.0) + time.process_time() - busy
                self.folder.record["processor_s"] = self.processor_s

    # -- parts of the stages ---------------------------------------------------------------------------------

    def _masks(self, map_view: MapView, appearance: Any) -> SmoothedMasks:
        tracked, folder = self.tracked, self.folder
        context = SmoothingContext(
            self._final, self.graph, tracked.parts, self.config, map_view, tracked.rectifier, appearance
        )
        video = MaskVideo(folder.path / "masks.mp4", *tracked.parts.provider.size)
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
                return smooth_masks(self.source.frames(), context, on_mask)
            finally:
                video.close()

    def _set_unit(self, final: list[FinalFrame]) -> None:
        """Everything from here on in metres, where that was asked for and can be measured; the poses are written."""
        facts = scale_of_run(self.tracked, final, self.folder.record)
        self.folder.note(*scale_notes(facts))
        with undivided():  # the graph, the poses and what is said of their unit belong together
            if facts is not None and facts["applied"]:
                final = in_lengths(self.graph, final, facts["metres_per_unit"])
                self._begun = None if self._begun is None else self._begun.in_lengths(facts["metres_per_unit"])
            self._final, self._scale = final, facts
            self._write_trajectory()

    def _write_trajectory(self) -> None:
        graph = self.graph
        self.folder.write_trajectory(trajectory_of(self._final))
        lens = self.tracked.lens()
        camera = lens.radial if isinstance(lens, OpenCvLens) else lens
        focal = focal_facts(graph, given=self.tracked.lens_is_given)
        self.folder.write_camera(camera, lens.distortion if isinstance(lens, OpenCvLens) else None, **focal)
        lost = [f for f in self._final if f.state == "interpolated"]
        facts: dict[str, Any] = {
            "focal_px": _focal_px(lens),
            **focal,
            "k1": camera.k1,
            "k2": camera.k2,
            "k3": camera.k3,
        }
        if isinstance(lens, OpenCvLens):
            facts["distortion"] = list(lens.distortion)
        self.folder.update(
            camera=facts,
            scale=self._scale,
            continues=self.tracked.continues(),
            graph={"keyframes": len(graph.keyframes) - graph.held, "edges": len(graph.edges)},
            files=names_by_time(self.source, [(f.record.index, f.record.timestamp_s) for f in self._final]),
        )
        if lost:
            self.folder.note(f"{len(lost)} frames were lost; their poses are interpolated")
        if 2 * sum(f.state in MEASURED for f in self._final) < len(self._final):
            few = f"fewer than half of the {len(self._final)} frames were tracked: most of the trajectory is a guess"
            self.folder.note(few)
            log.warning(few)

    # -- what stops it ---------------------------------------------------------------------------------------

    def __enter__(self) -> RunJob:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        with undivided():
            if self._live is not None:
                self._live.close()
            if error is not None and self.folder.record["status"] == "running":
                self.save_the_rest(reason_of(error))

    def save_the_rest(self, reason: str) -> None:
        """Write what is known and mark the run incomplete; never hides the error that brought us here."""
        self.folder.make_room()
        try:
            graph = self.graph
            graph.leave_map_unless_found()
            drop_let_go(graph)
            started = self._final or graph.started or (len(graph.members()) > 1 and bootstrap(graph).started)
            if not self._final and started:  # before that there is neither place nor lens
                if graph.initialised:
                    graph.solve_all(5, 1.0)
                self.folder.record.pop("world", None)  # it is not turned upright
                self._set_unit(final_frames(graph))
            self.folder.note(*self.source.notes)
            self.folder.update(timings_s=self.timings)
        except Exception as e:  # noqa: BLE001  whatever state the first error left
            log.error("could not save everything: %s", reason_of(e))
        try:
            self.folder.finish("incomplete", reason)
        except SlamError as e:
            log.error("could not save everything: %s", e)


def _focal_px(lens: Camera | OpenCvLens) -> float:
    return lens.focal_px if isinstance(lens, OpenCvLens) else lens.fx_px
