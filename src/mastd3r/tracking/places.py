"""Which keyframes may show the place of a frame, by the sparse features that they share."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from ..geometry.se3 import so3_log
from ..graph.keyframe_graph import Keyframe, KeyframeGraph
from ..graph.place_recognition import PlaceRecognition
from ..parts import Parts
from ..types import WorkFrame
from .two_view import TwoView

MOST_COMPARED = 200  # keyframes, spread over all that there are
UNLIKE = 0.04
MIN_ALIKE = 0.08  # share of features that two views have in common, to be looked at
TURN_AT_ONCE, TURN_A_FRAME = 0.5, 0.1  # rad that a camera may turn while it is lost, and more with every frame


def most_alike(
    parts: Parts, graph: KeyframeGraph, work: WorkFrame, among: Sequence[int], count: int = 1
) -> list[Keyframe]:
    """Up to ``count`` keyframes of ``among`` that share most features with a frame, best first.

    Beside place recognition, whose small pictures change with where one stands; nothing is believed before it is
    verified. None where the features have no opinion.
    """
    if not among:
        return []
    ids = list(among)[:: 1 + len(among) // MOST_COMPARED]
    share = parts.features.alike(work.gray, [graph.keyframes[k].work.gray for k in ids])
    first = np.argsort(-np.nan_to_num(share), kind="stable")[:count]
    return [graph.keyframes[ids[n]] for n in first if share[n] >= MIN_ALIKE]


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
    tracked = [r for r in graph.records if r.state in ("tracked", "started") and r.index != index]
    tracked = [r for r in tracked if graph.submap_of[r.kf_id] == submap]
    if not tracked:
        return False
    near = min(tracked, key=lambda r: abs(r.index - index))
    found = view.alignment.new_from_ref @ graph.variables[view.anchor.id].cam_from_world
    before = near.cam_from_kf @ graph.variables[near.kf_id].cam_from_world
    turn = float(np.linalg.norm(so3_log(found[:3, :3] @ before[:3, :3].T)))
    return turn <= TURN_AT_ONCE + TURN_A_FRAME * abs(near.index - index)


def not_unlike(parts: Parts, work: WorkFrame, candidates: Sequence[Keyframe]) -> list[Keyframe]:
    """Without those that share next to no feature with a frame: to look at each closely costs a hundred times more."""
    if not candidates:
        return []
    share = parts.features.alike(work.gray, [kf.work.gray for kf in candidates])
    return [kf for kf, s in zip(candidates, share, strict=True) if not s < UNLIKE]
