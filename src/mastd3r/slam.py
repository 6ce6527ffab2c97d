"""The main loop: one frame in, one report out."""

from __future__ import annotations

import logging
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from .concurrency import Future, Worker
from .config import Config
from .dynamics.filter import LogOddsFilter
from .dynamics.soft_mask import grown, static_at
from .geometry.se3 import inverse
from .graph.covisibility import nearest_keyframe
from .graph.initialisation import bootstrap
from .graph.intrinsics import Intrinsics, intrinsics_for
from .graph.keyframe_graph import Keyframe, KeyframeGraph
from .graph.prediction import rigid_flow_to
from .graph.submaps import join, scale_between
from .parts import Near, Parts
from .pointmap.flow_maps import invert_flow
from .pointmap.mast3r import NetworkFrame
from .sources.checks import frame_is_blank
from .tracking.covisibility import CovisibilityEdges
from .tracking.depth_prior import own_depth_prior, predicted_depth
from .tracking.loop_closure import close_loops, widen
from .tracking.mask_input import dynamics_input
from .tracking.two_view import THIN, TwoView, TwoViewEstimator, matched_share
from .types import Frame, State, WorkFrame

Array = NDArray[Any]
log = logging.getLogger(__name__)
EDGES_AFTER = 4  # frames after a keyframe until its ties are taken: at the same frame however fast they were made
LEAST_MOTION_RATIO = 0.04  # of sqrt(width * height): from the same place a nearer keyframe sees no more of the scene
FOCAL_RATIOS_BELIEVED = (0.35, 4.0)  # focal / sqrt(width * height) of a network's points, for the lens to start there


@dataclass(frozen=True)
class StepReport:
    """What happened to one frame."""

    index: int
    timestamp_s: float
    state: State
    kf_id: int
    is_keyframe: bool
    why: str


def started_at(lens: Intrinsics, work: WorkFrame, size: tuple[int, int]) -> Intrinsics:
    """The lens with the focal length that the frame's own points speak of, where they do and a camera may have it."""
    focal_px = work.focal_px if isinstance(work, NetworkFrame) else None
    low, high = FOCAL_RATIOS_BELIEVED
    if focal_px is None or not low < focal_px / np.sqrt(size[0] * size[1]) < high:
        return lens
    g = np.concatenate([[np.log(focal_px)], lens.values[1:]])
    return Intrinsics(g, g.copy(), lens.prior_info)


class Slam:
    """Tracking and mapping of one source. Each line of ``step`` is one stage of the paper."""

    def __init__(self, config: Config, parts: Parts, full_size: tuple[int, int]) -> None:
        self.config, self.parts = config, parts
        width, height = parts.size
        self.graph = KeyframeGraph(config.graph, intrinsics_for(config.camera, width, height, full_size))
        self.graph.size = parts.size  # a run without a single keyframe still has a lens
        self.belief = LogOddsFilter(config.dynamics, width, height)
        self.comparer = TwoViewEstimator(config, parts, self.graph)
        self._mask = Worker("mask")  # the belief lives in its thread: it is updated while the next frame is matched
        self.links = CovisibilityEdges(config.graph, parts)
        self._tying = Worker("ties")
        self._tied: Future[KeyframeGraph] | None = None  # the graph with the newest keyframe's ties, not yet taken
        self._ref: Keyframe | None = None  # the keyframe that frames are tracked against
        self._before_loss: Keyframe | None = None  # the same, when the camera was lost
        self._flow: Array | None = None  # ref -> last frame
        self._last: tuple[WorkFrame, Future[Array]] | None = None  # last tracked frame and its P(moving)
        self._cam_from_ref = np.eye(4)  # of the last tracked frame
        self._most_matched = 0  # by any frame since ref was chosen
        self._keyframe_at = 0  # records there were when the newest keyframe was tied

    def near(self) -> Near:
        """What the frame after the next is probably seen beside: the keyframe that is followed now."""
        ref = self._ref
        return lambda _: None if ref is None else ref.work

    def step(self, frame: Frame) -> StepReport:
        """Track one frame (III-A, III-B); keyframes extend the graph."""
        if len(self.graph.records) - self._keyframe_at >= EDGES_AFTER:
            self._settle()
        work = self.parts.observe(frame, None if self._ref is None else self._ref.work)
        if frame_is_blank(frame.image):
            return self._lost(work, "the image is blank")
        looks = self._mask.submit(lambda: self.parts.describe(frame) if self.config.dynamics.use_head else None)
        prior = self._mask.submit(
            lambda: grown(self.belief.prior(work.gray, work.semantic, looks.get()))
        )  # prior of (2)
        if self._ref is None:
            return self._start(work, prior, "first view")
        view = self._find(work, prior)  # may change what is followed
        kf = self._ref
        if view is None:
            kf, view = self._retry(work, prior)
        if view is None:
            return self._start_again(work, prior)
        moving = self._update_belief(work, kf, view, prior, looks)  # III-A, (2)(3)
        self.graph.record(work, kf.id, view.alignment.new_from_ref, "tracked", view.pair.matches, view.weight)
        self._follow(kf, view, self._most_matched if kf is self._ref else 0)
        self._last = (work, moving)
        if self._wants_keyframe(view) and not self._changes_to_known(work, moving):
            kf = self._add_keyframe(work, moving, view)  # graph, joint optimisation
        return StepReport(work.index, work.timestamp_s, "tracked", kf.id, self._flow is None, "")

    def _find(self, work: WorkFrame, prior: Future[Array]) -> TwoView | None:
        """The frame against the keyframe that is followed; a young submap first looks for the map that was lost."""
        assert self._ref is not None
        if not self.graph.initialised and self.graph.started:
            view = self._rejoin(work, prior)
            if view is not None:
                return view
        view = self.comparer.compare(self._ref, work, prior, self._flow, self._cam_from_ref)
        if not self.comparer.accepted(view):
            return None
        thin = matched_share(self._ref, view.weight) < THIN
        return self._from_nearer(work, prior, view) if thin else view

    def _from_nearer(self, work: WorkFrame, prior: Future[Array], view: TwoView) -> TwoView:
        """Few matches are left: the last good frame becomes a keyframe, so that the chain has no weak link."""
        before, most = self._ref, self._most_matched
        assert before is not None
        if not self.graph.initialised or view.motion_ratio < LEAST_MOTION_RATIO:
            return view
        near = self._from_last(work, prior)
        if near is not None and near.weight.sum() > view.weight.sum():
            return near
        self._follow(before, view, most)
        return view

    def _from_last(self, work: WorkFrame, prior: Future[Array]) -> TwoView | None:
        """The last good frame becomes a keyframe, which is followed from here on; the frame seen from it, if it is."""
        last = self._last
        if last is None or self._flow is None or self.graph.records[-1].state != "tracked":
            return None
        near = self.comparer.compare(self._promote_last(*last), work, prior, None, np.eye(4))
        return near if self.comparer.accepted(near) else None

    def _rejoin(self, work: WorkFrame, prior: Future[Array]) -> TwoView | None:
        """Back into a submap that has structure, out of one that has none yet: the latter is given up."""
        graph = self.graph
        ids = [kf.id for kf in graph.keyframes if graph.submap_of[kf.id] in graph.started]
        candidates = self.parts.places.best(graph, work, ids)
        if self._before_loss is not None:
            candidates = [self._before_loss, *(kf for kf in candidates if kf.id != self._before_loss.id)]
        for kf in candidates:
            view = self.comparer.relocalised(kf, work, prior)
            if view is not None:
                log.info("frame %d found again from keyframe %d", work.index, kf.id)
                graph.drop_submap()
                graph.submap = graph.submap_of[kf.id]
                self.links.flows.clear()
                self._follow(kf, view, 0)
                return view
        return None

    def _retry(self, work: WorkFrame, prior: Future[Array]) -> tuple[Keyframe, TwoView | None]:
        """The keyframe cannot be followed: first make the last good frame a keyframe, then look for features."""
        near, graph = self._from_last(work, prior), self.graph
        assert self._ref is not None
        if near is not None:
            return self._ref, near
        places = self.parts.places.best(graph, work, graph.members())
        for kf in [self._ref, *(p for p in places if p.id != self._ref.id)]:
            view = self.comparer.relocalised(kf, work, prior)
            if view is not None:
                log.info("frame %d found again from keyframe %d", work.index, kf.id)
                return kf, view
        return self._ref, None

    def _follow(self, kf: Keyframe, view: TwoView, most_matched: int) -> None:
        self._ref, self._most_matched = kf, most_matched
        self._flow, self._cam_from_ref = view.pair.flow, view.alignment.new_from_ref

    def close(self) -> None:
        """After the last frame: keep what it alone sees, and join the submaps that can be."""
        self._settle()
        graph = self.graph
        if self._last is not None:
            self._last[1].get()
        if self._last is not None and self._flow is not None and self._ref is not None:
            work, moving = self._last
            view = self.comparer.compare(self._ref, work, moving, self._flow, self._cam_from_ref)
            t = self.config.tracking
            enough = 0.3 * (t.keyframe_motion_ratio if graph.initialised else t.first_motion_ratio)
            if self.comparer.accepted(view) and view.motion_ratio > enough:
                self._add_keyframe(work, moving, view)
        if graph.started and graph.keyframes and not graph.initialised and not bootstrap(graph):
            graph.drop_submap()
            graph.submap = graph.submap_of[graph.latest.id]
        for submap in sorted(graph.started)[1:]:
            graph.submap = submap
            any(self._joins(graph.keyframes[k]) for k in graph.members())
        for submap in sorted(graph.started):
            graph.submap = submap
            close_loops(self.comparer, graph, self.parts.places)
            widen(graph, lambda pairs: self.links.many(graph, pairs))

    # -- keyframes -------------------------------------------------------------------------------------------

    def _start(self, work: WorkFrame, prior: Future[Array], why: str) -> StepReport:
        graph = self.graph
        if not graph.started and not self.config.camera.intrinsics:
            graph.intrinsics = started_at(graph.intrinsics, work, graph.size)
        sigma = self.parts.provider.depth_sigma_ratio
        inv_depth, info = own_depth_prior(work, 1.0, sigma)
        kf = graph.add_keyframe(work, static_at(prior.get(), work.px), prior.get(), np.eye(4), inv_depth, info)
        graph.record(work, kf.id, np.eye(4), "started", None, np.zeros(0))
        graph.replace_last_by_keyframe(kf)
        if sigma is not None and bool((info * inv_depth**2 > 1).mean() > 0.1):
            graph.started.add(graph.submap)
        self._ref, self._flow, self._cam_from_ref, self._most_matched = kf, None, np.eye(4), 0
        self._last = (work, prior)
        return StepReport(work.index, work.timestamp_s, "started", kf.id, True, why)

    def _start_again(self, work: WorkFrame, prior: Future[Array]) -> StepReport:
        """The camera is lost: what follows is a submap of its own until it is recognised."""
        self._settle()
        graph, ref = self.graph, self._ref
        why = "the view before it cannot be followed into it, and no keyframe looks like it"
        log.info("frame %d lost: %s", work.index, why)
        if graph.initialised:
            self._before_loss = ref
        else:
            graph.drop_submap()
        self.links.flows.clear()
        graph.start_submap()
        return self._start(work, prior, why)

    def _wants_keyframe(self, view: TwoView) -> bool:
        t = self.config.tracking
        self._most_matched = max(self._most_matched, view.matched)
        thin = view.matched < t.keyframe_overlap_ratio * self._most_matched
        enough = t.keyframe_motion_ratio if self.graph.initialised else t.first_motion_ratio
        # something that passes in front thins the matches too, but from the same place nothing is gained
        return view.motion_ratio > enough or (thin and view.motion_ratio > 0.4 * enough)

    def _changes_to_known(self, work: WorkFrame, moving: Future[Array]) -> bool:
        """Where an older keyframe sees the same from nearby, frames hang on that one, and nothing is added."""
        graph, ref, t = self.graph, self._ref, self.config.tracking
        assert ref is not None
        if not graph.initialised:
            return False
        cam_from_world = self._cam_from_ref @ graph.variables[ref.id].cam_from_world
        near = nearest_keyframe(graph, cam_from_world, ref.id, t.known_overlap_ratio, t.known_motion_ratio)
        if near is None:
            return False
        kf, guess = graph.keyframes[near], cam_from_world @ inverse(graph.variables[near].cam_from_world)
        view = self.comparer.compare(kf, work, moving, rigid_flow_to(graph, near, cam_from_world), guess)
        alike = view.motion_ratio <= t.keyframe_motion_ratio and matched_share(kf, view.weight) >= 0.4
        if not self.comparer.accepted(view) or not alike:
            return False
        if abs(near - ref.id) > 1 and not graph.connected(near, ref.id):
            self._settle()
            if self.links.both(graph, near, ref.id):
                log.info("keyframes %d and %d see the same place", near, ref.id)
                graph.solve_all(4, 1.0)
        self._follow(kf, view, view.matched)
        return True

    def _promote_last(self, work: WorkFrame, moving: Future[Array]) -> Keyframe:
        assert self._ref is not None
        prior_view = self.comparer.compare(self._ref, work, moving, self._flow, self._cam_from_ref)
        return self._add_keyframe(work, moving, prior_view)

    def _add_keyframe(self, work: WorkFrame, moving: Future[Array], view: TwoView) -> Keyframe:
        """The frame recorded last becomes a keyframe, matched with those before it, and the window is optimised."""
        self._settle()
        graph, before = self.graph, self._ref
        assert before is not None
        cam_from_world = view.alignment.new_from_ref @ graph.variables[before.id].cam_from_world
        sigma = self.parts.provider.depth_sigma_ratio
        inv_depth, info = predicted_depth(graph, before.id, cam_from_world, work, view.alignment.scale, sigma)
        mask = moving.get()
        kf = graph.add_keyframe(work, static_at(mask, work.px), mask, cam_from_world, inv_depth, info)
        graph.replace_last_by_keyframe(kf)
        graph.connect(before.id, kf.id, view.pair.matches, static_at(mask, view.pair.matches.new_px), followed=True)
        if not graph.initialised:
            self.links.flows[before.id, kf.id] = view.pair.flow
        self.links.one(graph, kf.id, before.id, invert_flow(view.pair.flow, self.parts.grid_px))
        self._ref, self._flow, self._cam_from_ref, self._most_matched = kf, None, np.eye(4), 0
        self._last = (work, moving)
        if graph.initialised:
            self._tie(kf, before.id)
            return kf
        self.links.to_recent(graph, kf, before.id)
        if len(graph.members()) >= self.config.graph.bootstrap_keyframes and bootstrap(graph):
            self.links.flows.clear()
        return kf

    def _tie(self, kf: Keyframe, before: int) -> None:
        """Tie a new keyframe to the map: beside the next frames where nothing else depends on it, now otherwise."""
        graph = self.graph
        everything = len(graph.members()) in (10, 16, 24, 40, 64, 100, 160, 256)
        hurry = len(graph.records) - self._keyframe_at < EDGES_AFTER  # the next may come before they are made
        self._keyframe_at = len(graph.records)
        alone = graph.window_is_all or everything or hurry or len(graph.started) > 1
        if self.parts.provider.side_by_side and not alone:
            graph.solve_depths(kf.id)
            aside = graph.aside()
            self._tied = self._tying.submit(lambda: self.links.tie(aside, kf, before))
            return
        self.links.tie(graph, kf, before)
        if not (len(graph.started) > 1 and self._joins(kf)) and everything:
            graph.solve_all(6, 1.0)

    def _settle(self) -> None:
        """Wait for the ties of the newest keyframe, and take them into the graph."""
        if self._tied is not None:
            tied, self._tied = self._tied, None
            self.graph.take(tied.get())

    def _joins(self, kf: Keyframe) -> bool:
        """Recognise a place of another submap in ``kf``; the two become one. The older submap's world is kept."""
        graph = self.graph
        own = graph.submap_of[kf.id]
        others = [k.id for k in graph.keyframes if graph.submap_of[k.id] in graph.started - {own}]
        for other in self.parts.places.best(graph, kf.work, others):
            view = self.comparer.relocalised(other, kf.work, Future.done(kf.moving / 255.0))
            if view is None:
                continue
            pose = view.alignment.new_from_ref
            scale = scale_between(graph, other.id, kf.id, pose, view.pair.matches, view.weight)
            if scale is None:
                continue
            log.info("submap %d joined at keyframes %d and %d, scale %.3f", own, other.id, kf.id, scale)
            join(graph, other.id, kf.id, pose, scale)
            for k in range(max(0, other.id - 2), min(len(graph.keyframes), other.id + 3)):
                if k != kf.id and graph.submap_of[k] == graph.submap_of[kf.id]:
                    self.links.both(graph, k, kf.id)
            graph.solve_all(10, 2.0)
            return True
        return False

    def _update_belief(
        self, work: WorkFrame, kf: Keyframe, view: TwoView, prior: Future[Array], looks: Future[Array | None]
    ) -> Future[Array]:
        if not self.graph.initialised:
            return prior
        cam_from_world = view.alignment.new_from_ref @ self.graph.variables[kf.id].cam_from_world
        given = dynamics_input(self.graph, kf.id, inverse(cam_from_world), work, view.alignment.scale)
        return self._mask.submit(lambda: grown(self.belief.update(replace(given, features=looks.get())).probability))

    def _lost(self, work: WorkFrame, why: str) -> StepReport:
        """Nothing can be seen: the frame has no place, and the next one is looked for where the last one was."""
        ref = self._ref.id if self._ref is not None else 0
        self.graph.record(work, ref, self._cam_from_ref, "lost", None, np.zeros(0))
        self._flow, self._last = None, None
        log.warning("frame %d lost: %s", work.index, why)
        return StepReport(work.index, work.timestamp_s, "lost", ref, False, why)
