"""When a submap is tried to be started, and what becomes of keyframes that no try explains."""

from __future__ import annotations

import logging

from .initialisation import bootstrap
from .keyframe_graph import KeyframeGraph

log = logging.getLogger(__name__)


def start_or_let_go(graph: KeyframeGraph, *, hurry: bool = False) -> bool:
    """Start the submap being tracked, once it has ``bootstrap_keyframes``; True where it has been started.

    Each try solves all its keyframes some ten times over, and things that no camera explains do not become a static
    scene by waiting. So where twice as many keyframes as are asked for fit none, the older ones are let go, a submap
    that never will be, and the next try is made with as many again. ``hurry``: as ``bootstrap``.
    """
    members, asked = graph.members(), graph.config.bootstrap_keyframes
    if len(members) < (2 * asked if _let_go_before(graph) else asked):
        return False
    report = bootstrap(graph, hurry=hurry)
    if not report.started and report.agreeing is not None and len(members) >= 2 * asked:
        graph.submap_of.update(dict.fromkeys(members[:-asked], 1 + max(graph.submap_of.values())))
        log.info("%d keyframes in a row fit no static scene: all but the last %d are let go", len(members), asked)
    return report.started


def drop_let_go(graph: KeyframeGraph) -> None:
    """Forget the keyframes that were let go; their frames become lost. The others are numbered anew."""
    for submap in _let_go_submaps(graph):
        graph.drop_submap(submap)


def _let_go_before(graph: KeyframeGraph) -> bool:
    """True where the keyframes just before the submap being tracked were let go."""
    return graph.submap_of.get(graph.members()[0] - 1) in _let_go_submaps(graph)


def _let_go_submaps(graph: KeyframeGraph) -> set[int]:
    return set(graph.submap_of.values()) - graph.started - {graph.submap}
