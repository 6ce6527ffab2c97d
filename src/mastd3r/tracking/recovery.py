"""What happens where a frame cannot be followed: nearer keyframes, relocalisation, and a submap of its own."""

from __future__ import annotations

import logging
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..concurrency import Future
from ..graph.keyframe_graph import Keyframe, KeyframeGraph
from ..parts import Parts
from ..types import WorkFrame
from .keyframes import Keyframes
from .observation import Observation
from .places import believed, candidates
from .state import Status, TrackingState, status_in
from .two_view import THIN, Start, TwoView, TwoViewEstimator, matched_share

Array = NDArray[Any]
log = logging.getLogger(__name__)
LEAST_MOTION_RATIO = 0.04  # of sqrt(width * height): from the same place a nearer keyframe sees no more of the scene
Outcome = tuple[TrackingState, TwoView | None]  # None: the frame starts a submap, or shows nothing


class Recovery:
    """Accepts the view of a frame, or finds another one, or starts anew. Nothing here is needed while all goes well."""

    def __init__(self, parts: Parts, graph: KeyframeGraph, two_view: TwoViewEstimator, keyframes: Keyframes) -> None:
        self.parts, self.graph, self.two_view, self.keyframes = parts, graph, two_view, keyframes

    def accept(self, state: TrackingState, seen: Observation, prior: Future[Array], view: TwoView | None) -> Outcome:
        """The view as it is, where it is good; else what recovery finds. The state is what the view belongs to."""
        if seen.blank:
            return self._blank(state, seen), None
        work = seen.work
        if view is None:
            found = self._rejoin(state, work, prior) if self.graph.held else None
            return found or (self.keyframes.start(state, work, prior, "first view"), None)
        if status_in(self.graph) is Status.RELOCALISING:  # a young submap first looks for the map that was lost
            found = self._rejoin(state, work, prior)
            if found is not None:
                return found
        if self.two_view.accepted(view):
            thin = matched_share(view.anchor, view.weight) < THIN
            return self._from_nearer(state, work, prior, view) if thin else (state, view)
        state, found_again = self._retry(state, work, prior)
        if found_again is not None:
            return state, found_again
        return self._start_again(state, work, prior), None

    def _from_nearer(self, state: TrackingState, work: WorkFrame, prior: Future[Array], view: TwoView) -> Outcome:
        """Few matches are left: the last good frame becomes a keyframe, so that the chain has no weak link."""
        if not self.graph.initialised or view.motion_ratio < LEAST_MOTION_RATIO:
            return state, view
        nearer, near = self._from_last(state, work, prior)
        if near is not None and near.weight.sum() > view.weight.sum():
            return nearer, near
        return replace(nearer, anchor=state.anchor, most_matched=state.most_matched), view

    def _from_last(self, state: TrackingState, work: WorkFrame, prior: Future[Array]) -> Outcome:
        """The last good frame becomes a keyframe, which is followed from here on; the frame seen from it, if it is."""
        last = state.last
        if last is None or state.flow is None or self.graph.records[-1].state != "tracked":
            return state, None
        state = self.keyframes.promote_last(state)
        assert state.anchor is not None
        near = self.two_view.estimate(state.anchor, work, prior, Start(), np.eye(4))
        return state, near if self.two_view.accepted(near) else None

    def _rejoin(
        self, state: TrackingState, work: WorkFrame, prior: Future[Array]
    ) -> tuple[TrackingState, TwoView] | None:
        """Back into a submap that has structure, out of one that has none yet: the latter is given up."""
        graph, entry = self.graph, self.keyframes.entry
        view = entry.view(work, prior)
        if view is not None:
            graph.found_in_map(work.index)
            log.info("frame %d found in the saved map, from keyframe %d", work.index, view.anchor.id)
        else:
            view = self._relocalised(self._known_to(state, work), work, prior)
        if view is None:
            return None
        graph.drop_submap()
        graph.submap = graph.submap_of[view.anchor.id]
        self.keyframes.edges.flows.clear()
        return replace(state, anchor=view.anchor, most_matched=0), view

    def _known_to(self, state: TrackingState, work: WorkFrame) -> list[Keyframe]:
        """Keyframes that have structure and may show a frame's place; where the video was lost comes first."""
        graph, before = self.graph, state.anchor_before_loss
        ids = self.keyframes.entry.open_to([kf.id for kf in graph.keyframes if graph.submap_of[kf.id] in graph.started])
        places = candidates(self.parts.places, self.parts, graph, work, ids)
        return places if before is None else [before, *(kf for kf in places if kf.id != before.id)]

    def _retry(self, state: TrackingState, work: WorkFrame, prior: Future[Array]) -> Outcome:
        """The keyframe cannot be followed: first make the last good frame a keyframe, then look for features."""
        state, near = self._from_last(state, work, prior)
        anchor, graph = state.anchor, self.graph
        assert anchor is not None
        if near is not None:
            return state, near
        places = candidates(self.parts.places, self.parts, graph, work, graph.members())
        return state, self._relocalised([anchor, *(p for p in places if p.id != anchor.id)], work, prior)

    def _relocalised(self, candidates: list[Keyframe], work: WorkFrame, prior: Future[Array]) -> TwoView | None:
        """The frame seen from the first of these keyframes that sees it."""
        for kf in candidates:
            view = self.two_view.relocalised(kf, work, prior)
            if view is not None and believed(self.two_view, work, view, prior):
                log.info("frame %d found again from keyframe %d", work.index, kf.id)
                return view
        return None

    def _start_again(self, state: TrackingState, work: WorkFrame, prior: Future[Array]) -> TrackingState:
        """The camera is lost: what follows is a submap of its own until it is recognised."""
        self.keyframes.settle()
        graph = self.graph
        reason = "the view before it cannot be followed into it, and no keyframe looks like it"
        log.info("frame %d lost: %s", work.index, reason)
        if graph.initialised:
            state = replace(state, anchor_before_loss=state.anchor)
        else:
            graph.drop_submap()
        self.keyframes.edges.flows.clear()
        graph.start_submap()
        return self.keyframes.start(state, work, prior, reason)

    def _blank(self, state: TrackingState, seen: Observation) -> TrackingState:
        """Nothing can be seen: the frame has no place, and the next one is looked for where the last one was."""
        anchor = 0 if state.anchor is None else state.anchor.id
        self.graph.record(seen.work, anchor, state.cam_from_anchor, "lost", None, np.zeros(0))
        log.warning("frame %d lost: the image is blank", seen.work.index)
        return replace(state, status=Status.LOST, reason="the image is blank", flow=None, last=None)
