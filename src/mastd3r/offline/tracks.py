"""Tracks of static points: the matches that the poses and depths of a run came from, as observations of points."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..export.tracks import Tracks
from ..geometry.se3 import inverse, transform
from ..graph.keyframe_graph import KeyframeGraph
from ..types import MEASURED, USABLE_WEIGHT
from .final_solve import FinalFrame
from .static_cloud import placed_points

Array = NDArray[Any]
OUTLIER_PX = 2.0  # at working size: matches farther from their point than that were outvoted, and are no observations
SURE = 0.5  # confidence of a depth that is the point's own, not its neighbours'


def static_tracks(
    graph: KeyframeGraph,
    final: list[FinalFrame],
    colors: Mapping[int, Array],
    moving: Mapping[int, Array],
    photograph_px: Callable[[Array], Array],
) -> Tracks:
    """Observations of the keyframes' static points: in their own keyframe, and wherever they were matched.

    ``colors`` (p, 3) uint8 and ``moving`` (p,) P(moving) of each keyframe's px; ``photograph_px`` brings (m, 2) pixels
    at working size into the photograph. Points with a depth of their own that two frames or more see.
    """
    rows = [n for n, f in enumerate(final) if f.state in MEASURED]
    row_of_kf = {final[n].record.kf_id: k for k, n in enumerate(rows) if final[n].record.is_keyframe}
    points, found_colors = [np.zeros((0, 3))], [np.zeros((0, 3), np.uint8)]
    seen = [(np.zeros(0, int), np.zeros(0, int), np.zeros((0, 2)))]
    first = 0
    for k in sorted(set(colors) & set(row_of_kf)):
        placed = placed_points(graph, k, moving[k])
        chosen = placed.keep & (placed.own_confidence > SURE)
        number = np.where(chosen, np.cumsum(chosen) - 1, -1)
        for frame, point, px in _matched(graph, k, rows, final, row_of_kf):
            good = chosen[point] & _agrees(graph, placed.points_world[point], final[rows[frame]], px)
            seen.append((first + number[point[good]], np.full(int(good.sum()), frame), px[good]))
        points.append(placed.points_world[chosen])
        found_colors.append(colors[k][chosen])
        first += int(chosen.sum())
    point_of, frame_of, px_of = (np.concatenate(c) for c in zip(*seen, strict=True))
    _, once = np.unique(point_of * len(final) + frame_of, return_index=True)  # by point, then in order of time
    tracks = Tracks(
        np.concatenate(points).astype(np.float32),
        np.concatenate(found_colors).astype(np.uint8),
        np.array([final[n].record.timestamp_s for n in rows], float),
        point_of[once].astype(np.int32),
        frame_of[once].astype(np.int32),
        photograph_px(px_of[once]).astype(np.float32),
    )
    return tracks.seen(np.ones(len(tracks.point), bool))


def _matched(
    graph: KeyframeGraph, kf_id: int, rows: list[int], final: list[FinalFrame], row_of_kf: Mapping[int, int]
) -> Iterator[tuple[int, Array, Array]]:
    """(row, (m,) indices of kf_id's points, (m, 2) pixels at working size) of every frame that was matched with it."""
    yield row_of_kf[kf_id], np.arange(len(graph.variables[kf_id].px)), graph.variables[kf_id].px
    for edge in graph.edges:
        if edge.i == kf_id and edge.j in row_of_kf:
            used = np.flatnonzero(edge.weight > USABLE_WEIGHT)
            yield row_of_kf[edge.j], used, edge.target[used].astype(float)
    for row, n in enumerate(rows):
        record = final[n].record
        if record.kf_id == kf_id and not record.is_keyframe:
            used = np.flatnonzero(record.weight > USABLE_WEIGHT)
            yield row, record.points[used], record.target[used].astype(float)


def _agrees(graph: KeyframeGraph, points_world: Array, frame: FinalFrame, px: Array) -> Array:
    """(m,) bool: the points (m, 3) lie before the frame's camera, within ``OUTLIER_PX`` of px (m, 2)."""
    points_cam = transform(inverse(frame.world_from_cam), points_world)
    in_front = points_cam[:, 2] > 0
    at = graph.camera().project(np.where(in_front[:, None], points_cam, 1.0))
    return np.asarray(in_front & (np.linalg.norm(at - px, axis=1) < OUTLIER_PX))
