"""Graphs of overlapping pieces of one video become one: side by side first, then in one world by the shared frames."""

from __future__ import annotations

import logging
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from ..geometry.se3 import inverse, so3_exp, so3_log, transform
from ..geometry.sim3 import Sim3
from ..types import MEASURED
from .depth import depth_confidence
from .intrinsics import Intrinsics, as_given
from .keyframe_graph import FrameRecord, KeyframeGraph
from .submaps import bring

Array = NDArray[Any]
log = logging.getLogger(__name__)
SAME_PX = 5.0  # between points of two graphs in one frame, for their depths to be compared
MIN_POINTS = 20  # so compared, for a frame to speak of the scale
MIN_FRAMES = 5  # that both graphs have tracked
MAX_TURN, MAX_SHIFT = 0.05, 0.1  # rad, and of the median depth: the median of what shared frames disagree by
SAME_FOCAL = 0.003  # of its log: what differs by more is solved under the lens that all get
NOTHING: dict[str, Any] = {
    "points": np.zeros(0, int),
    "target": np.zeros((0, 2), np.float32),
    "weight": np.zeros(0, np.float32),
}
UNDER_ONE_LENS = ((2.0, 8), (1.0, 8))  # kernel in pixels, iterations


@dataclass(frozen=True)
class Joint:
    """Two pieces joined by the frames that they share."""

    before: int  # numbers of the pieces
    after: int
    frames: int
    scale: float  # lengths of the first a length of the second
    turn: float  # rad, median over the frames
    shift: float  # of the median depth


@dataclass(frozen=True)
class Merged:
    """Several graphs in one, with every record that they have of a frame."""

    graph: KeyframeGraph
    pieces: list[range]  # keyframes of each
    records: list[list[FrameRecord]]  # of each; those of the graph, too


def best_lens(graphs: Sequence[KeyframeGraph]) -> Intrinsics:
    """The lens of the piece that knows its focal length best; pieces without structure know nothing."""
    known = [g for g in graphs if g.started] or list(graphs)
    return min(known, key=lambda g: np.inf if g.last_report is None else g.last_report.focal_sigma_ratio).intrinsics


def side_by_side(graphs: Sequence[KeyframeGraph]) -> Merged:
    """All keyframes, edges and records in one graph under one lens; what was a submap is one, nothing is joined.

    Pieces are in order of time, each under ``best_lens``. The graphs are used up: their parts are shared.
    """
    lens = best_lens(graphs)
    out = KeyframeGraph(graphs[0].config, lens)
    out.size = graphs[0].size
    pieces, records = [], []
    for g in graphs:
        if not g.started:  # without depth its frames are lost, and looked for among the others later
            records.append([replace(r, kf_id=0, state="lost", is_keyframe=False, **NOTHING) for r in g.records])
            out.records += records[-1]
            pieces.append(range(0))
            continue
        if abs(g.intrinsics.values[0] - lens.values[0]) > SAME_FOCAL:
            _solve_under(g, lens)
        first, submaps = len(out.keyframes), 1 + max(out.submap_of.values(), default=-1)
        out.keyframes += [replace(kf, id=kf.id + first) for kf in g.keyframes]
        out.variables |= {k + first: v for k, v in g.variables.items()}
        out.edges += [replace(e, i=e.i + first, j=e.j + first) for e in g.edges]
        out.submap_of |= {k + first: s + submaps for k, s in g.submap_of.items()}
        out.started |= {s + submaps for s in g.started}
        out.loops += g.loops
        records.append([replace(r, kf_id=r.kf_id + first) for r in g.records])
        out.records += records[-1]
        pieces.append(range(first, len(out.keyframes)))
    out.submap = min(out.started, default=0)
    return Merged(out, pieces, records)


def _solve_under(graph: KeyframeGraph, lens: Intrinsics) -> None:
    graph.set_intrinsics(as_given(lens))
    for kernel_px, iterations in UNDER_ONE_LENS:
        graph.solve_all(iterations, kernel_px)


def join_at_overlaps(merged: Merged) -> list[Joint]:
    """Bring pieces that share frames into one world, the first's; which were, and how well the frames agree.

    What the frames do not agree on stays apart: it may still be recognised.
    """
    joints = []
    for before in range(len(merged.pieces)):
        for after in range(before + 1, len(merged.pieces)):
            shared = _shared(merged.graph, merged.records[before], merged.records[after])
            for (keep, gone), pairs in sorted(shared.items(), key=lambda item: -len(item[1])):
                found = _agreed(merged.graph, pairs)
                if found is None:
                    continue
                keep_from_gone, turn, shift = found
                joints.append(Joint(before, after, len(pairs), keep_from_gone.scale, turn, shift))
                log.info("pieces %d and %d joined by %d frames: scale %.4f, %.2f deg, %.1f %% of the depth apart",
                         before, after, len(pairs), keep_from_gone.scale, np.degrees(turn), 100 * shift)  # fmt: skip
                bring(merged.graph, gone, keep, keep_from_gone)
                break  # of further pairs of submaps one may be the same by now; they are recognised, if at all
    return joints


def _shared(
    graph: KeyframeGraph, before: list[FrameRecord], after: list[FrameRecord]
) -> dict[tuple[int, int], list[tuple[FrameRecord, FrameRecord]]]:
    """Frames that both have tracked, by their submaps; without those that are in one already."""
    if not before or not after or before[-1].index < after[0].index:
        return {}
    first = {r.index: r for r in before if r.state in MEASURED}
    pairs: dict[tuple[int, int], list[tuple[FrameRecord, FrameRecord]]] = {}
    for r in after:
        if r.index in first and r.state in MEASURED:
            submaps = graph.submap_of[first[r.index].kf_id], graph.submap_of[r.kf_id]
            if set(submaps) <= graph.started and submaps[0] != submaps[1]:
                pairs.setdefault(submaps, []).append((first[r.index], r))
    return pairs


def _agreed(graph: KeyframeGraph, pairs: list[tuple[FrameRecord, FrameRecord]]) -> tuple[Sim3, float, float] | None:
    """From the world of the second of each pair to that of the first; median turn and shift of what is left.

    Scale: the median ratio of the depths that both give to the same pixels of a frame. Rotation: the mean of the
    frames' within twice the median of their distance to the one that is nearest to all. Translation: the median.
    """
    ratios = [ratio for a, b in pairs if (ratio := _depth_ratio(graph, a, b)) is not None]
    if len(pairs) < MIN_FRAMES or len(ratios) < MIN_FRAMES:
        return None
    scale = float(np.median(ratios))
    poses = [(_pose(graph, a), _pose(graph, b)) for a, b in pairs]
    turns = np.stack([a[:3, :3] @ b[:3, :3].T for a, b in poses])
    rotation = _mean_rotation(turns)
    shifts = np.stack([a[:3, 3] - scale * rotation @ b[:3, 3] for a, b in poses])
    translation = np.median(shifts, axis=0)
    depth = 1 / float(np.median([graph.median_inv_depth(k) for k in {a.kf_id for a, _ in pairs}]))
    turn = float(np.median([np.linalg.norm(so3_log(r @ rotation.T)) for r in turns]))
    shift = float(np.median(np.linalg.norm(shifts - translation, axis=1))) / depth
    if turn > MAX_TURN or shift > MAX_SHIFT:
        log.info(
            "%d shared frames do not agree: %.1f deg, %.0f %% of the depth", len(pairs), np.degrees(turn), 100 * shift
        )
        return None
    return Sim3(rotation, translation, scale), turn, shift


def _pose(graph: KeyframeGraph, record: FrameRecord) -> Array:
    """world_from_cam (4, 4) of a frame."""
    return inverse(record.cam_from_kf @ graph.variables[record.kf_id].cam_from_world)


def _mean_rotation(turns: Array) -> Array:
    distance = np.array([[np.linalg.norm(so3_log(a @ b.T)) for b in turns] for a in turns])
    middle = int(np.argmin(np.median(distance, axis=1)))
    near = distance[middle] <= 2 * np.median(distance[middle]) + 1e-9
    return so3_exp(np.mean([so3_log(r @ turns[middle].T) for r in turns[near]], axis=0)) @ turns[middle]


def _depth_ratio(graph: KeyframeGraph, a: FrameRecord, b: FrameRecord) -> float | None:
    """Median depth of a's points over that of b's nearest, in the one frame; None where too few are near."""
    (px_a, depth_a), (px_b, depth_b) = _depths(graph, a), _depths(graph, b)
    if min(len(px_a), len(px_b)) < MIN_POINTS:
        return None
    distance, nearest = cKDTree(px_b).query(px_a)
    near = np.flatnonzero(np.asarray(distance) < SAME_PX)
    ratios = depth_a[near] / depth_b[np.asarray(nearest)[near]]
    return float(np.median(ratios)) if len(near) >= MIN_POINTS else None


def _depths(graph: KeyframeGraph, record: FrameRecord) -> tuple[Array, Array]:
    """(m, 2) pixels of a frame and their depths (m,), as its keyframe knows them."""
    v = graph.variables[record.kf_id]
    points = np.arange(len(v.px)) if record.is_keyframe else record.points
    known = depth_confidence(v.inv_depth, graph.depth_info(record.kf_id))[points] > 0.5
    points = points[known]
    cam = transform(record.cam_from_kf, graph.camera().unproject(v.px[points], np.maximum(v.inv_depth[points], 1e-9)))
    px = v.px[points] if record.is_keyframe else record.target[known].astype(float)
    front = cam[:, 2] > 0
    return px[front], cam[front, 2]


def one_record_a_frame(merged: Merged) -> None:
    """Of the records that pieces have of a frame one is left: a keyframe's, else that of the piece it is deeper in."""
    best: dict[int, tuple[tuple[bool, bool, int], FrameRecord]] = {}
    for records in merged.records:
        for n, r in enumerate(records):
            worth = (r.state in MEASURED, r.is_keyframe, min(n, len(records) - 1 - n))
            if r.index not in best or worth > best[r.index][0]:
                best[r.index] = worth, r
    merged.graph.records = [best[index][1] for index in sorted(best)]


def with_lost_frames(graph: KeyframeGraph, frames: Iterable[tuple[int, float]]) -> int:
    """Frames (index, seconds) that the graph knows nothing of become lost ones; how many."""
    known = {r.index for r in graph.records}
    missing = [FrameRecord(n, t, 0, np.eye(4), "lost", **NOTHING) for n, t in frames if n not in known]
    graph.records = sorted([*graph.records, *missing], key=lambda r: r.index)
    return len(missing)
