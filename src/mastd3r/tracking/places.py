"""Which keyframes may show the place of a frame, by the sparse features that they share."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from ..graph.keyframe_graph import Keyframe, KeyframeGraph
from ..parts import Parts
from ..types import WorkFrame

MOST_COMPARED = 200  # keyframes, spread over all that there are
UNLIKE = 0.04
MIN_ALIKE = 0.08  # share of features that two views have in common, to be looked at


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


def not_unlike(parts: Parts, work: WorkFrame, candidates: Sequence[Keyframe]) -> list[Keyframe]:
    """Without those that share next to no feature with a frame: to look at each closely costs a hundred times more."""
    if not candidates:
        return []
    share = parts.features.alike(work.gray, [kf.work.gray for kf in candidates])
    return [kf for kf, s in zip(candidates, share, strict=True) if not s < UNLIKE]
