"""Passages of the chain that are explained badly, solved anew from starts that owe nothing to where tracking put them.

Where a fast turn shows one plane, or depths that nothing has confirmed, the matches of a keyframe have a second
explanation: less of a turn and more of a shift. It is a minimum of its own. No solver leaves it, every further
keyframe is tracked from it, and the trajectory breaks there. What betrays it are residuals: the passage costs more for
what its matches weigh than the rest of the chain.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..geometry.se3 import inverse
from ..geometry.sim3 import Sim3
from .factors import ReprojectionFactor
from .few_points import KERNEL_PX, State, at_all_points, chain_of_few, put_back, solved, state_of, thinned
from .initialisation import attempt, errors_px, first_pairs, two_view_pose
from .keyframe_graph import KeyframeGraph
from .turning import turned
from .windows import ALL_INTRINSICS, Window

Array = NDArray[Any]
Start = Callable[[KeyframeGraph], bool]
Tried = dict[tuple[int, int, int], float]  # cost of passages, by first and last keyframe and edges
Settled = dict[tuple[int, int], tuple[float, State]]  # the chain on a few points, by its first and last keyframe
log = logging.getLogger(__name__)
LENGTH, STRIDE = 10, 5  # keyframes of a passage, and between the beginnings of two
LOOKED_AT = 1.1  # times the median passage's cost a weight: another explanation is looked for
DOUBTFUL = 1.3  # the same: something is wrong there
MOST_DOUBTED, MOST_LONG = 10, 3  # passages looked at in one round, the worst first, and longer ones
ROUNDS = 6
BETTER = 0.98  # of the cost, for another explanation to be taken
CHANGED = 0.02  # of the cost, from which a passage is tried again
SETTLING = ((4.0, 15), (1.0, 10), (KERNEL_PX, 20))  # kernel in pixels, and iterations, after a start
NEAR = ((KERNEL_PX, 8),)  # the same of the chain, before a passage is changed
WHOLE = ((4.0, 6), (1.0, 8), (KERNEL_PX, 4))  # and after
WHOLE_OF_FEW = (*WHOLE[:2], (KERNEL_PX, 10))  # the same, on a few points
TOLERANCE = 1e-5  # relative, of either
LONG, AROUND = 256, 60  # keyframes of a chain, above which those around a passage speak for all, and so many each way
LINKS, PAIRS = 3, 2  # that fit worst, and pairs of views across one, that a passage is joined by in turn
WIDE = ((4.0, 4),)  # kernel and iterations, after which they are compared
MISFIT_PX = 3.0  # from where a match is wrong


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

    Where a few points of the whole chain speak against it all are not asked. ``settled``: what they cost as it is.
    """
    best: tuple[float, State] | None = None
    for start in STARTS:
        part = thinned(graph, ids)
        if not start(part):
            continue
        found = solved(part, SETTLING)
        if found < (BETTER * cost if best is None else best[0]):
            best = found, state_of(part)
    frames = [graph.keyframes[k].work.index for k in (ids[0], ids[-1])]
    if best is None:
        log.info("frames %d to %d: no better explanation than the one there is", *frames)
        return False
    found, state = best
    state = {k: (pose, at_all_points(graph.variables[k].px, depth)) for k, (pose, depth) in state.items()}
    before, after = _costs_of_few(graph, ids, state, settled)
    taken = after < before
    if taken:
        scaled = list[Scaled]()
        taken, before, after = kept_if_cheaper(
            graph, ids, lambda: scaled.append(replace_passage(graph, ids, state)), lambda: scaled[0].undo(graph)
        )
    log.info("frames %d to %d explained anew: cost %.0f -> %.0f, of all %.0f -> %.0f, %s", *frames, cost, found, before,
             after, "taken" if taken else "left")  # fmt: skip
    return taken


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


def _from_two_views(part: KeyframeGraph) -> bool:
    """Two keyframes by their essential matrix, the others one after another."""
    pairs = first_pairs(part, set())
    return bool(pairs) and attempt(part, pairs[0]) is not None


def _from_worst_link(part: KeyframeGraph) -> bool:
    """Two halves as they are, joined anew where the matches across fit worst, by the essential matrix of two views.

    Depths are those that the poses give: what was seen across a wrong link has adapted to it. A step is as long as
    steps are in the passage. Of some links and pairs, that is taken which fits best once a wide kernel has seen it.
    """
    ids = sorted(part.variables)
    links = {n: _across(part, ids[:n]) for n in range(1, len(ids))}
    misfits = {n: _misfit(part, edges) for n, edges in links.items() if edges}
    poses = {k: part.variables[k].cam_from_world for k in ids}
    centres = np.array([inverse(poses[k])[:3, 3] for k in ids])
    step = float(np.median(np.linalg.norm(np.diff(centres, axis=0), axis=1)))
    best: tuple[float, State] | None = None
    for n in sorted(misfits, key=lambda n: -misfits[n])[:LINKS]:
        for e in sorted(links[n], key=lambda e: -float(e.weight.sum()))[:PAIRS]:
            pose = two_view_pose(part, e)
            if pose is None:
                continue
            pose[:3, 3] *= step * abs(ids.index(e.j) - ids.index(e.i))
            later, other = (e.j, pose @ poses[e.i]) if e.j >= ids[n] else (e.i, inverse(pose) @ poses[e.j])
            for k in ids:
                part.set_keyframe_pose(k, poses[k] @ inverse(poses[later]) @ other if k >= ids[n] else poses[k])
            _depths_anew(part)
            cost = solved(part, WIDE)
            if best is None or cost < best[0]:
                best = cost, state_of(part)
    if best is None:
        return False
    put_back(part, best[1], part.intrinsics)
    return True


def _across(part: KeyframeGraph, before: Sequence[int]) -> list[ReprojectionFactor]:
    """Edges between the keyframes ``before`` and the others."""
    first = set(before)
    return [e for e in part.edges if (e.i in first) != (e.j in first)]


def _depths_anew(part: KeyframeGraph) -> None:
    """Depths by the poses that there are, from one for all points of a keyframe."""
    for k, v in part.variables.items():
        part.set_depths(k, np.full(len(v.px), float(np.median(v.inv_depth))))
        part.solve_depths(k)


def _misfit(part: KeyframeGraph, edges: Sequence[ReprojectionFactor]) -> float:
    """Share of the edges' weight that does not fit: w min(r² / MISFIT_PX², 1)."""
    out = total = 0.0
    for e, r in zip(edges, errors_px(part, edges), strict=True):
        out += float((e.weight * np.minimum((r / MISFIT_PX) ** 2, 1.0)).sum())
        total += float(e.weight.sum())
    return out / max(total, 1e-9)


STARTS: tuple[Start, ...] = (_from_turn, _from_two_views, _from_worst_link)


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


def _costs_of_few(graph: KeyframeGraph, ids: Sequence[int], state: State, settled: Settled) -> tuple[float, float]:
    """What a few points of the chain cost as it is, in the nearest minimum, and with a passage as ``state`` has it."""
    around, _ = _around(graph, ids)
    key, part = (around[0], around[-1]), chain_of_few(graph, around)
    if key not in settled:
        cost = solved(part, NEAR, graph.held, TOLERANCE)
        settled[key] = cost, state_of(part)
    before, as_it_is = settled[key]
    put_back(part, as_it_is, part.intrinsics)
    every = {k: -(-len(depth) // len(part.variables[k].px)) for k, (_, depth) in state.items()}
    replace_passage(part, ids, {k: (pose, depth[:: every[k]]) for k, (pose, depth) in state.items()})
    return before, solved(part, WHOLE_OF_FEW, graph.held, TOLERANCE)


def kept_if_cheaper(
    graph: KeyframeGraph,
    ids: Sequence[int],
    change: Callable[[], None],
    undo: Callable[[], None] | None = None,
    dearer: float = 0.0,
) -> tuple[bool, float, float]:
    """Change the graph, and change it back unless the whole costs less around ``ids``: (kept, cost before, and after).

    As it is, the nearest minimum speaks for it: a solve that begins with a wide kernel may end in a worse one.
    ``undo``: takes back what ``change`` did beside poses and depths. ``dearer``: by how much it may cost more.
    """
    before, state, lens = cost_around(graph, ids), state_of(graph), graph.intrinsics
    change()
    after = cost_around(graph, ids, WHOLE)
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


def replace_passage(graph: KeyframeGraph, ids: Sequence[int], state: State) -> Scaled:
    """Poses and depths of a passage as ``state`` has them; what follows goes with its end. What has changed scale."""
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
