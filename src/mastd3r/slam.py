"""The paper's loop: ``track`` is one frame, ``finish`` what follows the last; a line a stage, its file beside it."""

from __future__ import annotations

import tempfile
import time
from collections.abc import Callable, Collection, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from .camera.rectification import Rectifier, rectifier_for
from .concurrency import Future, give_back_memory, one_blas_thread, undivided
from .config import Config, check_config
from .errors import ConfigError, InputError
from .export.run_folder import RunFolder
from .geometry.se3 import inverse
from .graph.intrinsics import intrinsics_for
from .graph.keyframe_graph import KeyframeGraph
from .graph.loose import leave_loose
from .graph.match_noise import learn_match_variance
from .graph.merging import with_lost_frames
from .graph.passages import Tried, retake_passages
from .graph.scale_jumps import mend_scale_jumps
from .graph.solved_anew import solve_anew
from .metric.measure import measure
from .offline.checkpoints import Checkpoints, Memory
from .offline.extended_map import ExtendedMap
from .offline.job import RunJob
from .offline.reconstruction import Reconstruction
from .offline.saved_map import SavedMap
from .offline.tracked import Tracked
from .parts import Parts, build_parts, chosen_map_device, with_map_effort
from .progress import Reporter, Silent
from .sources.recorded import RecordedSource
from .sources.rectified import RectifiedSource, rectified
from .tracking.keyframes import Keyframes
from .tracking.live_keyframes import LiveKeyframes
from .tracking.loop_closure import COVISIBLE_PAIRS, add_covisible_pairs, close_loops
from .tracking.lost_frames import find_lost
from .tracking.masking import MaskTracker
from .tracking.memory import TrackingMemory, can_remember, memory_of, remember
from .tracking.observation import Near, Observer
from .tracking.recovery import Recovery
from .tracking.segments import PAIRS_AFTER_JOINING, join_segments
from .tracking.state import Status, TrackingState
from .tracking.two_view import TwoViewEstimator
from .types import Frame, Source

Array = NDArray[Any]


@dataclass(frozen=True)
class TrackResult:
    """What is known of one frame when it has been tracked; later frames may still correct it."""

    index: int  # of the frame, from 0
    timestamp_s: float
    state: Status
    world_from_cam: Array | None  # (4, 4), OpenCV axes, map units; None where the frame has no place in the map yet
    is_keyframe: bool
    reason: str  # why the camera is lost or starts anew; empty while all goes well
    keyframe_id: int  # the keyframe that the frame hangs on
    submap: int  # poses of different submaps have nothing in common until they are joined
    _moving: Future[Array]
    _as_given: Callable[[Array], Array]

    @cached_property
    def moving(self) -> Array:
        """(h, w) float32 P(moving) over the image as it was given, with a margin; waits until it is made."""
        return self._as_given(self._moving.get())


class Slam:
    """Tracking and mapping of one camera. Instances do not know of one another."""

    def __init__(
        self,
        config: Config | None = None,
        size: tuple[int, int] = (640, 480),
        *,
        source: Source | None = None,
        parts: Parts | None = None,
        live: bool = False,
        map: SavedMap | None = None,
    ) -> None:
        """``size`` (width, height) of the images. ``source``: what the frames come from, if it can be read again.

        Without one, frames are kept on disk until ``finish``. ``parts``: instead of those that the options name.
        ``live``: no frame waits for keyframes or the start of the map; results then depend on the machine's speed.
        ``map``: the frames go on in it; those whose poses are in its frame have ``submap`` 0.
        Raises ConfigError and InputError for options that this machine, source or map cannot serve.
        """
        self.config = check_config(config or Config())
        if live and map is not None:
            raise ConfigError("live: expected no map to go on in, which run alone does")
        if live and self.config.scale:
            raise ConfigError(
                "live: expected no scale, as poses are given out before it is known; measure it afterwards"
            )
        self.scale = measure(self.config.scale)
        given = self.config.camera.intrinsics
        self.recorded = None if source is not None else _recorded(self.config, size)
        self.source: Source = source if source is not None else self.recorded  # type: ignore[assignment]
        self.extends = None if map is None else ExtendedMap(map)
        if self.extends is not None:
            self.config = self.extends.options(self.config, self.source)
        of_map = None if self.extends is None or given else self.extends
        self.rectifier = rectifier_for(given, self.source.size) if of_map is None else of_map.rectifier(self.source)
        self.seen = self.source if self.rectifier is None else RectifiedSource(self.source, self.rectifier)
        self.parts = parts if parts is not None else build_parts(self.config, self.seen)
        self.map_device = chosen_map_device(self.config.mapping, self.parts.notes)
        self.config = with_map_effort(self.config, self.source.size, self.map_device, self.parts.notes)
        known = (self.config, self.parts, self.rectifier)
        self.graph = _empty_graph(*known, self.seen) if of_map is None else of_map.graph(*known, self.source)
        if self.extends is not None:
            self.extends.begin(self.graph, self.config, self.parts)
        self.two_view = TwoViewEstimator(self.config, self.parts, self.graph)
        keyframes = LiveKeyframes if live else Keyframes
        self.keyframes: Keyframes = keyframes(self.config, self.parts, self.graph, self.two_view)
        self.recovery = Recovery(self.parts, self.graph, self.two_view, self.keyframes)
        self.masks = MaskTracker(self.parts.dynamics.filter(*self.parts.provider.size), self.graph)
        self.observer = Observer(self.parts)
        self.aligner = self.parts.aligner
        self.state = TrackingState()
        self._ended, self._tracked, self._tracking_s = False, 0, 0.0
        self._given_up: set[int] = set()  # frames that are not looked for once more
        self._pairs = COVISIBLE_PAIRS  # of keyframes matched after the last frame, for each of them

    def track(
        self,
        image: Array | Frame,
        timestamp_s: float = np.nan,
        *,
        depth_m: Array | None = None,
        semantic: Array | None = None,
    ) -> TrackResult:
        """Track one frame: III-A and III-B.

        image (h, w, 3) uint8 RGB of the size that was said, timestamp_s ascending seconds; depth_m (h, w) metres where
        ``pointmaps=depth``, semantic (h', w') P(movable) where ``semantics=maps``. A ``Frame`` of the source carries
        all of it. Raises InputError, before anything has changed, for another size or type, a time that is not finite
        or does not rise, and after ``finish``.
        """
        frame = self._frame(image, timestamp_s, depth_m, semantic)
        with self._measured(), undivided():
            state = self.keyframes.up_to_date(self.state)
            seen = self.observer.observe(frame, None if state.anchor is None else state.anchor.work)  # (III-A)
            prior = self.masks.prior(seen)  # prior of (2): dynamics/filter.py
            problem = self.two_view.match(state, seen, prior)  # (5)(6)(7): tracking/two_view.py
            coarse = self.aligner.coarse(problem)  # (8): alignment/coarse.py
            scaled = self.aligner.scale(problem, coarse)  # (9)(10): alignment/scale.py
            fine = self.aligner.fine(problem, scaled)  # (11)(12): alignment/fine.py
            view = self.two_view.view(state.anchor, problem, fine)
            state, view = self.recovery.accept(state, seen, prior, view)  # as it is, while all goes well
            moving = self.masks.update(seen, view, prior)  # (1)-(4): dynamics/filter.py, dynamics/paper.py
            state = self.keyframes.record(state, seen, view, moving)
            self.state = self.keyframes.extend(state, view)  # graph/keyframe_graph.py
        return self._result(frame, moving)

    @one_blas_thread()
    def finish(self, job: RunJob | None = None) -> Reconstruction:
        """Everything after the last frame, as ``config`` says; gives what came of it, in memory and on disk.

        ``job``: where it is written; by default a temporary folder, which lives as long as the result.
        Raises InputError where the frames had too little in them, and after an earlier ``finish``.
        """
        self._refuse_if_ended("finish")
        if self.recorded is not None and self.recorded.length != self._tracked:
            raise InputError("finish: expected images, or a source to read the frames from again, got frames alone")
        if job is None:
            return self._finish_alone()
        with job.timed("tracking"):
            self.end_tracking()
        job.keep("tracked", self.memory)
        return self._after_tracking(job)

    def _after_tracking(self, job: RunJob, *, solved: bool = False) -> Reconstruction:
        job.check_tracked()
        if not solved:
            job.solve()  # joint optimisation: graph/bundle_adjustment.py; every frame's pose: offline/final_solve.py
            job.keep("solved", self.memory)
            give_back_memory()
        material = job.smooth_masks(self.masks.filter.appearance)  # III-A, forward-backward: dynamics/smoother.py;
        # (15)(16): dynamics/uncertainty.py; static cloud: offline/static_cloud.py
        job.make_map(material)  # III-C: Algorithm 1: mapping/mapper.py; (13)-(17): mapping/losses.py
        job.dense_cloud()
        job.report()
        if self.recorded is not None:
            self.recorded.close()
        return Reconstruction(job.folder.path)

    # -- a run that goes on from a checkpoint ----------------------------------------------------------------

    def memory(self) -> TrackingMemory:
        """All that tracking remembers now: to be written at once, nothing is copied."""
        return memory_of(self.state, self.keyframes, self.masks, self.parts)

    def go_on(self, memory: Memory, job: RunJob) -> Reconstruction | None:
        """Stand where the run stood that gave ``memory``; what came of it where only later stages were missing."""
        self.state = remember(memory.tracking, self.keyframes, self.masks, self.parts)
        job.go_on(memory.job)
        if memory.stage == "tracking":
            return None
        self._ended = True
        self.masks.close()
        self.keyframes.close()
        return self._after_tracking(job, solved=memory.stage == "solved")

    def take_segments(self, segments: list[TrackingMemory], frames: Collection[tuple[int, float]] = ()) -> list[Any]:
        """What was tracked apart, in order of time, as if it had been tracked here; how the pieces were joined.

        ``frames``: (index, seconds) of all; those that no piece has are lost, and not looked for once more.
        Raises InputError where no piece has any depth.
        """
        needs_motion = self.parts.provider.depth_sigma_ratio is None
        graphs = [s.graph for s in segments]
        joints = join_segments(self.graph, graphs, self.keyframes.edges, needs_motion=needs_motion)
        self._pairs = PAIRS_AFTER_JOINING
        self.masks.remember(segments[-1].mask)  # what it has learned of the looks of things
        known = {r.index for r in self.graph.records}
        self._given_up = {index for index, _ in frames} - known
        with_lost_frames(self.graph, frames)
        return joints

    def end_tracking(self) -> None:
        """After the last frame: submaps joined, passages explained anew, loops closed, what sees the same matched.

        Jumps of scale are mended where that is cheaper, before others are matched by it, and again. With all matches
        there everything is solved anew once, coarse to fine. What hangs by a thread goes, and lost frames are looked
        for among the keyframes that stay.
        """
        self._refuse_if_ended("finish")
        self._ended = True
        graph = self.graph
        self.keyframes.finish(self.state)
        learn_match_variance(graph)
        for submap in sorted(graph.started):
            graph.submap = submap
            tried = Tried()
            retake_passages(graph, tried)
            mend_scale_jumps(graph)
            if self.config.graph.loops:
                close_loops(self.two_view, graph, self.parts.places)
            add_covisible_pairs(graph, lambda pairs: self.keyframes.edges.add_many(graph, pairs), self._pairs)
            retake_passages(graph, tried)  # more is matched now, which one explanation may fit and another not
            solve_anew(graph)
            retake_passages(graph, tried)  # what costs another amount than when it was tried
            leave_loose(graph)
            mend_scale_jumps(graph)
        find_lost(self.seen.frames(), graph, Observer(self.parts), self.two_view, self._given_up)
        self.masks.close()
        self.keyframes.close()
        getattr(self.parts.features, "forget", lambda: None)()  # nobody asks any more
        getattr(self.parts.semantics, "forget", lambda: None)()  # the video is read from its beginning again
        give_back_memory()

    def prefetched(self, photographs: Iterator[Frame]) -> Iterator[Frame]:
        """Frames for ``track``, each read, and looked at, while the one before is tracked."""
        rectifier = self.rectifier
        frames = photographs if rectifier is None else (rectified(p, rectifier) for p in photographs)
        return self.observer.prefetched(frames, self._near)

    def job(self, folder: RunFolder, reporter: Reporter | None = None, *, checkpoints: bool = False) -> RunJob:
        """What writes this run into a folder; with checkpoints, if the frames can be read again."""
        how = (self.rectifier, self.map_device, self.scale, self.extends)
        tracked = Tracked(self.source, self.config, self.graph, self.parts, *how)
        if checkpoints and not can_remember(self.masks):
            folder.note("no checkpoints: the filter of the mask does not say what it remembers")
            checkpoints = False
        return RunJob(tracked, folder, reporter or Silent(), Checkpoints(folder.path) if checkpoints else None)

    def _finish_alone(self) -> Reconstruction:
        """``finish`` in a temporary folder."""
        folder = tempfile.TemporaryDirectory(prefix="mastd3r-run-", ignore_cleanup_errors=True)
        with RunFolder(Path(folder.name)) as run:
            job = self.job(run)
            job.already_tracked(self._tracked, self._tracking_s)
            with job:
                self.finish(job)
        return Reconstruction(run.path, folder)

    @contextmanager
    def _measured(self) -> Iterator[None]:
        """Seconds and number of the frames that were tracked."""
        began = time.perf_counter()
        with one_blas_thread():
            yield
        self._tracked, self._tracking_s = self._tracked + 1, self._tracking_s + time.perf_counter() - began

    def _near(self) -> Near:
        """What the frame after the next is probably seen beside: the keyframe that is followed now."""
        anchor = self.state.anchor
        return lambda _: None if anchor is None else anchor.work

    def _frame(self, image: Array | Frame, timestamp_s: float, depth_m: Array | None, semantic: Array | None) -> Frame:
        self._refuse_if_ended("track")
        if isinstance(image, Frame):
            return image
        if self.recorded is None:
            raise InputError("track: expected frames of the source that was given, got an image")
        photograph = self.recorded.frame(image, timestamp_s, depth_m, semantic)
        return photograph if self.rectifier is None else rectified(photograph, self.rectifier)

    def _refuse_if_ended(self, what: str) -> None:
        if self._ended:
            raise InputError(f"{what}: expected a run that goes on, got one that has been finished; make a new Slam")

    def _result(self, frame: Frame, moving: Future[Array]) -> TrackResult:
        """What the caller gets; the pose is the map's as it is now."""
        state, record = self.state, self.graph.records[-1]
        placed = state.status is Status.TRACKING
        cam_from_world = record.cam_from_kf @ self.graph.variables[record.kf_id].cam_from_world if placed else None
        width, height = self.source.size

        def as_given(values: Array) -> Array:
            over = values if self.rectifier is None else self.rectifier.as_photograph(values)
            return np.asarray(cv2.resize(over, (width, height), interpolation=cv2.INTER_LINEAR), np.float32)

        return TrackResult(
            frame.index,
            frame.timestamp_s,
            state.status,
            None if cam_from_world is None else inverse(cam_from_world),
            record.is_keyframe,
            state.reason,
            record.kf_id,
            self.graph.submap,
            moving,
            as_given,
        )


def _recorded(config: Config, size: tuple[int, int]) -> RecordedSource:
    if len(size) != 2 or min(size) < 1:
        raise InputError(f"size: expected (width, height) of the images in pixels, got {size}")
    depth, maps = config.pointmaps == "depth", config.semantics == "maps"
    return RecordedSource((int(size[0]), int(size[1])), has_depth=depth, has_semantic=maps)


def _empty_graph(config: Config, parts: Parts, rectifier: Rectifier | None, source: Source) -> KeyframeGraph:
    """A graph without keyframes, with a lens; where photographs are rectified that is the pinhole.

    A focal length that the source only hints at is where the lens starts, which goes to the notes.
    """
    camera = config.camera
    if rectifier is not None:
        c = rectifier.pinhole
        camera = replace(camera, intrinsics=(c.fx_px, c.fy_px, c.cx_px, c.cy_px))
    width, height = parts.provider.size
    hint_px: float | None = None if camera.intrinsics else getattr(source, "focal_hint_px", None)
    if hint_px is not None:
        parts.notes.append(f"focal length starts at {getattr(source, 'focal_source', 'a hint')} ({hint_px:.0f} px)")
    graph = KeyframeGraph(config.graph, intrinsics_for(camera, width, height, source.size, hint_px))
    graph.size = parts.provider.size
    return graph
