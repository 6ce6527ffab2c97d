"""Keyframes that too few matches hold to the rest of their submap: where they are nobody knows.

Where somebody fills the picture, a frame may be followed by a few matches at the outline of what moves. They agree on
a pose that is off by the length of a step and more. Nothing else sees the frame, so no solve mends it.
"""

from __future__ import annotations

import logging
from collections import defaultdict
from collections.abc import Collection
from statistics import median
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from .factors import ReprojectionFactor
from .keyframe_graph import KeyframeGraph
from .match_noise import squared_residuals

Array = NDArray[Any]
log = logging.getLogger(__name__)
FIRM = 25.0  # weight of the matches between two parts that agree, either way: from here on their place is known
FIRM_SHARE = 0.25  # of a keyframe's strongest link, the median: where matches are few, that is enough
AGREES_PX = 3.0  # from where poses and depths put it, for a match to count
FEW = 8  # keyframes of a part at most, for it to be given up


def leave_loose(graph: KeyframeGraph) -> int:
    """Take the parts of ``loose_parts`` out of the submap being tracked; how many keyframes they had.

    Small ones are forgotten, and the frames that hang on them are lost: others may see them, and they lie between two
    that are known. Larger ones become submaps of their own.
    """
    parts = loose_parts(graph)
    gone = [k for part in parts if len(part) <= FEW for k in part]
    for part in (p for p in parts if len(p) > FEW):
        graph.separate(part)
        frames = [graph.keyframes[k].work.index for k in (part[0], part[-1])]
        log.info("frames %d to %d: next to nothing holds them to the rest, they are a piece apart", *frames)
    if gone:
        frames = [graph.keyframes[k].work.index for k in gone]
        log.info("keyframes at frames %s hang by a thread, and are left out", ", ".join(map(str, sorted(frames))))
        graph.drop_keyframes(gone)
    return sum(map(len, parts))


def loose_parts(graph: KeyframeGraph) -> list[list[int]]:
    """Parts of the submap being tracked, all but the largest, that no firm link holds to any other.

    A small part that others hang on stays: a thread is more than nothing there. So does what has a part of a saved map.
    """
    members = graph.members()
    weights = agreeing_weights(graph, members)
    parts = sorted(firm_parts(members, weights, firm_weight(weights)), key=len)
    any_link = dict.fromkeys(weights, 1.0)
    loose: list[list[int]] = []
    rest = set(members)
    while True:
        whole = len(firm_parts(rest, any_link, 1.0))
        for part in (p for p in parts[:-1] if p <= rest and all(k >= graph.held for k in p)):
            if len(part) > FEW or len(firm_parts(rest - part, any_link, 1.0)) <= whole:
                loose.append(sorted(part))
                rest -= part
                break  # what hung on it may go now
        else:
            return loose


def agreeing_weights(graph: KeyframeGraph, ids: Collection[int]) -> dict[frozenset[int], float]:
    """By pair of keyframes: the weight of the matches that are where poses and depths put them, both ways."""
    weights: dict[frozenset[int], float] = defaultdict(float)
    for e in graph.edges_among(ids):
        weights[frozenset((e.i, e.j))] += _agreeing_weight(graph, e)
    return weights


def firm_weight(weights: dict[frozenset[int], float]) -> float:
    """The weight from which a link is firm: ``FIRM``, or less where a small or bare image has few matches."""
    strongest: dict[int, float] = defaultdict(float)
    for pair, weight in weights.items():
        for k in pair:
            strongest[k] = max(strongest[k], weight)
    return min(FIRM, FIRM_SHARE * median(strongest.values())) if strongest else FIRM


def _agreeing_weight(graph: KeyframeGraph, edge: ReprojectionFactor) -> float:
    """Weight of the matches of an edge that are where poses and depths put them."""
    return float(edge.weight[squared_residuals(graph, edge) < AGREES_PX**2].sum())


def firm_parts(ids: Collection[int], weights: dict[frozenset[int], float], least: float = FIRM) -> list[frozenset[int]]:
    """Sets of ``ids`` between any two of which matches weigh less than ``least``, all together.

    ``weights``: of pairs. Two sets of which each is held weakly to the other by many pairs are one.
    """
    row = {k: n for n, k in enumerate(ids)}
    inside = [(*(row[k] for k in pair), w) for pair, w in weights.items() if len(pair) == 2 and pair <= row.keys()]
    i, j, weight = np.array(inside, float).reshape(-1, 3).T
    part: Array = np.arange(len(row))
    while True:
        count = len(set(part.tolist()))
        ends = part[i.astype(int)], part[j.astype(int)]
        between = coo_array((weight, (np.minimum(*ends), np.maximum(*ends))), shape=(count, count)).tocsr()
        fewer, joined = connected_components(between >= least, directed=False)
        if fewer == count:
            break
        part = joined[part]
    parts: dict[int, set[int]] = defaultdict(set)
    for k, n in row.items():
        parts[int(part[n])].add(k)
    return [frozenset(p) for p in parts.values()]
