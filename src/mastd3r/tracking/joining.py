"""A submap that sees a place of another one becomes a part of it."""

from __future__ import annotations

import logging
from collections.abc import Iterator

from ..concurrency import Future
from ..graph.keyframe_graph import Keyframe, KeyframeGraph
from ..graph.place_recognition import PlaceRecognition
from ..graph.submaps import join, with_scale
from .covisibility import CovisibilityEdges
from .map_entry import MapEntry
from .places import candidates
from .two_view import TwoView, TwoViewEstimator

log = logging.getLogger(__name__)
LEAST_UNSCALED = 2  # views beyond doubt, for a submap to be given up
MATCHED_AROUND = 2  # keyframes on either side of the recognised one that are matched as well


def join_recognised(
    graph: KeyframeGraph,
    kf: Keyframe,
    two_view: TwoViewEstimator,
    edges: CovisibilityEdges,
    places: PlaceRecognition,
    entry: MapEntry,
    unscaled: list[TwoView],
) -> bool:
    """Recognise a place of another submap in ``kf``; the two become one. The other submap's world is kept.

    ``unscaled`` takes the views of such places whose scale is not known: too few points have a depth on both sides.
    """
    own = graph.submap_of[kf.id]
    for view in _seen_elsewhere(graph, kf, two_view, places, entry):
        other, pose = view.anchor, view.alignment.new_from_ref
        kf_from_other = with_scale(graph, other.id, kf.id, pose, view.pair.matches, view.weight)
        if kf_from_other is None:
            unscaled.append(view)
            continue
        scale = 1 / kf_from_other.scale
        log.info("submap %d joined at keyframes %d and %d, scale %.3f", own, other.id, kf.id, scale)
        join(graph, other.id, kf.id, kf_from_other)
        around = range(max(0, other.id - MATCHED_AROUND), min(len(graph.keyframes), other.id + MATCHED_AROUND + 1))
        for k in around:
            if k != kf.id and graph.submap_of[k] == graph.submap_of[kf.id]:
                edges.add(graph, k, kf.id)
        graph.solve_all(10, 2.0)
        return True
    return False


def give_up_unscaled(graph: KeyframeGraph, submap: int, unscaled: list[TwoView]) -> bool:
    """Drop a submap that could not be joined though larger ones see it: its frames are looked for in those.

    A piece whose scale is not known has depths of no use, and would be placed by continuity alone. A saved map has no
    say: where the video is not found in it, its own pieces are all that there is.
    """
    count = len(graph.members(submap))
    own = [v for v in unscaled if v.anchor.id >= graph.held]
    larger = [v for v in own if len(graph.members(graph.submap_of[v.anchor.id])) > count]
    if len(larger) < LEAST_UNSCALED:
        return False
    log.info("submap %d of %d keyframes is seen by others, but has no scale: its frames are lost", submap, count)
    graph.drop_submap(submap)
    return True


def _seen_elsewhere(
    graph: KeyframeGraph, kf: Keyframe, two_view: TwoViewEstimator, places: PlaceRecognition, entry: MapEntry
) -> Iterator[TwoView]:
    """A keyframe as others see it, of a saved map and of other submaps, beyond doubt."""
    moving = Future.done(kf.moving / 255.0)
    in_map = entry.view(kf.work, moving)
    if in_map is not None:
        yield in_map
    own = graph.submap_of[kf.id]
    others = entry.open_to([k.id for k in graph.keyframes if graph.submap_of[k.id] in graph.started - {own}])
    for other in candidates(places, two_view.parts, graph, kf.work, others):
        view = two_view.relocalised(other, kf.work, moving)
        if view is not None and two_view.beyond_doubt(view, kf.work, moving):
            yield view
