"""After the last frame: places seen again, by place recognition where the map has drifted, by their poses elsewhere."""

from __future__ import annotations

import logging
from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..concurrency import Future
from ..dynamics.soft_mask import static_at
from ..geometry.se3 import inverse, so3_log
from ..geometry.sim3 import Sim3
from ..graph.covisibility import overlaps
from ..graph.keyframe_graph import Keyframe, KeyframeGraph
from ..graph.place_recognition import PlaceRecognition
from ..graph.pose_graph import Loop, optimise_pose_graph
from ..graph.submaps import with_scale
from ..types import USABLE_WEIGHT
from .places import most_alike, not_unlike
from .two_view import TwoView, TwoViewEstimator

Array = NDArray[Any]
log = logging.getLogger(__name__)
MIN_SIMILARITY = 0.55  # of two descriptors, for a pair to be looked at
APART = 3  # keyframes between two of one place, below: they are neighbours
MIN_MATCHES, MIN_INLIERS = 100, 0.4  # both ways, for a loop to be accepted
MAX_TURN, MAX_LOG_SCALE = 0.4, 0.3  # by which there and back may differ: rad, log
MAX_DRIFT = 0.6  # rad by which a loop may turn what was tracked: more is two places that look alike
SEEN_TOGETHER = 0.5  # rad between two views that may see the same
LONG_BEFORE = 8  # keyframes; those nearer are matched as neighbours
COVISIBLE_OVERLAP, COVISIBLE_MOTION = 0.25, 0.6  # share in view, and image motion / width, of a pair matched at the end
COVISIBLE_PAIRS = 4  # of those for each keyframe, at most


def close_loops(two_view: TwoViewEstimator, graph: KeyframeGraph, places: PlaceRecognition) -> list[Loop]:
    """Keyframes of the submap being tracked that look alike, far apart in time: verified both ways, and closed.

    Each becomes an edge, the drift between its ends is spread over the chain, and everything is optimised.
    """
    found: list[Loop] = []
    ids, joined = graph.members(), graph.connected_pairs()
    for j in ids:
        kf = graph.keyframes[j]
        far = [i for i in ids if i < j - APART and frozenset((i, j)) not in joined and not _known(found, i, j)]
        small = not_unlike(two_view.parts, kf.work, places.best(graph, kf.work, far, 2, MIN_SIMILARITY))
        for other in [*small, *_alike(two_view, graph, j, far)]:
            there = two_view.relocalised(other, kf.work, Future.done(kf.moving / 255.0))
            back = two_view.relocalised(kf, other.work, Future.done(other.moving / 255.0)) if _strong(there) else None
            loop = _loop(two_view, other.id, j, there, back)
            if loop is None or there is None or back is None:
                continue
            log.info("keyframes %d and %d are one place, scale %.3f", other.id, j, 1 / loop.j_from_i.scale)
            graph.connect(other.id, j, there.pair.matches, static_at(kf.moving / 255.0, there.pair.matches.new_px))
            graph.connect(j, other.id, back.pair.matches, static_at(other.moving / 255.0, back.pair.matches.new_px))
            found.append(loop)
            break
    if found:
        optimise_pose_graph(graph, found)
        graph.solve_all(10, 2.0)
    return found


def _alike(two_view: TwoViewEstimator, graph: KeyframeGraph, j: int, far: list[int]) -> list[Keyframe]:
    """The keyframe that shares most features with j, long before it, where the tracked poses let both see one thing."""
    view = graph.variables[j].cam_from_world[:3, :3]
    turns = {i: np.linalg.norm(so3_log(view @ graph.variables[i].cam_from_world[:3, :3].T)) for i in far}
    ids = [i for i in far if i < j - LONG_BEFORE and turns[i] < MAX_DRIFT + SEEN_TOGETHER]
    return most_alike(two_view.parts, graph, graph.keyframes[j].work, ids)


def _known(found: list[Loop], i: int, j: int) -> bool:
    """Keyframes next to the ends of a loop are matched later, by their poses."""
    return any(abs(i - x.i) <= APART and abs(j - x.j) <= APART for x in found)


def _strong(view: TwoView | None) -> bool:
    if view is None or (view.weight > USABLE_WEIGHT).sum() < MIN_MATCHES:
        return False
    return view.alignment.inlier_ratio >= MIN_INLIERS


def _loop(two_view: TwoViewEstimator, i: int, j: int, there: TwoView | None, back: TwoView | None) -> Loop | None:
    """What j seen from i and i seen from j agree on; None where they do not."""
    graph = two_view.graph
    if there is None or back is None or not (_strong(there) and _strong(back)):
        return None
    j_from_i = with_scale(graph, i, j, there.alignment.new_from_ref, there.pair.matches, there.weight)
    i_from_j = with_scale(graph, j, i, back.alignment.new_from_ref, back.pair.matches, back.weight)
    if j_from_i is None or i_from_j is None or abs(np.log(j_from_i.scale * i_from_j.scale)) > MAX_LOG_SCALE:
        return None
    better = there if there.alignment.inlier_ratio >= back.alignment.inlier_ratio else back
    turn = np.linalg.norm(so3_log(i_from_j.rotation @ j_from_i.rotation))
    new = graph.keyframes[j if better is there else i]  # depths of one end may be poor where drift began
    if turn > MAX_TURN or not two_view.beyond_doubt(better, new.work, Future.done(new.moving / 255.0)):
        return None
    tracked = graph.variables[j].cam_from_world[:3, :3] @ graph.variables[i].cam_from_world[:3, :3].T
    drift = float(np.linalg.norm(so3_log(j_from_i.rotation @ tracked.T)))
    if drift > MAX_DRIFT:
        log.info("keyframes %d and %d look alike, but %.0f deg of drift speak against it", i, j, np.degrees(drift))
        return None
    scale = float(np.sqrt(j_from_i.scale / i_from_j.scale))
    if better is back:
        j_from_i = Sim3.from_rigid(inverse(back.alignment.new_from_ref), scale)
    else:
        j_from_i = Sim3.from_rigid(there.alignment.new_from_ref).in_lengths(scale)
    return Loop(i, j, j_from_i, float(better.weight.sum()))


def add_covisible_pairs(graph: KeyframeGraph, connect: Callable[[list[tuple[int, int]]], int]) -> int:
    """Match all pairs of keyframes that should see the same by their poses and were not matched before; how many.

    While tracking a keyframe is matched with its neighbours only. What sees the same from far apart in time holds
    the chain together across them. At most ``COVISIBLE_PAIRS`` a keyframe, those that share most first.
    """
    ids = graph.members()
    done = graph.connected_pairs()
    pairs = []
    poses = np.stack([graph.variables[k].cam_from_world for k in ids])
    shared = {i: overlaps(graph, i, poses) for i in ids}
    for a, i in enumerate(ids):
        for b, j in enumerate(ids[:a]):
            share = min(shared[i][0][b], shared[j][0][a])
            motion = max(shared[i][1][b], shared[j][1][a])
            if share >= COVISIBLE_OVERLAP and motion <= COVISIBLE_MOTION and frozenset((i, j)) not in done:
                pairs.append((-share, j, i))
    made = connect([(i, j) for _, i, j in sorted(pairs)[: COVISIBLE_PAIRS * len(ids)]])
    log.info("%d of %d pairs that may see the same were matched", made, len(pairs))
    return made
