"""Which frames carry the structure, and how they come into the graph."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..concurrency import Future, Worker, give_back_memory
from ..config import Config
from ..dynamics.soft_mask import static_at
from ..geometry.se3 import inverse
from ..graph.covisibility import nearest_keyframe
from ..graph.initialisation import bootstrap
from ..graph.keyframe_graph import Keyframe, KeyframeGraph
from ..graph.prediction import rigid_flow_to
from ..graph.starting import drop_let_go, start_or_let_go
from ..parts import Parts
from ..pointmap.flow_maps import invert_flow
from ..types import WorkFrame
from .covisibility import CovisibilityEdges
from .depth_prior import own_depth_prior, predicted_depth
from .joining import give_up_unscaled, join_recognised
from .map_entry import MAP, MapEntry
from .observation import Observation
from .state import TrackedFrame, TrackingState, status_in
from .two_view import Start, TwoView, TwoViewEstimator, matched_share

Array = NDArray[Any]
EDGES_AFTER = 4  # frames after a keyframe until its edges are taken: at the same frame however fast they were made
SOLVED_AS_A_WHOLE = (10, 16, 24, 40, 64, 100, 160, 256)  # keyframes at which all of them move, not the window alone
WHOLE_ITERATIONS, WHOLE_KERNEL_PX = 6, 1.0  # of that solve
KNOWN_ITERATIONS = 4  # of the one where a known place closes a detour
DEPTH_KNOWN = 0.1  # share of a first keyframe's points with a measured depth, above: it needs no parallax
KNOWN_PLACE_MATCHED = 0.4  # share of an older keyframe's points matched, above: it is followed instead of a new one
GIVEN_BACK_EVERY = 16  # keyframes, after which memory that is free goes back to the system
THIN_MOTION = 0.4  # of a keyframe's motion: where matches are thin that is enough
SLOW_MOTION, SLOW_FRAMES = 0.5, 15  # of the motion before a start, and the frames after which it is enough
LAST_MOTION = 0.3  # of the same: enough for the last frame of the video


class Keyframes:
    """Records frames, makes keyframes of some, and connects those to the map, perhaps beside tracking."""

    def __init__(self, config: Config, parts: Parts, graph: KeyframeGraph, two_view: TwoViewEstimator) -> None:
        self.config, self.parts, self.graph, self.two_view = config, parts, graph, two_view
        self.edges = CovisibilityEdges(config.graph, parts)
        self.entry = MapEntry(config, parts, graph, two_view)
        self._worker = Worker("edges")
        self._pending: Future[KeyframeGraph] | None = None  # the graph with the newest keyframe's edges, not yet taken
        self._newest_at = 0  # records there were when the newest keyframe was connected

    # -- the stages of a frame -------------------------------------------------------------------------------

    def up_to_date(self, state: TrackingState) -> TrackingState:
        """The state, with the newest keyframe's edges taken into the graph once it is time."""
        if len(self.graph.records) - self._newest_at >= EDGES_AFTER:
            self.settle()
        return state

    def record(
        self, state: TrackingState, seen: Observation, view: TwoView | None, moving: Future[Array]
    ) -> TrackingState:
        """Store the frame's place against the keyframe of its view; as it is where recovery has stored it."""
        if view is None:
            return state
        work = seen.work
        self.graph.record(work, view.anchor.id, view.alignment.new_from_ref, "tracked", view.pair.matches, view.weight)
        most = state.most_matched if view.anchor is state.anchor else 0
        return replace(
            _following(state, view, most), status=status_in(self.graph), reason="", last=TrackedFrame(work, moving)
        )

    def extend(self, state: TrackingState, view: TwoView | None) -> TrackingState:
        """A keyframe where the view asks for one, and no older keyframe sees the same from nearby."""
        if view is None:
            return state
        state = replace(state, most_matched=max(state.most_matched, view.matched))
        if not self._wanted(state, view):
            return state
        known = self._known_place(state)
        return known if known is not None else self._add(state, view)

    def _wanted(self, state: TrackingState, view: TwoView) -> bool:
        t = self.config.tracking
        thin = view.matched < t.keyframe_overlap_ratio * state.most_matched
        enough = t.keyframe_motion_ratio if self.graph.initialised else self._enough_to_start(view.anchor, state)
        # something that passes in front thins the matches too, but from the same place nothing is gained
        return view.motion_ratio > enough or (thin and view.motion_ratio > THIN_MOTION * enough)

    def _enough_to_start(self, anchor: Keyframe, state: TrackingState) -> float:
        """Image motion of a first keyframe: less where the camera is slow, or a short clip never has enough."""
        waited = 0 if state.last is None else state.last.work.index - anchor.work.index
        return self.config.tracking.first_motion_ratio * (SLOW_MOTION if waited >= SLOW_FRAMES else 1.0)

    def _known_place(self, state: TrackingState) -> TrackingState | None:
        """Where an older keyframe sees the same from nearby, frames hang on that one, and nothing is added."""
        graph, anchor, last, t = self.graph, state.anchor, state.last, self.config.tracking
        assert anchor is not None and last is not None
        if not graph.initialised:
            return None
        cam_from_world = state.cam_from_anchor @ graph.variables[anchor.id].cam_from_world
        near = nearest_keyframe(graph, cam_from_world, anchor.id, t.known_overlap_ratio, t.known_motion_ratio)
        if near is None:
            return None
        kf, guess = graph.keyframes[near], cam_from_world @ inverse(graph.variables[near].cam_from_world)
        start = Start(rigid_flow_to(graph, near, cam_from_world), near=True)
        view = self.two_view.estimate(kf, last.work, last.moving, start, guess)
        nearby = view.motion_ratio <= t.keyframe_motion_ratio
        if not self.two_view.accepted(view) or not nearby or matched_share(kf, view.weight) < KNOWN_PLACE_MATCHED:
            return None
        far = abs(near - anchor.id) > 1 and max(near, anchor.id) >= graph.held
        if far and not graph.connected(near, anchor.id):
            self._close(near, anchor.id)
        return _following(state, view, view.matched)

    def _close(self, near: int, anchor: int) -> None:
        """Two keyframes see the same after a detour: they are matched, and everything moves."""
        self.settle()
        if self.edges.add(self.graph, near, anchor):
            self.graph.solve_all(KNOWN_ITERATIONS, WHOLE_KERNEL_PX)

    # -- making them -----------------------------------------------------------------------------------------

    def start(self, state: TrackingState, work: WorkFrame, prior: Future[Array], reason: str) -> TrackingState:
        """The frame is the first keyframe of a submap."""
        graph = self.graph
        if not graph.started and not self.config.camera.intrinsics:
            graph.believe_focal(work.focal_px)
        sigma = self.parts.provider.depth_sigma_ratio
        inv_depth, info = own_depth_prior(work, 1.0, sigma)
        kf = graph.add_keyframe(work, static_at(prior.get(), work.px), prior.get(), np.eye(4), inv_depth, info)
        graph.record(work, kf.id, np.eye(4), "started", None, np.zeros(0))
        graph.replace_last_by_keyframe(kf)
        if sigma is not None and bool((info * inv_depth**2 > 1).mean() > DEPTH_KNOWN):
            graph.started.add(graph.submap)
        return replace(_at_keyframe(state, kf), status=status_in(graph), reason=reason, last=TrackedFrame(work, prior))

    def promote_last(self, state: TrackingState) -> TrackingState:
        """The last frame that was tracked becomes a keyframe, which is followed from here on."""
        anchor, last = state.anchor, state.last
        assert anchor is not None and last is not None
        start = Start(state.flow, near=True)
        view = self.two_view.estimate(anchor, last.work, last.moving, start, state.cam_from_anchor)
        return self._add(state, view)

    def _add(self, state: TrackingState, view: TwoView) -> TrackingState:
        """The frame recorded last becomes a keyframe, matched with those before it, and the window is optimised."""
        self._before_another()
        if len(self.graph.keyframes) % GIVEN_BACK_EVERY == 0:
            give_back_memory()
        graph, before, last = self.graph, state.anchor, state.last
        assert before is not None and last is not None
        work, mask = last.work, last.moving.get()
        cam_from_world = view.alignment.new_from_ref @ graph.variables[before.id].cam_from_world
        sigma = self.parts.provider.depth_sigma_ratio
        inv_depth, info = predicted_depth(graph, before.id, cam_from_world, work, view.alignment.scale, sigma)
        kf = graph.add_keyframe(work, static_at(mask, work.px), mask, cam_from_world, inv_depth, info)
        graph.replace_last_by_keyframe(kf)
        graph.connect(before.id, kf.id, view.pair.matches, static_at(mask, view.pair.matches.new_px), followed=True)
        if not graph.initialised:
            self.edges.flows[before.id, kf.id] = view.pair.flow
        self._match_back(kf.id, before.id, view.pair.flow)
        if graph.initialised:
            self._connect(kf, before.id)
        else:
            self._start_map(kf, before.id)
        return replace(_at_keyframe(state, kf), status=status_in(graph))

    def _before_another(self) -> None:
        """What must be done before a keyframe may be added."""
        self.settle()

    def _match_back(self, kf_id: int, before: int, flow: Array) -> None:
        """The matches of a keyframe in the one before it, from the ``flow`` (h, w, 2) that was found the other way."""
        self.edges.add_one_way(self.graph, kf_id, before, invert_flow(flow))

    def _start_map(self, kf: Keyframe, before: int) -> None:
        """A keyframe before there is depth: its matches, and the start once there are enough of them."""
        graph = self.graph
        self.edges.add_recent(graph, kf, before)
        if start_or_let_go(graph):
            self.edges.flows.clear()

    def _connect(self, kf: Keyframe, before: int) -> None:
        """Connect a new keyframe to the map: beside the next frames where nothing else depends on it, now otherwise."""
        graph = self.graph
        everything = len(graph.free_members()) in SOLVED_AS_A_WHOLE
        hurry = len(graph.records) - self._newest_at < EDGES_AFTER  # the next may come before they are made
        self._newest_at = len(graph.records)
        alone = graph.window_is_all or everything or hurry or len(graph.started) > 1
        if self.parts.provider.side_by_side and not alone:
            graph.solve_depths(kf.id)
            aside = graph.aside()
            self._pending = self._worker.submit(lambda: self.edges.connect(aside, kf, before))
            return
        self.edges.connect(graph, kf, before)
        if not (len(graph.started) > 1 and self.joins(kf)) and everything:
            graph.solve_all(WHOLE_ITERATIONS, WHOLE_KERNEL_PX)

    def settle(self) -> None:
        """Wait for the edges of the newest keyframe, and take them into the graph."""
        if self._pending is not None:
            made, self._pending = self._pending, None
            self.graph.take(made.get())

    # -- what is remembered between frames -------------------------------------------------------------------

    def memory(self) -> tuple[KeyframeGraph | None, int, dict[tuple[int, int], Array]]:
        """The graph with the newest keyframe's edges, where it is to be taken later, when that was, and flows."""
        return None if self._pending is None else self._pending.get(), self._newest_at, self.edges.flows

    def remember(self, memory: tuple[KeyframeGraph | None, int, dict[tuple[int, int], Array]]) -> None:
        """What ``memory`` gave."""
        aside, self._newest_at, self.edges.flows = memory
        self._pending = None if aside is None else Future.done(aside)

    def joins(self, kf: Keyframe, unscaled: list[TwoView] | None = None) -> bool:
        """True where ``kf`` shows a place of another submap, and the two have become one; see ``join_recognised``."""
        views = [] if unscaled is None else unscaled
        return join_recognised(self.graph, kf, self.two_view, self.edges, self.parts.places, self.entry, views)

    # -- after the last frame --------------------------------------------------------------------------------

    def finish(self, state: TrackingState) -> None:
        """Keep what the last frame alone sees, and join the submaps that can be; leave a map where it was not found."""
        self.settle()
        graph, last = self.graph, state.last
        if last is not None:
            last.moving.get()
        if last is not None and state.flow is not None and state.anchor is not None:
            start = Start(state.flow, near=True)
            view = self.two_view.estimate(state.anchor, last.work, last.moving, start, state.cam_from_anchor)
            t = self.config.tracking
            enough = LAST_MOTION * (t.keyframe_motion_ratio if graph.initialised else t.first_motion_ratio)
            if self.two_view.accepted(view) and view.motion_ratio > enough:
                self._add(state, view)
        drop_let_go(graph)
        elsewhere = graph.started - ({MAP} if self.entry.wanted else set())
        if elsewhere and graph.keyframes and not graph.initialised and not bootstrap(graph).started:
            graph.drop_submap()
            graph.submap = graph.submap_of[graph.latest.id]
        self._join_all()
        graph.leave_map_unless_found()

    def _join_all(self) -> None:
        graph = self.graph
        for submap in sorted(graph.started)[1:]:
            graph.submap, unscaled = submap, list[TwoView]()
            joined = any(self.joins(graph.keyframes[k], unscaled) for k in graph.members())
            if not joined and give_up_unscaled(graph, submap, unscaled):
                graph.submap = graph.submap_of[graph.latest.id]
                self.edges.flows = {}  # by numbers that keyframes had

    def close(self) -> None:
        """End the thread."""
        self._worker.close()


def _following(state: TrackingState, view: TwoView, most_matched: int) -> TrackingState:
    """Frames are tracked against the anchor of this view from here on."""
    return replace(
        state,
        anchor=view.anchor,
        most_matched=most_matched,
        flow=view.pair.flow,
        cam_from_anchor=view.alignment.new_from_ref,
    )


def _at_keyframe(state: TrackingState, kf: Keyframe) -> TrackingState:
    """The last frame is the anchor itself."""
    return replace(state, anchor=kf, most_matched=0, flow=None, cam_from_anchor=np.eye(4))
