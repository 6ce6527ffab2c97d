"""After the last frame: places seen again, by place recognition where the map has drifted, by their poses elsewhere."""

from __future__ import annotations

import logging
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..concurrency import Future
from ..dynamics.soft_mask import static_at
from ..geometry.se3 import inverse, so3_log
from ..geometry.sim3 import Sim3
from ..graph.covisibility import overlaps
from ..graph.keyframe_graph import Keyframe, KeyframeGraph
from ..graph.passages import doubtful_passages, retake_passages
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
VOTES = 3  # keyframes at either end of loops that agree, for such a turn to be believed
NEAR_ENDS, SAME_TURN = 8, 0.15  # keyframes, and rad, within which loops agree
SEEN_TOGETHER = 0.5  # rad between two views that may see the same
LONG_BEFORE = 8  # keyframes; those nearer are matched as neighbours
COVISIBLE_OVERLAP, COVISIBLE_MOTION = 0.25, 0.6  # share in view, and image motion / width, of a pair matched at the end
COVISIBLE_PAIRS = 4  # of those for each keyframe, at most


@dataclass(frozen=True)
class _Seen:
    """A loop, verified both ways, and the views that say so."""

    loop: Loop
    there: TwoView
    back: TwoView
    drift: float  # rad by which it would turn what was tracked


def close_loops(two_view: TwoViewEstimator, graph: KeyframeGraph, places: PlaceRecognition) -> list[Loop]:
    """Keyframes of the submap being tracked that look alike, far apart in time: verified both ways, and closed.

    Each becomes an edge, the drift between its ends is spread over the chain, and everything is optimised. One that
    would turn more than ``MAX_DRIFT`` is believed only across a passage that is badly explained, and only together
    with others that say the same: two places may look alike.
    """
    found, doubted = list[_Seen](), list[_Seen]()
    ids, joined = graph.members(), graph.connected_pairs()
    for j in ids:
        kf = graph.keyframes[j]
        far = [i for i in ids if i < j - APART and frozenset((i, j)) not in joined and not _known(found, i, j)]
        small = not_unlike(two_view.parts, kf.work, places.best(graph, kf.work, far, 2, MIN_SIMILARITY))
        for other in [*small, *_alike(two_view, graph, j, far)]:
            there = two_view.relocalised(other, kf.work, Future.done(kf.moving / 255.0))
            back = two_view.relocalised(kf, other.work, Future.done(other.moving / 255.0)) if _strong(there) else None
            seen = _loop(two_view, other.id, j, there, back)
            if seen is not None and seen.drift <= MAX_DRIFT:
                found.append(seen)
                break
            if seen is not None:
                doubted.append(seen)
    voted = _voted_for(graph, doubted)
    found += voted
    for seen in found:
        _connect(graph, seen)
    loops = [seen.loop for seen in found]
    if loops:
        optimise_pose_graph(graph, loops)
        graph.solve_all(10, 2.0)
    if voted:  # the ends of what was badly explained have moved far
        retake_passages(graph)
    return loops


def _connect(graph: KeyframeGraph, seen: _Seen) -> None:
    i, j, there, back = seen.loop.i, seen.loop.j, seen.there.pair.matches, seen.back.pair.matches
    _say(
        graph,
        seen.loop,
        f"one place, scale {1 / seen.loop.j_from_i.scale:.3f}, {np.degrees(seen.drift):.0f} deg of drift",
    )
    graph.connect(i, j, there, static_at(graph.keyframes[j].moving / 255.0, there.new_px))
    graph.connect(j, i, back, static_at(graph.keyframes[i].moving / 255.0, back.new_px))


def _voted_for(graph: KeyframeGraph, doubted: list[_Seen]) -> list[_Seen]:
    """Of loops that would turn much, those that agree with most others, if a badly explained passage lies between."""
    passages = doubtful_passages(graph) if len(doubted) >= VOTES else []
    across = [s for s in doubted if any(s.loop.i <= p[-1] and p[0] <= s.loop.j for p in passages)]
    best: list[_Seen] = []
    for one in across:
        agree = [other for other in across if _say_the_same(graph, one.loop, other.loop)]
        best = max(best, agree, key=len)
    ends = {s.loop.i for s in best}, {s.loop.j for s in best}
    believed = best if min(map(len, ends)) >= VOTES else []
    for s in doubted:
        if s not in believed:
            _say(graph, s.loop, f"not believed: {np.degrees(s.drift):.0f} deg of drift speak against it")
    return believed


def _say(graph: KeyframeGraph, loop: Loop, verdict: str) -> None:
    frames = graph.keyframes[loop.i].work.index, graph.keyframes[loop.j].work.index
    graph.loops.append((*frames, verdict))
    log.info("keyframes %d and %d, frames %d and %d: %s", loop.i, loop.j, *frames, verdict)


def _say_the_same(graph: KeyframeGraph, a: Loop, b: Loop) -> bool:
    """Whether two loops turn the map alike, by the rotations tracked between their near ends."""
    if max(abs(a.i - b.i), abs(a.j - b.j)) > NEAR_ENDS:
        return False
    turn = {k: graph.variables[k].cam_from_world[:3, :3] for k in (a.i, a.j, b.i, b.j)}
    by_a = (turn[b.j] @ turn[a.j].T) @ a.j_from_i.rotation @ (turn[a.i] @ turn[b.i].T)
    return float(np.linalg.norm(so3_log(by_a @ b.j_from_i.rotation.T))) <= SAME_TURN


def _alike(two_view: TwoViewEstimator, graph: KeyframeGraph, j: int, far: list[int]) -> list[Keyframe]:
    """The keyframe that shares most features with j, long before it, where the tracked poses let both see one thing."""
    view = graph.variables[j].cam_from_world[:3, :3]
    turns = {i: np.linalg.norm(so3_log(view @ graph.variables[i].cam_from_world[:3, :3].T)) for i in far}
    ids = [i for i in far if i < j - LONG_BEFORE and turns[i] < MAX_DRIFT + SEEN_TOGETHER]
    return most_alike(two_view.parts, graph, graph.keyframes[j].work, ids)


def _known(found: list[_Seen], i: int, j: int) -> bool:
    """Keyframes next to the ends of a loop are matched later, by their poses."""
    return any(abs(i - s.loop.i) <= APART and abs(j - s.loop.j) <= APART for s in found)


def _strong(view: TwoView | None) -> bool:
    if view is None or (view.weight > USABLE_WEIGHT).sum() < MIN_MATCHES:
        return False
    return view.alignment.inlier_ratio >= MIN_INLIERS


def _loop(two_view: TwoViewEstimator, i: int, j: int, there: TwoView | None, back: TwoView | None) -> _Seen | None:
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
    scale = float(np.sqrt(j_from_i.scale / i_from_j.scale))
    if better is back:
        j_from_i = Sim3.from_rigid(inverse(back.alignment.new_from_ref), scale)
    else:
        j_from_i = Sim3.from_rigid(there.alignment.new_from_ref).in_lengths(scale)
    return _Seen(Loop(i, j, j_from_i, float(better.weight.sum())), there, back, drift)


def add_covisible_pairs(
    graph: KeyframeGraph, connect: Callable[[list[tuple[int, int]]], int], most: int = COVISIBLE_PAIRS
) -> int:
    """Match all pairs of keyframes that should see the same by their poses and were not matched before; how many.

    While tracking a keyframe is matched with its neighbours only. What sees the same from far apart in time holds
    the chain together across them. At most ``most`` a keyframe, those that share most first.
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
    made = connect([(i, j) for _, i, j in sorted(pairs)[: most * len(ids)]])
    log.info("%d of %d pairs that may see the same were matched", made, len(pairs))
    return made
