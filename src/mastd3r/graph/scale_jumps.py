"""Where the scale jumps: what follows is tried again at the scale that goes on as before.

A camera that walks changes its speed, and looks at what is near and far. Where both its speed and the depth of what it
sees are suddenly many times what they were, it is the unit of length that has changed: few matches went through, as at
a fast turn with somebody in front. The solver does not leave such a minimum, though the true one costs less; or the
matches tell of no scale at all, and then the one that goes on as before is the likelier.
"""

from __future__ import annotations

import logging
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..geometry.se3 import inverse
from ..geometry.sim3 import Sim3
from .keyframe_graph import KeyframeGraph
from .passages import kept_if_cheaper

Array = NDArray[Any]
log = logging.getLogger(__name__)
SPAN, LEAST_SPAN = 6, 2  # keyframes on either side, whose speed and depth are compared, and at least
JUMP = 2.0  # times, that both change: another scale is tried
MOST_TRIED = 3  # jumps, the largest first
UNTOLD = 25.0  # more of the cost, up to which matches do not tell: as much as half a dozen that are some pixels off


def mend_scale_jumps(graph: KeyframeGraph) -> int:
    """Try the scale before a jump for what follows it, in the submap being tracked; how often it was taken.

    Where a later jump leads back, what lies between the two is tried by itself first: the rest may hang together by
    other views. The scale before is taken unless the whole chain costs more so. None is tried where depths are
    measured.
    """
    taken, tried = 0, set[int]()
    while len(tried) < MOST_TRIED and not graph.depths_measured:
        jumps = scale_jumps(graph)
        jump = next((j for j in jumps if j[0] not in tried), None)
        if jump is None:
            break
        tried.add(jump[0])
        back = _leads_back(jumps, *jump)
        done = back is not None and _rescaled(graph, *jump, back)
        taken += done or _rescaled(graph, *jump)
    return taken


def _leads_back(jumps: list[tuple[int, float]], kf_id: int, ratio: float) -> int | None:
    """The first jump after a keyframe, if it undoes most of the one there."""
    later = min((j for j in jumps if j[0] > kf_id), default=None)
    return later[0] if later is not None and abs(np.log(later[1] * ratio)) < np.log(JUMP) else None


def scale_jumps(graph: KeyframeGraph) -> list[tuple[int, float]]:
    """Keyframes at which lengths are ``ratio`` times what they were before, the largest change first.

    The ratio is the lesser of those of speed and depth. Of neighbours the one where both change most is named.
    """
    ids = graph.free_members()
    if len(ids) < 2 * LEAST_SPAN + 2:
        return []
    place = np.array([inverse(graph.variables[k].cam_from_world)[:3, 3] for k in ids])
    time_s = np.array([graph.keyframes[k].work.timestamp_s for k in ids])
    gap_s = np.maximum(np.abs(np.diff(time_s)), 1e-9)
    speed = np.log(np.maximum(np.linalg.norm(np.diff(place, axis=0), axis=1) / gap_s, 1e-12))
    depth = -np.log(np.maximum([graph.median_inv_depth(k) for k in ids], 1e-12))
    found: list[tuple[float, float, int]] = []
    for n in range(LEAST_SPAN + 1, len(ids) - LEAST_SPAN):  # the step from n - 1 to n belongs to neither side
        sides = (
            (speed[max(n - 1 - SPAN, 0) : n - 1], speed[n : n + SPAN]),
            (depth[max(n - SPAN, 0) : n], depth[n : n + SPAN]),
        )
        faster, farther = (float(np.median(later) - np.median(before)) for before, later in sides)
        if faster * farther > 0 and min(abs(faster), abs(farther)) > np.log(JUMP):
            # medians tell that there is one, means where
            sharpness = min(abs(float(later.mean() - before.mean())) for before, later in sides)
            found.append((sharpness, float(np.copysign(min(abs(faster), abs(farther)), faster)), n))
    out: list[tuple[int, float]] = []
    for _, change, n in sorted(found, reverse=True):
        if all(abs(n - ids.index(k)) > SPAN for k, _ in out):
            out.append((ids[n], float(np.exp(change))))
    return out


def _rescaled(graph: KeyframeGraph, kf_id: int, ratio: float, end: int | None = None) -> bool:
    """Bring a keyframe, and what follows it, to the scale before, unless the whole chain costs more; whether it was.

    ``end``: the first keyframe that stays; default: none.
    """
    after = [k for k in graph.free_members() if k >= kf_id and (end is None or k < end)]
    around = [max((k for k in graph.free_members() if k < kf_id), default=kf_id), kf_id]

    def change() -> None:
        centre = inverse(graph.variables[kf_id].cam_from_world)[:3, 3]
        graph.transform_keyframes(after, Sim3(np.eye(3), centre - centre / ratio, 1 / ratio))

    def undo() -> None:  # of the priors of depths, and of the frames that hang on them
        graph.transform_keyframes(after, Sim3(np.eye(3), np.zeros(3), ratio))

    taken, before, now = kept_if_cheaper(graph, around, change, undo, dearer=UNTOLD)
    frames = [graph.keyframes[k].work.index for k in (kf_id, after[-1])]
    log.info("frames %d to %d: lengths are %.2f times what they were; as before they cost %.0f -> %.0f, %s",
             *frames, ratio, before, now, "taken" if taken else "left")  # fmt: skip
    return taken
