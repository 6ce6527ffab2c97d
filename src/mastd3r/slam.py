"""The main loop: one frame in, one report out."""

from __future__ import annotations

import logging
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from .alignment.align import align
from .alignment.reproject import StaticMatches
from .alignment.result import Alignment
from .config import Config
from .dynamics.belief import DynamicBelief
from .geometry.se3 import inverse
from .graph.bootstrap import bootstrap
from .graph.keyframe_graph import Keyframe, KeyframeGraph, lens_for
from .graph.places import covisible
from .parts import Parts
from .sources.checks import frame_is_blank
from .types import Frame, Guess, Matches, PairPrediction, State, WorkFrame
from .view_depth import (
    chained_flow,
    dynamics_input,
    grown,
    invert_flow,
    own_depth_prior,
    predicted_depth,
    rigid_flow,
    static_at,
)

Array = NDArray[Any]
log = logging.getLogger(__name__)


@dataclass(frozen=True)
class TwoView:
    """One pair, compared: what the provider said, the static weight of its matches, and the pose."""

    pair: PairPrediction
    weight: Array  # (p,) static weight of each match
    alignment: Alignment
    motion_ratio: float  # upper quartile of the image motion / sqrt(width * height)
    matched: int  # weighted matches


@dataclass(frozen=True)
class StepReport:
    """What happened to one frame."""

    index: int
    timestamp_s: float
    state: State
    kf_id: int
    is_keyframe: bool
    why: str


class Slam:
    """Tracking and mapping of one source. Each line of ``step`` is one stage of the paper."""

    def __init__(self, config: Config, parts: Parts, full_size: tuple[int, int]) -> None:
        self.config, self.parts = config, parts
        width, height = parts.size
        self.graph = KeyframeGraph(config.graph, config.camera, lens_for(config.camera, width, height, full_size))
        self.graph.size = parts.size  # a run without a single keyframe still has a lens
        self.belief = DynamicBelief(config.dynamics, width, height)
        self._chain: dict[tuple[int, int], Array] = {}  # flows between keyframes, before there are poses
        self._flow: Array | None = None  # latest keyframe -> last frame
        self._last: tuple[WorkFrame, Array] | None = None  # last tracked frame and its P(moving)
        self._cam_from_kf = np.eye(4)  # of the last tracked frame
        self._most_matched = 0  # by any frame since the latest keyframe

    def step(self, frame: Frame) -> StepReport:
        """Track one frame (III-A, III-B); keyframes extend the graph."""
        work = self.parts.provider.observe(frame)
        if frame_is_blank(frame.image):
            return self._lost(work, "the image is blank")
        prior = grown(self.belief.prior(work.gray, work.semantic))  # III-A, prior of (2)
        if not self.graph.keyframes:
            return self._start(work, prior)
        kf, view = (
            self.graph.latest,
            self._compare(self.graph.latest, work, prior, self._flow, self._cam_from_kf),
        )
        if not self._believed(view):
            kf, view = self._retry(work, prior)
        if not self._believed(view):
            count = int((view.weight > 0.05).sum())
            return self._lost(
                work, f"{count} static matches, {view.alignment.inlier_ratio:.0%} of them agree on a pose"
            )
        moving = self._update_belief(work, kf, view, prior)  # III-A, (2)(3)
        self.graph.record(work, kf.id, view.alignment.new_from_ref, "tracked", view.pair.matches, view.weight)
        self._flow, self._cam_from_kf = view.pair.flow, view.alignment.new_from_ref
        self._last = (work, moving)
        if self._wants_keyframe(view):
            kf = self._add_keyframe(work, moving, view)  # graph, joint optimisation
        return StepReport(work.index, work.timestamp_s, "tracked", kf.id, self._flow is None, "")

    def _compare(self, ref: Keyframe, new: WorkFrame, prior: Array, flow: Array | None, guess: Array) -> TwoView:
        """Predict, mask and align one pair. Tracking, loops and recovery all come here."""
        graph, started = self.graph, self.graph.initialised
        block = graph.blocks[ref.id]
        pair = self.parts.provider.predict(  # III-A: both pointmaps, in ref's camera
            ref.work,
            new,
            Guess(
                graph.camera(),
                block.inv_depth if started else None,
                graph.depth_info(ref.id) if started else None,
                guess if started else None,
                flow,
            ),
        )
        weight = pair.matches.weight * ref.static * static_at(prior, pair.matches.new_px)  # (5)(6), softly
        matches = StaticMatches(
            block.px, block.inv_depth, graph.depth_info(ref.id), pair.matches.new_px, weight, graph.lens.g
        )
        if started:
            alignment = align(  # III-B (7)-(12)
                pair,
                matches,
                guess,
                self.config.correction,
                self.config.alignment,
                self.parts.provider.depth_sigma_ratio,
            )
        else:
            alignment = Alignment(guess, 1.0, True, 0, 1.0, 0.0, np.zeros((6, 6)), ("flow only",))
        return TwoView(pair, weight, alignment, *_motion(pair.matches, weight, self.parts.size))

    def _believed(self, view: TwoView) -> bool:
        enough = (view.weight > 0.05).sum() >= self.config.alignment.min_matches
        return bool(enough) and view.alignment.inlier_ratio >= self.config.tracking.min_inlier_ratio

    def _retry(self, work: WorkFrame, prior: Array) -> tuple[Keyframe, TwoView]:
        """The keyframe cannot be followed: first make the last good frame a keyframe, then look for features."""
        last = self._last
        if last is not None and self._flow is not None and self.graph.records[-1].state == "tracked":
            kf = self._promote_last(*last)
            near = self._compare(kf, work, prior, None, np.eye(4))
            if self._believed(near):
                return kf, near
        latest = self.graph.latest
        candidates = [latest, *self.parts.places.best(self.graph, work.gray, skip=latest.id)]
        view: TwoView | None = None
        for kf in candidates:
            start = self.parts.features.flow(kf.work.gray, work.gray)
            if start is None and view is not None:
                continue
            view = self._compare(kf, work, prior, start, np.eye(4))
            if self._believed(view):
                log.info("frame %d found again from keyframe %d", work.index, kf.id)
                return kf, view
        assert view is not None
        return latest, view

    def close(self) -> None:
        """After the last frame: make it a keyframe where it has moved on, so that what it alone sees is kept."""
        if self._last is None or self._flow is None or not self.graph.initialised:
            return
        work, moving = self._last
        view = self._compare(self.graph.latest, work, moving, self._flow, self._cam_from_kf)
        if self._believed(view) and view.motion_ratio > 0.3 * self.config.tracking.keyframe_motion_ratio:
            self._add_keyframe(work, moving, view)

    # -- keyframes -------------------------------------------------------------------------------------------

    def _start(self, work: WorkFrame, prior: Array) -> StepReport:
        inv_depth, info = own_depth_prior(work, 1.0, self.parts.provider.depth_sigma_ratio)
        kf = self.graph.add_keyframe(work, static_at(prior, work.px), prior, np.eye(4), inv_depth, info)
        self.graph.record(work, kf.id, np.eye(4), "started", None, np.zeros(0))
        self.graph.replace_last_by_keyframe(kf)
        self.graph.initialised = self.parts.provider.depth_sigma_ratio is not None and bool((info > 1).mean() > 0.1)
        self._flow, self._cam_from_kf, self._last = None, np.eye(4), (work, prior)
        return StepReport(work.index, work.timestamp_s, "started", kf.id, True, "first view")

    def _wants_keyframe(self, view: TwoView) -> bool:
        t = self.config.tracking
        self._most_matched = max(self._most_matched, view.matched)
        thin = view.matched < t.keyframe_overlap_ratio * self._most_matched
        enough = t.keyframe_motion_ratio if self.graph.initialised else t.first_motion_ratio
        # something that passes in front thins the matches too, but from the same place nothing is gained
        return view.motion_ratio > enough or (thin and view.motion_ratio > 0.4 * enough)

    def _promote_last(self, work: WorkFrame, moving: Array) -> Keyframe:
        prior_view = self._compare(self.graph.latest, work, moving, self._flow, self._cam_from_kf)
        return self._add_keyframe(work, moving, prior_view)

    def _add_keyframe(self, work: WorkFrame, moving: Array, view: TwoView) -> Keyframe:
        """The frame recorded last becomes a keyframe, matched with those before it, and the window is optimised."""
        graph, before = self.graph, self.graph.latest
        cam_from_world = view.alignment.new_from_ref @ graph.blocks[before.id].cam_from_world
        inv_depth, info = predicted_depth(
            graph,
            before.id,
            cam_from_world,
            work,
            view.alignment.scale,
            self.parts.provider.depth_sigma_ratio,
        )
        kf = graph.add_keyframe(work, static_at(moving, work.px), moving, cam_from_world, inv_depth, info)
        graph.replace_last_by_keyframe(kf)
        graph.connect(before.id, kf.id, view.pair.matches, static_at(moving, view.pair.matches.new_px))
        self._chain[before.id, kf.id] = view.pair.flow
        self._connect(kf.id, before.id, invert_flow(view.pair.flow, self.parts.grid_px))
        for k in range(before.id - 1, max(-1, kf.id - 1 - self.config.graph.neighbours), -1):
            self._connect_both(k, kf.id)
        if not graph.initialised:
            if len(graph.keyframes) >= self.config.graph.bootstrap_keyframes:
                bootstrap(graph)
                self._chain.clear()
        else:
            older = covisible(
                graph,
                kf.id,
                kf.id - self.config.graph.neighbours,
                self.config.graph.covisible,
                self.config.graph.loop_overlap_ratio,
            )
            for k in older:
                self._connect_both(k, kf.id)
            graph.solve_window()
            if len(graph.keyframes) in (10, 16, 24, 40, 64, 100, 160, 256):
                graph.solve_all(6, 1.0)
        self._flow, self._cam_from_kf, self._most_matched = None, np.eye(4), 0
        self._last = (work, moving)
        return kf

    def _connect_both(self, i: int, j: int) -> None:
        grid_px = self.parts.grid_px
        if self.graph.initialised:
            start, back = rigid_flow(self.graph, i, j), rigid_flow(self.graph, j, i)
        elif (i, j - 1) in self._chain and (j - 1, j) in self._chain:
            start = chained_flow(self._chain[i, j - 1], self._chain[j - 1, j], grid_px)
            back = invert_flow(start, grid_px)
        else:
            return
        if self._connect(i, j, start):
            self._connect(j, i, back)

    def _connect(self, i: int, j: int, flow: Array) -> bool:
        ref, new = self.graph.keyframes[i], self.graph.keyframes[j]
        guess = Guess(self.graph.camera(), flow=flow, flow_is_near=self.graph.initialised)
        pair = self.parts.provider.predict(ref.work, new.work, guess)
        if not self.graph.initialised:
            self._chain[i, j] = pair.flow
        return self.graph.connect(i, j, pair.matches, static_at(new.moving / 255.0, pair.matches.new_px))

    def _update_belief(self, work: WorkFrame, kf: Keyframe, view: TwoView, prior: Array) -> Array:
        if not self.graph.initialised:
            return prior
        cam_from_world = view.alignment.new_from_ref @ self.graph.blocks[kf.id].cam_from_world
        given = dynamics_input(self.graph, kf.id, inverse(cam_from_world), work, view.alignment.scale)
        return grown(self.belief.update(given).probability)

    def _lost(self, work: WorkFrame, why: str) -> StepReport:
        if self.graph.keyframes and not self.graph.initialised:
            self.graph.clear()
        latest = self.graph.latest.id if self.graph.keyframes else 0
        self.graph.record(work, latest, self._cam_from_kf, "lost", None, np.zeros(0))
        self._flow, self._last = None, None
        log.warning("frame %d lost: %s", work.index, why)
        return StepReport(work.index, work.timestamp_s, "lost", latest, False, why)


def _motion(matches: Matches, weight: Array, size: tuple[int, int]) -> tuple[float, int]:
    used = weight > 0.05
    if used.sum() < 10:
        return float("inf"), 0
    moved = np.linalg.norm(matches.new_px - matches.ref_px, axis=1)[used]
    return float(np.quantile(moved, 0.75)) / float(np.sqrt(size[0] * size[1])), int(used.sum())
