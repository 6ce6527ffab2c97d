"""After the last frame: places seen again, by place recognition where the map has drifted, by their poses elsewhere."""

from __future__ import annotations

import logging
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..concurrency import Future, give_back_memory
from ..dynamics.soft_mask import static_at
from ..geometry.se3 import inverse, so3_log
from ..geometry.sim3 import Sim3
from ..graph.covisibility import nearby, overlaps
from ..graph.keyframe_graph import Keyframe, KeyframeGraph
from ..graph.loose import loose_parts
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
MAX_GAP = 0.15  # of the way between its ends by which a loop may move one against the other, its scale apart
MOST_TRIED, PRIOR_GAP = 128, 0.3  # keyframes that are all tried, and that share of the way, above
OVERLAP_DEPTHS = 3.0  # typical depths within which two views may show one place
BROKEN = 2.0  # times the median passage's cost for its weight: there tracking may have lost its way altogether
VOTES = 3  # keyframes at either end of loops that agree, for more than that to be believed
NEAR_ENDS, SAME_TURN, SAME_GAP = 8, 0.15, 0.05  # keyframes, rad, and share of the way, within which loops agree
SAME_SHARE = 0.2  # of the drift that they ask for, where that is more: the chain between their ends is off as well
SEEN_TOGETHER = 0.5  # rad between two views that may see the same
LONG_BEFORE = 8  # keyframes; those nearer are matched as neighbours
COVISIBLE_OVERLAP, COVISIBLE_MOTION = 0.25, 0.6  # share in view, and image motion / width, of a pair matched at the end
COVISIBLE_PAIRS = 4  # of those for each keyframe, at most
MANY = 500  # keyframes: beside the system of so many, what places look like is forgotten until it is asked for again


@dataclass(frozen=True)
class _Seen:
    """A loop, verified both ways, and the views that say so."""

    loop: Loop
    there: TwoView
    back: TwoView
    drift: float  # rad by which it would turn what was tracked
    gap_ratio: float  # by which it would move one end against the other / way between them
    inv_depths: tuple[float, float]  # the median ones of its ends, in whose lengths the loop is

    def now(self, graph: KeyframeGraph) -> _Seen:
        """The same in the lengths that there are around its ends now, with what it asks for under these poses."""
        ends = self.loop.i, self.loop.j
        by_i, by_j = (was / graph.median_inv_depth(k) for was, k in zip(self.inv_depths, ends, strict=True))
        there = self.loop.j_from_i.in_lengths(by_j)
        loop = replace(self.loop, j_from_i=Sim3(there.rotation, there.translation, there.scale / by_i))
        return _under_poses(graph, loop, self.there, self.back)


def close_loops(two_view: TwoViewEstimator, graph: KeyframeGraph, places: PlaceRecognition) -> list[Loop]:
    """Keyframes of the submap being tracked that look alike, far apart in time: verified both ways, and closed.

    Each becomes an edge, the drift between its ends is spread over the chain, and everything is optimised. One that
    asks for more drift than there can be is believed only across a passage that is badly explained, or that next to
    nothing holds together, and only with others that say the same: two places may look alike. Once such have been
    closed, the rest are asked again.
    """
    found, doubted = list[_Seen](), list[_Seen]()
    joined, chain = graph.connected_pairs(), _Chain(graph)
    for j in graph.free_members():
        kf = graph.keyframes[j]
        far = [i for i in chain.within_drift(j) if frozenset((i, j)) not in joined]
        far = [i for i in far if not _known(found, i, j) and not _enough_of(doubted, i, j)]
        small = not_unlike(two_view.parts, kf.work, places.best(graph, kf.work, far, 2, MIN_SIMILARITY))
        for other in [*small, *_alike(two_view, graph, j, far)]:
            there = two_view.relocalised(other, kf.work, Future.done(kf.moving / 255.0))
            back = two_view.relocalised(kf, other.work, Future.done(other.moving / 255.0)) if _strong(there) else None
            seen = _loop(two_view, other.id, j, there, back)
            if seen is not None and _credible(seen):
                found.append(seen)
                break
            if seen is not None:
                doubted.append(seen)
    voted = _voted_for(graph, doubted)
    found += voted
    if len(graph.keyframes) >= MANY:
        getattr(two_view.parts.features, "forget", lambda: None)()
        give_back_memory()
    _say_one_place(graph, found)
    _close(graph, found)
    if voted:  # the ends of what was badly explained have moved far
        retake_passages(graph)
        doubted = [seen.now(graph) for seen in doubted if seen not in voted]
        late = [seen for seen in doubted if _credible(seen)]
        _say_one_place(graph, late)
        _close(graph, late)
        found, doubted = found + late, [seen for seen in doubted if seen not in late]
    for seen in doubted:
        _say(graph, seen.loop, f"not believed: {_drift(seen)} speak against it")
    return [seen.loop for seen in found]


def _close(graph: KeyframeGraph, found: list[_Seen]) -> None:
    for seen in found:
        _connect(graph, seen)
    if found:
        optimise_pose_graph(graph, [seen.loop for seen in found])
        graph.solve_all(10, 2.0, steady=True)


class _Chain:
    """The way of the submap being tracked, and who may have been where by it."""

    def __init__(self, graph: KeyframeGraph) -> None:
        self._ids = graph.members()
        self._centres = np.stack([graph.world_from_cam(k)[:3, 3] for k in self._ids])
        steps = np.linalg.norm(np.diff(self._centres, axis=0), axis=1)
        self._way = np.concatenate([[0.0], np.cumsum(steps)])
        self._overlap = OVERLAP_DEPTHS / np.array([graph.median_inv_depth(k) for k in self._ids])
        self._broken = [p[0] for p in doubtful_passages(graph, BROKEN)] if len(self._ids) > MOST_TRIED else []

    def within_drift(self, j: int) -> list[int]:
        """Keyframes well before j that may be where j is; of few all.

        Of many those that no credible drift keeps from it, after a way on which there was something to drift, and those
        that a passage separates from it in which tracking broke.
        """
        n = self._ids.index(j)
        before = [m for m in range(n) if self._ids[m] < j - APART]
        if len(before) > MOST_TRIED:
            apart, way = (
                np.linalg.norm(self._centres[before] - self._centres[n], axis=1),
                self._way[n] - self._way[before],
            )
            near = (apart <= PRIOR_GAP * way + self._overlap[n]) & (way > self._overlap[n])
            last = max((k for k in self._broken if k < j), default=-1)
            before = [m for m, ok in zip(before, near, strict=True) if ok or self._ids[m] < last]
        return [self._ids[m] for m in before]


def _credible(seen: _Seen) -> bool:
    """Whether tracking may have drifted as a loop says.

    Where lengths have grown, or shrunk, by a factor s along the way, an end is off by up to 1 - 1/s of it. Of two
    places that look alike the scale is right and the place is not.
    """
    by_scale = 1 - np.exp(-abs(np.log(seen.loop.j_from_i.scale)))
    return seen.drift <= MAX_DRIFT and seen.gap_ratio <= MAX_GAP + by_scale


def _connect(graph: KeyframeGraph, seen: _Seen) -> None:
    i, j, there, back = seen.loop.i, seen.loop.j, seen.there.pair.matches, seen.back.pair.matches
    graph.connect(i, j, there, static_at(graph.keyframes[j].moving / 255.0, there.new_px))
    graph.connect(j, i, back, static_at(graph.keyframes[i].moving / 255.0, back.new_px))


def _voted_for(graph: KeyframeGraph, doubted: list[_Seen]) -> list[_Seen]:
    """Of loops that would move much, those that agree with most others, if tracking may have broken between."""
    if len(doubted) < VOTES:
        return []
    passages = doubtful_passages(graph)
    loose = [set(part) for part in loose_parts(graph)]
    across = [
        s
        for s in doubted
        if any(s.loop.i <= p[-1] and p[0] <= s.loop.j for p in passages)
        or any((s.loop.i in part) != (s.loop.j in part) for part in loose)
    ]
    best: list[_Seen] = []
    for one in across:
        agree = [other for other in across if _say_the_same(graph, one, other)]
        best = max(best, agree, key=len)
    ends = {s.loop.i for s in best}, {s.loop.j for s in best}
    return best if min(map(len, ends)) >= VOTES else []


def _say_one_place(graph: KeyframeGraph, found: list[_Seen]) -> None:
    for seen in found:
        _say(graph, seen.loop, f"one place, scale {1 / seen.loop.j_from_i.scale:.3f}, {_drift(seen)}")


def _say(graph: KeyframeGraph, loop: Loop, verdict: str) -> None:
    frames = graph.keyframes[loop.i].work.index, graph.keyframes[loop.j].work.index
    graph.loops.append((*frames, verdict))
    log.info("keyframes %d and %d, frames %d and %d: %s", loop.i, loop.j, *frames, verdict)


def _say_the_same(graph: KeyframeGraph, a: _Seen, b: _Seen) -> bool:
    """Whether two loops move the map alike, by what was tracked between their near ends."""
    one, other = a.loop, b.loop
    if max(abs(one.i - other.i), abs(one.j - other.j)) > NEAR_ENDS:
        return False
    pose = {k: Sim3.from_rigid(graph.variables[k].cam_from_world) for k in (one.i, one.j, other.i, other.j)}
    by_a = (pose[other.j] @ pose[one.j].inverse()) @ one.j_from_i @ (pose[one.i] @ pose[other.i].inverse())
    turn = float(np.linalg.norm(so3_log(by_a.rotation @ other.j_from_i.rotation.T)))
    gap = float(np.linalg.norm(by_a.translation - other.j_from_i.translation))
    turn_most = max(SAME_TURN, SAME_SHARE * min(a.drift, b.drift))
    gap_most = max(SAME_GAP, SAME_SHARE * min(a.gap_ratio, b.gap_ratio))
    return turn <= turn_most and gap <= gap_most * min(_way(graph, one.i, one.j), _way(graph, other.i, other.j))


def _alike(two_view: TwoViewEstimator, graph: KeyframeGraph, j: int, far: list[int]) -> list[Keyframe]:
    """The keyframe that shares most features with j, long before it, where the tracked poses let both see one thing."""
    view = graph.variables[j].cam_from_world[:3, :3]
    turns = {i: np.linalg.norm(so3_log(view @ graph.variables[i].cam_from_world[:3, :3].T)) for i in far}
    ids = [i for i in far if i < j - LONG_BEFORE and turns[i] < MAX_DRIFT + SEEN_TOGETHER]
    return most_alike(two_view.parts, graph, graph.keyframes[j].work, ids)


def _known(found: list[_Seen], i: int, j: int) -> bool:
    """Keyframes next to the ends of a loop are matched later, by their poses."""
    return any(abs(i - s.loop.i) <= APART and abs(j - s.loop.j) <= APART for s in found)


def _enough_of(doubted: list[_Seen], i: int, j: int) -> bool:
    """Whether i need not be asked: it has said enough, or so many around it that it adds nothing.

    Two places that look alike do so from all around, so as many keyframes are to say so at either end.
    """
    near = [s.loop for s in doubted if abs(i - s.loop.i) <= NEAR_ENDS and abs(j - s.loop.j) <= NEAR_ENDS]
    if sum(loop.i == i for loop in near) >= VOTES:
        return True
    told = min(len({loop.i for loop in near}), len({loop.j for loop in near})) >= VOTES
    return len(near) >= (2 if told else 4) * VOTES


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
    scale = float(np.sqrt(j_from_i.scale / i_from_j.scale))
    if better is back:
        j_from_i = Sim3.from_rigid(inverse(back.alignment.new_from_ref), scale)
    else:
        j_from_i = Sim3.from_rigid(there.alignment.new_from_ref).in_lengths(scale)
    return _under_poses(graph, Loop(i, j, j_from_i, float(better.weight.sum())), there, back)


def _under_poses(graph: KeyframeGraph, loop: Loop, there: TwoView, back: TwoView) -> _Seen:
    """A loop with what it asks for under the poses that there are now.

    The gap: how far from where tracking has it the loop puts camera i, seen from camera j, / way from i to j.
    """
    tracked = graph.variables[loop.j].cam_from_world @ inverse(graph.variables[loop.i].cam_from_world)
    drift = float(np.linalg.norm(so3_log(loop.j_from_i.rotation @ tracked[:3, :3].T)))
    gap = float(np.linalg.norm(loop.j_from_i.translation - tracked[:3, 3]))
    inv_depths = graph.median_inv_depth(loop.i), graph.median_inv_depth(loop.j)
    return _Seen(loop, there, back, drift, gap / max(_way(graph, loop.i, loop.j), 1e-12), inv_depths)


def _way(graph: KeyframeGraph, i: int, j: int) -> float:
    """Length of the tracked way from keyframe i to a later one j, map units."""
    centres = np.stack([graph.world_from_cam(k)[:3, 3] for k in graph.members() if i <= k <= j])
    return float(np.linalg.norm(np.diff(centres, axis=0), axis=1).sum())


def _drift(seen: _Seen) -> str:
    return f"{np.degrees(seen.drift):.0f} deg and {seen.gap_ratio:.0%} of the way of drift"


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
    shared = {i: _shared(graph, i, ids) for i in ids}
    for i in graph.free_members():
        for j in shared[i]:
            if j >= i or i not in shared[j] or frozenset((i, j)) in done:
                continue
            share, motion = min(shared[i][j][0], shared[j][i][0]), max(shared[i][j][1], shared[j][i][1])
            if share >= COVISIBLE_OVERLAP and motion <= COVISIBLE_MOTION:
                pairs.append((-share, j, i))
    made = connect([(i, j) for _, i, j in sorted(pairs)[: most * len(graph.free_members())]])
    log.info("%d of %d pairs that may see the same were matched", made, len(pairs))
    return made


def _shared(graph: KeyframeGraph, i: int, ids: list[int]) -> dict[int, tuple[float, float]]:
    """(share of i's points in view, their motion) of each keyframe that may see what i sees, by the poses."""
    near = nearby(graph, ids, graph.variables[i].cam_from_world)
    share, motion = overlaps(graph, i, np.stack([graph.variables[k].cam_from_world for k in near]))
    return {k: (float(s), float(m)) for k, s, m in zip(near, share, motion, strict=True)}
