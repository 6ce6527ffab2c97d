"""Segments of a video that were tracked apart become one graph, as if they had been tracked as one."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import asdict
from typing import Any

from ..errors import InputError
from ..graph.initialisation import bootstrap
from ..graph.keyframe_graph import KeyframeGraph
from ..graph.merging import Merged, join_at_overlaps, one_record_a_frame, side_by_side
from ..graph.turning import observed
from .covisibility import CovisibilityEdges

log = logging.getLogger(__name__)
NEAREST = 3  # keyframes of the segment before that one in the overlap is matched with
PAIRS_AFTER_JOINING = 2  # for each keyframe, of what is matched once more: within a segment that was done before
NO_DEPTH = ("none", "rotation")  # what the matches of a segment may let be known, without any depth in it
KERNEL_PX, ITERATIONS = 2.0, 5  # of the solve over all, once the segments are in one world


def join_segments(
    graph: KeyframeGraph, parts: Sequence[KeyframeGraph], edges: CovisibilityEdges, *, needs_motion: bool = True
) -> list[dict[str, Any]]:
    """``graph`` becomes what the ``parts`` are together: a world for all that share frames, edges across the overlaps.

    ``parts`` in order of time, each with what follows the last frame done (``Slam.end_tracking``). What was joined,
    for run.json. What is not stays a submap: it is recognised later, or placed by continuity. ``needs_motion``: depth
    comes from the camera's motion. Raises InputError where no part has any depth.
    """
    for part in parts:
        if not part.started and len(part.members()) > 1:
            bootstrap(part)
    if not any(part.started for part in parts):
        raise InputError(
            f"segments: expected depth in one of them, got none in {len(parts)}; the camera may hardly move, or they "
            "are too short: try more --segment-frames"
        )
    if needs_motion:
        _doubt_still_ones(parts)
    merged = side_by_side(parts)
    joints = join_at_overlaps(merged)
    one_record_a_frame(merged)
    graph.become(merged.graph)
    across = [pair for joint in joints for pair in _across(merged, joint.before, joint.after)]
    for submap in sorted(graph.started):
        graph.submap = submap
        made = edges.add_many(graph, [p for p in across if {graph.submap_of[k] for k in p} == {submap}])
        log.info("%d of %d pairs of keyframes matched across segments", made, len(across))
    graph.submap = min(graph.started)
    graph.solve_all(ITERATIONS, KERNEL_PX)
    return [asdict(joint) for joint in joints]


def _doubt_still_ones(parts: Sequence[KeyframeGraph]) -> None:
    """Structure of a part whose camera stands still or only turns is none: its frames are looked for in the others.

    Where that is all parts, the joint optimisation says so.
    """
    still = [p for p in parts if p.started and len(p.roots()) == 1 and observed(p, p.members())[0].kind in NO_DEPTH]
    if len(still) < sum(bool(part.started) for part in parts):
        for part in still:
            part.started.clear()


def _across(merged: Merged, before: int, after: int) -> list[tuple[int, int]]:
    """Keyframes of the later segment that lie in the overlap, each with the nearest of the earlier one."""
    graph, earlier, later = merged.graph, merged.pieces[before], merged.pieces[after]
    if not len(earlier) or not len(later):
        return []
    last = merged.records[before][-1].index
    first = merged.records[after][0].index
    ends = [k for k in earlier if graph.keyframes[k].work.index >= first] or list(earlier[-NEAREST:])
    begins = [k for k in later if graph.keyframes[k].work.index <= last] or list(later[:NEAREST])
    pairs = set()
    for k in begins:
        near = sorted(ends, key=lambda e: abs(graph.keyframes[e].work.index - graph.keyframes[k].work.index))
        pairs |= {(e, k) for e in near[:NEAREST]}
    return sorted(pairs)
