"""The whole chain solved anew, coarse to fine, on a few points of each keyframe: is there a better minimum?

Tracking adds a keyframe at a time, and each solve starts from what the one before it found. Where few matches say how
long a step was, everything after it may lie on the wrong side of a long flat valley, and no solve with a narrow kernel
comes out of it. On a few points a solve from a wide kernel costs a fraction of one on all.
"""

from __future__ import annotations

import logging

from .few_points import at_all_points, chain_of_few, solved, state_of
from .keyframe_graph import KeyframeGraph
from .passages import LONG, kept_if_cheaper

log = logging.getLogger(__name__)
POINTS = 150  # of a keyframe
LEAST = 10  # keyframes, for another minimum to be worth looking for
COARSE_TO_FINE, SETTLING = ((4.0, 6), (1.0, 8), (0.5, 8)), ((0.5, 20),)  # kernel in pixels, and iterations
BETTER = 0.998  # of the cost on a few points, for the other minimum to be tried on all


def solve_anew(graph: KeyframeGraph) -> bool:
    """Another minimum of everything in the submap being tracked, where it costs less; whether it was taken.

    On the way there a speed that goes on weighs as much as for all points, and so more than it should for a few. None
    is looked for where depths are measured, in a saved map, and in a chain of more than ``LONG`` keyframes.
    """
    ids = graph.free_members()
    if graph.depths_measured or graph.held or not LEAST <= len(ids) <= LONG:
        return False
    here, part = chain_of_few(graph, ids, POINTS), chain_of_few(graph, ids, POINTS)
    here_cost = solved(here, SETTLING)
    alike, part.config = part.config, graph.config
    solved(part, COARSE_TO_FINE)
    part.config = alike
    there_cost = solved(part, SETTLING)
    if there_cost > BETTER * here_cost:
        return False

    def take() -> None:
        for k, (pose, inv_depth) in state_of(part).items():
            graph.set_keyframe_pose(k, pose)
            graph.set_depths(k, at_all_points(graph.variables[k].px, inv_depth))

    taken, before, now = kept_if_cheaper(graph, ids, take)
    log.info("%d keyframes solved anew, coarse to fine: cost %.0f -> %.0f on a few points, %.0f -> %.0f on all, %s",
             len(ids), here_cost, there_cost, before, now, "taken" if taken else "left")  # fmt: skip
    return taken
