"""Keyframes of a camera that does not wait: all that takes long is done beside tracking, and taken when it is made.

Which frame it is taken at depends on the machine's speed, so a live run is not repeatable; over frames that were kept
``finish`` makes the run that is.
"""

from __future__ import annotations

import copy
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..alignment.reproject import StaticMatches, solve_pose
from ..concurrency import Future
from ..config import Config
from ..graph.keyframe_graph import Keyframe, KeyframeGraph
from ..graph.starting import start_or_let_go
from ..parts import Parts
from ..pointmap.flow_maps import invert_flow
from .depth_prior import predicted_depth
from .keyframes import KNOWN_ITERATIONS, SOLVED_AS_A_WHOLE, WHOLE_ITERATIONS, WHOLE_KERNEL_PX, Keyframes
from .state import TrackingState
from .two_view import TwoView, TwoViewEstimator

Array = NDArray[Any]
Back = list[tuple[int, int, Array]]
UNIT_TOLERANCE = 0.01  # of the graph's unit of length: as long as it is kept to that, nothing is done
STILL_MATCHED = 0.5  # of the matches that a keyframe had at best: as long as so many are left, it is followed


class LiveKeyframes(Keyframes):
    """One job at a time on a copy of the graph: a start of the map, or the matches of a keyframe and their solve.

    While it is done, frames are tracked as before, and hang on the keyframe that is there: where there is depth, the
    next keyframe waits for it. Keyframes that come while the map is being started, because the camera would be lost
    without them, are placed in it afterwards. Else a camera that would be lost without a keyframe waits for the job.
    """

    def __init__(self, config: Config, parts: Parts, graph: KeyframeGraph, two_view: TwoViewEstimator) -> None:
        super().__init__(config, parts, graph, two_view)
        self._starting: list[Keyframe] | None = None  # keyframes of the copy, while the job is a start
        self._edges_before = 0  # edges that the copy was made with
        self._waiting: list[tuple[Keyframe, int]] = []  # not in a copy yet, with the keyframe before
        self._back: Back = []  # keyframes to be matched with the one before, and the flow
        self._ending = False

    # -- the stages of a frame -------------------------------------------------------------------------------

    def up_to_date(self, state: TrackingState) -> TrackingState:
        """The state, with what has been made taken into the graph; lengths in it are those of the graph."""
        if self._pending is None or not self._pending.ready():
            return state
        scale = self._take()
        pose = state.cam_from_anchor.copy()
        pose[:3, 3] *= scale
        return replace(state, cam_from_anchor=pose)

    def _wanted(self, state: TrackingState, view: TwoView) -> bool:
        if self._pending is None:
            return super()._wanted(state, view)
        # while the map is started a keyframe that is not needed would only have to be placed in it afterwards
        return not self.graph.initialised and view.matched < STILL_MATCHED * state.most_matched

    # -- making them -----------------------------------------------------------------------------------------

    def settle(self) -> None:
        """Wait for all that is being made."""
        while self._pending is not None:
            self._take()

    def _before_another(self) -> None:
        if self._ending or self.graph.initialised:
            self.settle()

    def _close(self, near: int, anchor: int) -> None:
        if self._at_once():
            super()._close(near, anchor)
        elif self._pending is None:  # else it is closed another time, or after the last frame
            aside = self._copy()
            self._pending = self._worker.submit(lambda: self._closed(aside, near, anchor))

    def _match_back(self, kf_id: int, before: int, flow: Array) -> None:
        if self._at_once():
            super()._match_back(kf_id, before, flow)
        else:
            self._back.append((kf_id, before, flow))

    def _connect(self, kf: Keyframe, before: int) -> None:
        if self._at_once():
            super()._connect(kf, before)
            return
        whole = len(self.graph.members()) in SOLVED_AS_A_WHOLE
        aside, back = self._copy(), self._taken_back()
        self._pending = self._worker.submit(lambda: self._connected(aside, back, kf, before, whole))

    def _start_map(self, kf: Keyframe, before: int) -> None:
        if self._at_once():
            super()._start_map(kf, before)
            return
        self._waiting.append((kf, before))
        if self._pending is None:
            new, self._waiting = self._waiting, []
            self._starting, self._edges_before = list(self.graph.keyframes), len(self.graph.edges)
            aside, back = self._copy(), self._taken_back()
            self._pending = self._worker.submit(lambda: self._started(aside, back, new))

    # -- jobs, in the other thread ---------------------------------------------------------------------------

    def _closed(self, aside: KeyframeGraph, near: int, anchor: int) -> KeyframeGraph:
        if self.edges.add(aside, near, anchor):
            aside.solve_all(KNOWN_ITERATIONS, WHOLE_KERNEL_PX)
        return aside

    def _connected(self, aside: KeyframeGraph, back: Back, kf: Keyframe, before: int, whole: bool) -> KeyframeGraph:
        self._matched_back(aside, back)
        self.edges.connect(aside, kf, before)
        if whole:
            aside.solve_all(WHOLE_ITERATIONS, WHOLE_KERNEL_PX)
        return aside

    def _started(self, aside: KeyframeGraph, back: Back, new: list[tuple[Keyframe, int]]) -> KeyframeGraph:
        self._matched_back(aside, back)
        self._matched(aside, new)
        start_or_let_go(aside, hurry=True)
        return aside

    def _joined(self, aside: KeyframeGraph, back: Back, new: list[tuple[Keyframe, int]]) -> KeyframeGraph:
        self._matched_back(aside, back)
        self._matched(aside, new)
        aside.solve_window()
        return aside

    def _matched_back(self, aside: KeyframeGraph, back: Back) -> None:
        for kf_id, before, flow in back:
            self.edges.add_one_way(aside, kf_id, before, invert_flow(flow))

    def _matched(self, aside: KeyframeGraph, new: list[tuple[Keyframe, int]]) -> None:
        """Edges of keyframes that came one after the other."""
        for kf, before in new:
            until = copy.copy(aside)  # as it was when the keyframe came; its edges go to the same list
            until.keyframes = aside.keyframes[: kf.id + 1]
            self.edges.add_recent(until, kf, before)

    # -- copies, and what comes back -------------------------------------------------------------------------

    def _at_once(self) -> bool:
        """Whether nothing is left to a job: at the end, with a network that serves one, where submaps may be joined."""
        return self._ending or not self.parts.provider.side_by_side or len(self.graph.started) > 1

    def _taken_back(self) -> Back:
        """The way back of the keyframes that there are."""
        back, self._back = [b for b in self._back if b[0] < len(self.graph.keyframes)], []
        return back

    def _copy(self) -> KeyframeGraph:
        """A copy that a job may do with as it likes; the unit of length stays, for frames hang on this one."""
        aside = self.graph.aside()
        aside.edges, aside.started = [copy.copy(e) for e in aside.edges], set(aside.started)
        aside.submap_of = dict(aside.submap_of)
        aside.normalise = lambda: None  # type: ignore[method-assign]
        return aside

    def _take(self) -> float:
        """Take what has been made into the graph; what lengths in it were multiplied with."""
        assert self._pending is not None
        pending: Future[KeyframeGraph] = self._pending
        made, self._pending = pending.get(), None
        if self._starting is None:
            self.graph.take(made)
            return self._unit_again()
        known, self._starting = self._starting, None
        new, self._waiting = self._waiting, []
        graph = self.graph
        is_gone = graph.submap != made.submap or any(a is not b for a, b in zip(known, graph.keyframes, strict=False))
        if is_gone or len(graph.keyframes) < len(known):  # the submap was given up meanwhile
            there = {id(kf) for kf in graph.keyframes}
            self._waiting = [(kf, before) for kf, before in new if id(kf) in there]
            self._back = [b for b in self._back if b[0] in {kf.id for kf, _ in self._waiting}]
            return 1.0
        graph.edges = made.edges + graph.edges[self._edges_before :]
        graph.variables.update((kf.id, made.variables[kf.id]) for kf in known)
        graph.set_intrinsics(made.intrinsics)
        graph.submap_of.update((kf.id, made.submap_of[kf.id]) for kf in known)
        if not made.initialised:
            self._waiting = new
            return 1.0
        for kf, before in new:
            self._place(kf, before)
        graph.started.add(graph.submap)
        self.edges.flows.clear()
        scale = self._unit_again()
        if new:
            aside, back = self._copy(), self._taken_back()
            self._pending = self._worker.submit(lambda: self._joined(aside, back, new))
        return scale

    def _place(self, kf: Keyframe, before: int) -> None:
        """Pose and depths of a keyframe that came while the map was started, from the one before it alone."""
        graph, sigma_ratio = self.graph, self.parts.provider.depth_sigma_ratio
        v, pose = graph.variables[before], np.eye(4)
        edge = next((e for e in graph.edges if (e.i, e.j) == (before, kf.id)), None)
        if edge is not None:
            info, lens = graph.depth_info(before), graph.intrinsics.values
            matches = StaticMatches(v.px, v.inv_depth, info, edge.target.astype(float), edge.weight.astype(float), lens)
            for kernel_px in (8.0, 3.0, 1.0):
                pose = solve_pose(matches, pose, kernel_px=kernel_px).new_from_ref
        cam_from_world = pose @ v.cam_from_world
        inv_depth, info = predicted_depth(graph, before, cam_from_world, kf.work, 1.0, sigma_ratio)
        graph.set_keyframe_pose(kf.id, cam_from_world)
        graph.set_depths(kf.id, inv_depth)
        graph.hold_depths(kf.id, info)
        graph.solve_depths(kf.id)

    def _unit_again(self) -> float:
        """The graph's own unit of length; what all lengths were multiplied with."""
        graph = self.graph
        if graph.submap != 0 or not graph.initialised:
            return 1.0
        first = sorted(graph.variables)[0]
        unit = float(np.median([graph.median_inv_depth(k) for k in sorted(graph.variables)[:3]]))
        if abs(unit - 1) < UNIT_TOLERANCE:
            return 1.0  # it would go through all frames that there are
        before = float(np.median(graph.variables[first].inv_depth))
        graph.normalise()
        return before / float(np.median(graph.variables[first].inv_depth))

    def finish(self, state: TrackingState) -> None:
        """As for any run: nobody waits any more."""
        self.settle()
        self._ending = True
        super().finish(state)
