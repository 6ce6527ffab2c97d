"""Passages of the chain that are explained badly, solved anew from starts that owe nothing to where tracking put them.

Where a fast turn shows one plane, or depths that nothing has confirmed, the matches of a keyframe have a second
explanation: less of a turn and more of a shift. It is a minimum of its own. No solver leaves it, every further
keyframe is tracked from it, and the trajectory breaks there. What betrays it are residuals: the passage costs more for
what its matches weigh than the rest of the chain.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..geometry.se3 import inverse
from ..geometry.sim3 import Sim3
from .few_points import KERNEL_PX, State, at_all_points, chain_of_few, put_back, solved, state_of, thinned
from .initialisation import add_one_by_one, first_pairs, from_two_views
from .keyframe_graph import KeyframeGraph
from .turning import turned
from .windows import ALL_INTRINSICS, Window

Array = NDArray[Any]
Start = Callable[[KeyframeGraph], bool]
Tried = dict[tuple[int, int, int], float]  # cost of passages, by first and last keyframe and edges
Ends = tuple[int, int]  # first and last keyframe of a chain
log = logging.getLogger(__name__)
LENGTH, STRIDE = 10, 5  # keyframes of a passage, and between the beginnings of two
LOOKED_AT = 1.1  # times the median passage's cost a weight: another explanation is looked for
DOUBTFUL = 1.3  # the same: something is wrong there
MOST_DOUBTED, MOST_LONG = 10, 3  # passages looked at in one round, the worst first, and longer ones
ROUNDS = 6
BETTER = 0.98  # of the cost, for another explanation to be taken
SAME, EXPLANATIONS = 0.01, 2  # of the cost, by which two are told apart; of a passage, that the chain is asked about
CHANGED = 0.02  # of the cost, from which a passage is tried again
ADDING = (8, 3)  # iterations of a keyframe by itself, and of all so far: all are settled afterwards
SETTLING = ((4.0, 15), (1.0, 10), (KERNEL_PX, 20))  # kernel in pixels, and iterations, after a start
NEAR, NEAR_OF_FEW = ((KERNEL_PX, 8),), ((KERNEL_PX, 24),)  # the same of the chain, before a passage is changed
WHOLE = ((4.0, 6), (1.0, 8), (KERNEL_PX, 4))  # and after
WHOLE_OF_FEW = (*WHOLE[:2], (KERNEL_PX, 10))  # the same, on a few points
SETTLED = ((1.0, 4), (KERNEL_PX, 6))  # and on all, from where a few points came to
TOLERANCE = 1e-5  # relative, of either
LONG, AROUND = 256, 60  # keyframes of a chain, above which those around a passage speak for all, and so many each way
PAIRS = (0, 2, 4)  # that a passage is begun from, of the best: the next best is often the same place again


@dataclass
class Settled:
    """What chains cost as they are, in the nearest minimum, until something is taken."""

    few: dict[Ends, tuple[float, State]] = field(default_factory=dict)  # on a few points, and what they come to
    every: dict[Ends, float] = field(default_factory=dict)  # on all points, that are there by now


def retake_passages(graph: KeyframeGraph, tried: Tried | None = None) -> int:
    """Try other explanations of badly explained passages of the submap being tracked; how many were taken.

    ``tried``: passages that are not tried again, unless they cost ``CHANGED`` more or less by now; those that are
    tried are added. One is taken where it costs less than ``BETTER`` of what the passage does, on matches of the
    passage alone, and where it lowers the cost of the whole chain too.
    """
    taken, tried = 0, Tried() if tried is None else tried
    for _ in range(ROUNDS):
        settled = Settled()
        for ids in doubtful_passages(graph, LOOKED_AT):
            key, cost = (ids[0], ids[-1], len(graph.edges_among(ids))), cost_alone(graph, ids)
            if abs(tried.get(key, np.inf) - cost) <= CHANGED * cost:
                continue
            tried[key] = cost
            if _retake(graph, ids, cost, settled):
                taken += 1
                break  # the passages beside it have changed
        else:
            break
    return taken


def doubtful_passages(graph: KeyframeGraph, times: float = DOUBTFUL) -> list[list[int]]:
    """Passages that cost so many times more for what their matches weigh than others, the worst first.

    Those that touch come as one, too, after all that come alone.

    None where depths are measured: their scale is not ours to change, and a passage by itself does not know it.
    """
    ids = graph.free_members()
    if len(ids) < 2 * LENGTH or graph.depths_measured:
        return []
    firsts = [*range(0, len(ids) - LENGTH, STRIDE), len(ids) - LENGTH]
    costs = np.array([_cost_of_weight(graph, ids[n : n + LENGTH]) for n in firsts])
    bound = times * float(np.median(costs))
    worst_first = sorted(np.flatnonzero(costs > bound), key=lambda n: -costs[n])
    alone = [ids[firsts[n] : firsts[n] + LENGTH] for n in worst_first]
    two = [ids[firsts[n - 1] : firsts[n] + LENGTH] for n in worst_first if n and costs[n - 1] > bound]
    return alone[:MOST_DOUBTED] + two[:MOST_LONG]


def _cost_of_weight(graph: KeyframeGraph, ids: Sequence[int]) -> float:
    part = thinned(graph, ids)
    weight = sum(float(e.weight.sum()) for e in part.edges)
    return solved(part, ((KERNEL_PX, 4),)) / max(weight, 1e-9)


def cost_alone(graph: KeyframeGraph, ids: Sequence[int]) -> float:
    """What a passage costs by itself, in the nearest minimum."""
    return solved(thinned(graph, ids), ((KERNEL_PX, 15),))


def _retake(graph: KeyframeGraph, ids: Sequence[int], cost: float, settled: Settled) -> bool:
    """The best of the other explanations of one passage, if it is better than the one there is, of this ``cost``.

    The best is the one with which the whole chain costs least, on a few points; where those speak against it all are
    not asked. ``settled``: what they cost as it is.
    """
    frames = [graph.keyframes[k].work.index for k in (ids[0], ids[-1])]
    ways = [(found, _on_few(graph, ids, state, settled)) for found, state in _explanations(graph, ids, BETTER * cost)]
    if not ways:
        log.info("frames %d to %d: no better explanation than the one there is", *frames)
        return False
    found, way = min(ways, key=lambda way: way[1].after)
    before, after, taken = way.before, way.after, way.after < way.before
    if taken:
        around, _ = _around(graph, ids)
        ends, scaled = (around[0], around[-1]), list[Scaled]()

        def change() -> None:
            scaled.append(replace_passage(graph, ids, way.explanation, way.follows))
            _as_on_few(graph, way.state)

        known = settled.every.get(ends)
        taken, before, after = kept_if_cheaper(graph, ids, change, lambda: scaled[0].undo(graph), known, SETTLED)
        settled.every[ends] = before
    log.info("frames %d to %d explained anew: cost %.0f -> %.0f, of all %.0f -> %.0f, %s", *frames, cost, found, before,
             after, "taken" if taken else "left")  # fmt: skip
    return taken


def _explanations(graph: KeyframeGraph, ids: Sequence[int], bound: float) -> list[tuple[float, State]]:
    """Some of what the starts come to that costs less than ``bound``, the cheapest first, on all points.

    Which of two that cost a passage about as little is the true one, the passage does not know.
    """
    found = list[tuple[float, State]]()
    for start in STARTS:
        part = thinned(graph, ids)
        if start(part):
            cost = solved(part, SETTLING)
            if cost < bound and all(abs(cost - other) > SAME * other for other, _ in found):
                found.append((cost, state_of(part)))
    px = {k: graph.variables[k].px for k in ids}
    return [
        (cost, {k: (pose, at_all_points(px[k], depth)) for k, (pose, depth) in state.items()})
        for cost, state in sorted(found, key=lambda one: one[0])[:EXPLANATIONS]
    ]


# -- starts ------------------------------------------------------------------------------------------------------


def _from_turn(part: KeyframeGraph) -> bool:
    """All keyframes at one place, turned as explains most of the image motion; all points equally far."""
    cam_from_first = turned(part)
    inv_depth = float(np.median(np.concatenate([v.inv_depth for v in part.variables.values()])))
    first_from_world = part.variables[min(part.variables)].cam_from_world
    for k, v in part.variables.items():
        part.set_keyframe_pose(k, cam_from_first[k] @ first_from_world)
        part.set_depths(k, np.full(len(v.px), inv_depth))
    return True


def _from_two_views(part: KeyframeGraph, nth: int) -> bool:
    """Two keyframes by their essential matrix, the others one after another; the ``nth`` best pair to begin with."""
    pairs = first_pairs(part, set(), nth + 1)
    return nth < len(pairs) and from_two_views(part, pairs[nth], ADDING)


def _from_one_end(part: KeyframeGraph, end: int) -> bool:
    """The first (0) or the last (-1) keyframe as it is, the others one after another from there.

    Tracking came from one side, and from depths that nothing had confirmed yet.
    """
    add_one_by_one(part, [sorted(part.variables)[end]], ADDING)
    return True


STARTS: tuple[Start, ...] = (
    _from_turn,
    *(partial(_from_two_views, nth=n) for n in PAIRS),
    *(partial(_from_one_end, end=end) for end in (0, -1)),
)


# -- the chain with another explanation of a passage ------------------------------------------------------------


def cost_around(graph: KeyframeGraph, ids: Sequence[int], steps: Sequence[tuple[float, int]] = NEAR) -> float:
    """What the whole chain costs once it is solved by ``steps``; of a long one the keyframes around a passage.

    Those before stay where they are, those after come along.
    """
    around, after = _around(graph, ids)
    if around == graph.members():
        return [graph.solve_all(iterations, kernel_px, steady=True) for kernel_px, iterations in steps][-1].cost_last
    still = frozenset([around[0], *(k for k in around if k < graph.held)])
    window = Window(around, graph.edges_among(around), still, ALL_INTRINSICS, steady=True)
    old_end = graph.variables[around[-1]].cam_from_world
    cost = [graph.optimise(window, n, kernel_px, tolerance=TOLERANCE) for kernel_px, n in steps][-1].cost_last
    moved = inverse(graph.variables[around[-1]].cam_from_world) @ old_end
    graph.transform_keyframes(after, Sim3.from_rigid(moved))
    return cost


def _around(graph: KeyframeGraph, ids: Sequence[int]) -> tuple[list[int], list[int]]:
    """The keyframes that speak for a passage, and those after them; in a chain that is not ``LONG`` all."""
    members = graph.members()
    if len(members) <= LONG:
        return members, []
    first, last = members.index(ids[0]), members.index(ids[-1])
    end = last + AROUND + 1
    return members[max(first - AROUND, 0) : end], members[end:]


@dataclass(frozen=True)
class OnFew:
    """What a few points of the chain cost as it is, and with another explanation of a passage; what that comes to."""

    before: float
    after: float
    explanation: State  # of the passage, on all points
    follows: bool  # what follows goes with the passage's end; else it stays where it is
    state: State  # of the chain


def _on_few(graph: KeyframeGraph, ids: Sequence[int], explanation: State, settled: Settled) -> OnFew:
    """A few points of the chain as it is, in the nearest minimum, and with a passage as another explanation has it.

    What follows goes with the passage's end, or stays where it is, as costs less: other views may hold it there.
    """
    around, _ = _around(graph, ids)
    ends, part = (around[0], around[-1]), chain_of_few(graph, around)
    if ends not in settled.few:
        cost = solved(part, NEAR_OF_FEW, graph.held, TOLERANCE)
        settled.few[ends] = cost, state_of(part)
    before, as_it_is = settled.few[ends]
    every = {k: -(-len(depth) // len(part.variables[k].px)) for k, (_, depth) in explanation.items()}
    of_few = {k: (pose, depth[:: every[k]]) for k, (pose, depth) in explanation.items()}
    ways = list[OnFew]()
    for follows in (True, False) if ids[-1] < around[-1] else (True,):
        put_back(part, as_it_is, part.intrinsics)
        scaled = replace_passage(part, ids, of_few, follows)
        cost = solved(part, WHOLE_OF_FEW, graph.held, TOLERANCE, widest_steady_px=WHOLE_OF_FEW[0][0])
        ways.append(OnFew(before, cost, explanation, follows, state_of(part)))
        scaled.undo(part)
    return min(ways, key=lambda way: way.after)


def _as_on_few(graph: KeyframeGraph, state: State) -> None:
    """Poses as a few points have them, and depths by as much nearer or farther as the nearest of those; all follows."""
    last = max(state)
    old_end = graph.variables[last].cam_from_world
    for k, (pose, depth) in state.items():
        v = graph.variables[k]
        old = v.inv_depth[:: -(-len(v.px) // len(depth))]
        known = (old > 0) & (depth > 0)
        times = np.where(known, depth / np.where(known, old, 1.0), 1.0)
        graph.set_keyframe_pose(k, pose)
        graph.set_depths(k, v.inv_depth * at_all_points(v.px, times))
    moved = inverse(graph.variables[last].cam_from_world) @ old_end
    graph.transform_keyframes([k for k in graph.members() if k > last], Sim3.from_rigid(moved))


def kept_if_cheaper(
    graph: KeyframeGraph,
    ids: Sequence[int],
    change: Callable[[], None],
    undo: Callable[[], None] | None = None,
    before: float | None = None,
    steps: Sequence[tuple[float, int]] = WHOLE,
    dearer: float = 0.0,
) -> tuple[bool, float, float]:
    """Change the graph, and change it back unless the whole costs less around ``ids``: (kept, cost before, and after).

    As it is, the nearest minimum speaks for it: a solve that begins with a wide kernel may end in a worse one.
    ``undo``: takes back what ``change`` did beside poses and depths. ``before``: what it costs, if it is there already.
    ``steps``: how it is solved after the change. ``dearer``: by how much it may cost more.
    """
    before = cost_around(graph, ids) if before is None else before
    state, lens = state_of(graph), graph.intrinsics
    change()
    after = cost_around(graph, ids, steps)
    kept = after < before + dearer
    if not kept:
        if undo is not None:
            undo()
        put_back(graph, state, lens)
    return kept, before, after


# -- back into the chain -----------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Scaled:
    """Keyframes whose lengths are ``times`` what they were."""

    ids: list[int]
    times: float

    def undo(self, graph: KeyframeGraph) -> None:
        """As they were, with the priors of their depths and the frames that hang on them."""
        graph.scale_keyframes(self.ids, 1 / self.times)


def replace_passage(graph: KeyframeGraph, ids: Sequence[int], state: State, follows: bool = True) -> Scaled:
    """Poses and depths of a passage as ``state`` has them; what follows goes with its end, or stays where it is.

    What has changed scale.
    """
    ratio = _length_ratio(graph, ids[:3], state)
    end = ids[-1]
    old_end = Sim3.from_rigid(graph.variables[end].cam_from_world)
    grown = _length_ratio(graph, ids[-3:], state) / ratio
    first_pose, first_new = graph.variables[ids[0]].cam_from_world, state[ids[0]][0]
    for k in ids:
        pose, inv_depth = state[k]
        from_first = pose @ inverse(first_new)
        from_first[:3, 3] /= ratio
        graph.set_keyframe_pose(k, from_first @ first_pose)
        graph.set_depths(k, inv_depth * ratio)
    if not follows:
        return Scaled([], 1.0)
    # lengths of what follows: as its end's were, which have become ``1 / grown`` of what they were
    new_end = Sim3.from_rigid(inverse(graph.variables[end].cam_from_world))
    world_from_old = new_end @ Sim3(np.eye(3), np.zeros(3), 1 / grown) @ old_end
    after = [k for k in graph.members() if k > end]
    graph.transform_keyframes(after, world_from_old)
    return Scaled(after, 1 / grown)


def _length_ratio(graph: KeyframeGraph, ids: Sequence[int], state: State) -> float:
    """Inverse depths of some keyframes before / inverse depths in ``state``, the median."""
    ratios = []
    for k in ids:
        old, new = graph.variables[k].inv_depth, state[k][1]
        known = (old > 0) & (new > 0)
        ratios.append(float(np.median(old[known] / new[known])) if known.any() else 1.0)
    return float(np.median(ratios))
