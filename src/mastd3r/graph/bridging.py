"""Submaps that were never recognised: placed where the camera would have gone."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from ..geometry.se3 import inverse, se3_exp, se3_log
from ..geometry.sim3 import Sim3
from .keyframe_graph import FrameRecord, KeyframeGraph
from .submaps import bring

Array = NDArray[Any]
VELOCITY_FRAMES = 6  # over how many frames a velocity is taken
MOST_AHEAD = 3.0  # for how many times that span it is believed
DEPTH_KEYFRAMES = 12  # on either side of a gap, whose median depth is compared: those at its edge are often broken


def bridge_submaps(graph: KeyframeGraph) -> list[tuple[int, int]]:
    """Place submaps that were never recognised where the camera would have gone: (first, last) frame of each.

    Constant velocity over the gap, and the same depth on both sides of it: the median of some keyframes' own. A
    piece between two that are placed goes where both sides have it, and its size is by how far they are apart,
    where that is farther than the camera went over the gaps. Such poses are guesses, so the frames' state becomes
    "interpolated".
    """
    out = []
    keep, *others = sorted(set(graph.submap_of.values())) or [0]
    for submap in others:
        ids = set(graph.members(submap))
        own = [n for n, r in enumerate(graph.records) if r.kf_id in ids and r.state != "lost"]
        piece = [graph.records[n] for n in own]
        for n in own:
            graph.set_record_state(graph.records[n], "interpolated")
        out.append((piece[0].index, piece[-1].index))
        before, after = (
            [r for r in some if graph.submap_of[r.kf_id] == keep and r.state != "lost"]
            for some in (graph.records[: own[0]], graph.records[own[-1] + 1 :])
        )
        ends = [_End(graph, near, end) for near, end in ((before, piece), (after[::-1], piece[::-1])) if near]
        if ends:
            bring(graph, submap, keep, _between(*ends) if len(ends) == 2 else ends[0].placed())
    return out


class _End:
    """One end of a piece, and the frames beside it that are placed: where they say that it is."""

    def __init__(self, graph: KeyframeGraph, beside: list[FrameRecord], piece: list[FrameRecord]) -> None:
        """``beside``: towards the piece; ``piece``: from this end on."""
        end = piece[0]
        near, past = beside[-1], beside[-min(len(beside), VELOCITY_FRAMES)]
        now, then, self.cam_from_gone = (
            r.cam_from_kf @ graph.variables[r.kf_id].cam_from_world for r in (near, past, end)
        )
        span_s = max(abs(near.timestamp_s - past.timestamp_s), 1e-9)
        spans = abs(end.timestamp_s - near.timestamp_s) / span_s
        self.cam_from_keep = se3_exp(min(spans, MOST_AHEAD) * se3_log(now @ inverse(then))) @ now
        self.gap = spans * float(np.linalg.norm(inverse(now)[:3, 3] - inverse(then)[:3, 3]))  # at that speed
        self.by_depth = _near_inv_depth(graph, piece) / _near_inv_depth(graph, beside[::-1])  # lengths of both

    def rotation(self) -> Array:
        """(3, 3) keep_from_gone."""
        rotation: Array = self.cam_from_keep[:3, :3].T @ self.cam_from_gone[:3, :3]
        return rotation

    def placed(self) -> Sim3:
        """keep_from_gone by this end alone."""
        keep, gone = (inverse(pose)[:3, 3] for pose in (self.cam_from_keep, self.cam_from_gone))
        return _at(self.rotation(), self.by_depth, keep, gone)


def _near_inv_depth(graph: KeyframeGraph, records: list[FrameRecord]) -> float:
    """Median of the first few keyframes' own medians."""
    ids = list(dict.fromkeys(r.kf_id for r in records))[:DEPTH_KEYFRAMES]
    return float(np.median([graph.median_inv_depth(k) for k in ids]))


def _between(first: _End, last: _End) -> Sim3:
    """keep_from_gone that both ends of a piece ask for."""
    rotation = Rotation.from_matrix([first.rotation(), last.rotation()]).mean().as_matrix()
    keep, gone = (
        np.array([inverse(pose)[:3, 3] for pose in poses])
        for poses in ((first.cam_from_keep, last.cam_from_keep), (first.cam_from_gone, last.cam_from_gone))
    )
    apart, long = (float(np.linalg.norm(places[1] - places[0])) for places in (keep, gone))
    by_ends = long > 0 and apart > first.gap + last.gap
    scale = apart / long if by_ends else float(np.sqrt(first.by_depth * last.by_depth))
    return _at(rotation, scale, keep.mean(axis=0), gone.mean(axis=0))


def _at(rotation: Array, scale: float, keep: Array, gone: Array) -> Sim3:
    """The similarity of that rotation and scale that brings a place (3,) to another."""
    return Sim3(rotation, keep - scale * rotation @ gone, scale)
