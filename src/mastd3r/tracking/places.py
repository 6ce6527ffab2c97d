"""Which keyframes may show the place of a frame, by the sparse features that they share."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..concurrency import Future
from ..geometry.se3 import inverse, so3_log
from ..graph.keyframe_graph import Keyframe, KeyframeGraph
from ..graph.place_recognition import PlaceRecognition
from ..parts import Parts
from ..types import MEASURED, WorkFrame
from .two_view import TwoView, TwoViewEstimator

Array = NDArray[Any]

MOST_COMPARED = 200  # keyframes, spread over all that there are
UNLIKE = 0.04
MIN_ALIKE = 0.08  # share of features that two views have in common, to be looked at
TURN_AT_ONCE, TURN_A_FRAME = 0.5, 0.1  # rad that a camera may turn while it is lost, and more with every frame
WITNESSES = (3, -3, 5, -5)  # keyframes from the one that sees a frame to those that are asked as well
SAME_TURN, SAME_SHIFT = 0.1, 0.15  # rad, and of the median depth, by which two that see one place may differ


def most_alike(
    parts: Parts, graph: KeyframeGraph, work: WorkFrame, among: Sequence[int], count: int = 1, least: float = MIN_ALIKE
) -> list[Keyframe]:
    """Up to ``count`` keyframes of ``among`` that share most features with a frame, ``least`` or more, best first.

    Beside place recognition, whose small pictures change with where one stands; nothing is believed before it is
    verified. None where the features have no opinion.
    """
    if not among:
        return []
    ids = list(among)[:: 1 + len(among) // MOST_COMPARED]
    share = parts.features.alike(work.gray, [graph.keyframes[k].work.gray for k in ids])
    first = np.argsort(-np.nan_to_num(share), kind="stable")[:count]
    return [graph.keyframes[ids[n]] for n in first if share[n] >= least]


def candidates(
    places: PlaceRecognition, parts: Parts, graph: KeyframeGraph, work: WorkFrame, among: Sequence[int]
) -> list[Keyframe]:
    """Keyframes of ``among`` that may show a frame's place, by small pictures, then by features."""
    found = places.best(graph, work, list(among))
    known = {kf.id for kf in found}
    return [*found, *(kf for kf in most_alike(parts, graph, work, among) if kf.id not in known)]


def plausible_turn(graph: KeyframeGraph, index: int, view: TwoView) -> bool:
    """Whether the camera may have turned so far from where it was in the frame tracked nearest in time to ``index``.

    False where no frame of that submap was tracked; True before there are poses, when nothing can be said.
    """
    submap = graph.submap_of[view.anchor.id]
    if submap not in graph.started:
        return True
    tracked = [r for r in graph.records if r.state in MEASURED and r.index != index]
    tracked = [r for r in tracked if graph.submap_of[r.kf_id] == submap]
    if not tracked:
        return False
    near = min(tracked, key=lambda r: abs(r.index - index))
    found = view.alignment.new_from_ref @ graph.variables[view.anchor.id].cam_from_world
    before = near.cam_from_kf @ graph.variables[near.kf_id].cam_from_world
    turn = float(np.linalg.norm(so3_log(found[:3, :3] @ before[:3, :3].T)))
    return turn <= TURN_AT_ONCE + TURN_A_FRAME * abs(near.index - index)


def believed(two_view: TwoViewEstimator, work: WorkFrame, view: TwoView, prior: Future[Array]) -> bool:
    """Whether a lost frame was found where the camera may be.

    A camera does not turn at will from one frame to the next. A view that says so must be beyond doubt, and a
    keyframe taken some time before or after must see the frame at the same place: from people, who look the same
    wherever they walk, it does not.
    """
    graph = two_view.graph
    if plausible_turn(graph, work.index, view):
        return True
    return two_view.beyond_doubt(view, work, prior) and confirmed(two_view, work, view, prior)


def confirmed(two_view: TwoViewEstimator, work: WorkFrame, view: TwoView, prior: Future[Array]) -> bool:
    """Whether the first of the ``WITNESSES`` that sees a frame puts it where ``view`` does; False where none does."""
    graph, anchor = two_view.graph, view.anchor.id
    found = view.alignment.new_from_ref @ graph.variables[anchor].cam_from_world
    depth = 1 / float(np.median(graph.variables[anchor].inv_depth))
    for step in WITNESSES:
        k = anchor + step
        if not 0 <= k < len(graph.keyframes) or graph.submap_of[k] != graph.submap_of[anchor]:
            continue
        other = two_view.relocalised(graph.keyframes[k], work, prior)
        if other is not None:
            between = other.alignment.new_from_ref @ graph.variables[k].cam_from_world @ inverse(found)
            turn, shift = np.linalg.norm(so3_log(between[:3, :3])), np.linalg.norm(between[:3, 3])
            return bool(turn <= SAME_TURN and shift <= SAME_SHIFT * depth)
    return False


def not_unlike(parts: Parts, work: WorkFrame, candidates: Sequence[Keyframe], least: float = UNLIKE) -> list[Keyframe]:
    """Without those that share next to no feature with a frame: to look at each closely costs a hundred times more."""
    if not candidates:
        return []
    share = parts.features.alike(work.gray, [kf.work.gray for kf in candidates])
    return [kf for kf, s in zip(candidates, share, strict=True) if not s < least]
