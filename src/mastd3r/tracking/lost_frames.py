"""After the last frame: every lost frame is looked for once more, from both sides in time and among all keyframes."""

from __future__ import annotations

import logging
from collections.abc import Collection, Iterator

import numpy as np

from ..concurrency import Future
from ..graph.keyframe_graph import FrameRecord, Keyframe, KeyframeGraph
from ..types import USABLE_WEIGHT, Frame, WorkFrame
from .observation import Observer
from .places import believed, most_alike
from .two_view import TwoView, TwoViewEstimator

log = logging.getLogger(__name__)
BESIDE = 2  # keyframes before a lost frame, and after it, that it is looked for from
ALIKE = 2  # and of those that share most features with it
MIN_MATCHES, MIN_INLIERS = 60, 0.5  # a frame that cannot be shown to be right stays lost: it is interpolated


def find_lost(
    frames: Iterator[Frame],
    graph: KeyframeGraph,
    observer: Observer,
    two_view: TwoViewEstimator,
    but: Collection[int] = (),
) -> int:
    """Place the lost frames that keyframes of a map see; ``frames`` are those of the source. How many were found.

    ``but``: indices of frames that are not looked for.

    While tracking a frame could be sought in what came before it alone.
    """
    lost = {r.index: r for r in graph.records if r.state == "lost" and r.index not in but}
    known = [kf for kf in graph.keyframes if graph.submap_of[kf.id] in graph.started]
    if not lost or not known:
        return 0
    found, last = 0, max(lost)
    for frame in _up_to(frames, last):
        record = lost.get(frame.index)
        seen = None if record is None else observer.observe(frame)
        if record is None or seen is None or seen.blank:
            continue
        view = _seen_from(_candidates(record, known, graph, two_view, seen.work), seen.work, two_view)
        if view is not None:
            graph.place(record, view.anchor.id, view.alignment.new_from_ref, view.pair.matches, view.weight)
            found += 1
    log.info("%d of %d lost frames were found after the last one", found, len(lost))
    return found


def _up_to(frames: Iterator[Frame], last: int) -> Iterator[Frame]:
    """Frames to the one of index ``last``: what comes after is not read again."""
    for frame in frames:
        yield frame
        if frame.index >= last:
            return


def _candidates(
    record: FrameRecord, known: list[Keyframe], graph: KeyframeGraph, two_view: TwoViewEstimator, work: WorkFrame
) -> list[Keyframe]:
    """Keyframes next to a frame in time, the nearest first, then those that look like it."""
    before = [kf for kf in known if kf.work.index < record.index][-BESIDE:]
    after = [kf for kf in known if kf.work.index > record.index][:BESIDE]
    near = sorted([*before, *after], key=lambda kf: abs(kf.work.index - record.index))
    beside = {kf.id for kf in near}
    others = [kf.id for kf in known if kf.id not in beside]
    return [*near, *most_alike(two_view.parts, graph, work, others, ALIKE)]


def _seen_from(candidates: list[Keyframe], work: WorkFrame, two_view: TwoViewEstimator) -> TwoView | None:
    """The frame from the first keyframe that sees it beyond doubt."""
    moving = np.zeros(work.gray.shape, np.float32) if work.semantic is None else work.semantic
    prior = Future.done(moving)
    for kf in candidates:
        view = two_view.relocalised(kf, work, prior)
        if view is None:
            continue
        enough = (view.weight > USABLE_WEIGHT).sum() >= MIN_MATCHES
        sure = enough and view.alignment.inlier_ratio >= MIN_INLIERS
        if sure and believed(two_view, work, view, prior):
            return view
    return None
