"""Which keyframes see the same by their poses: predicted overlap and image motion."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..geometry.se3 import inverse
from .keyframe_graph import KeyframeGraph

Array = NDArray[Any]
WITHIN_DEPTHS = (
    8.0  # of a keyframe's typical depth a view may be away that sees the same: farther, patches do not match
)
FEW = 64  # keyframes that are all looked at
POINTS_STEP = 16  # of those that tell a typical depth


def nearby(graph: KeyframeGraph, ids: Sequence[int], cam_from_world: Array) -> list[int]:
    """Those of ``ids`` that a view may share something with, by distance alone: in a long video a few of many."""
    if len(ids) <= FEW:
        return list(ids)
    poses = np.stack([graph.variables[k].cam_from_world for k in ids])
    centres = -(poses[:, :3, :3].transpose(0, 2, 1) @ poses[:, :3, 3:])[..., 0]
    away = np.linalg.norm(centres - inverse(cam_from_world)[:3, 3], axis=1)
    typical = np.array([graph.variables[k].inv_depth[::POINTS_STEP].mean() for k in ids])
    return [k for k, near in zip(ids, away * typical <= WITHIN_DEPTHS, strict=True) if near]


def overlap(graph: KeyframeGraph, i: int, cam_from_world: Array) -> tuple[float, float]:
    """(share of keyframe i's points inside the view, their median image motion / width) under current poses."""
    share, motion = overlaps(graph, i, cam_from_world[None])
    return float(share[0]), float(motion[0])


def overlaps(graph: KeyframeGraph, i: int, cam_from_world: Array) -> tuple[Array, Array]:
    """The same for m views (m, 4, 4): shares (m,) and motions (m,), inf where nothing is in view."""
    v, camera = graph.variables[i], graph.camera().pinhole
    px = v.px[::4]
    points = camera.unproject(px, v.inv_depth[::4])
    view_from_ref = cam_from_world @ inverse(v.cam_from_world)
    moved = points @ view_from_ref[:, :3, :3].transpose(0, 2, 1) + view_from_ref[:, None, :3, 3]
    front = moved[..., 2] > 1e-3
    seen = camera.project(np.where(front[..., None], moved, 1.0).reshape(-1, 3)).reshape(*front.shape, 2)
    inside = front & (seen >= 0).all(2) & (seen[..., 0] < camera.width) & (seen[..., 1] < camera.height)
    moved_px = np.where(inside, np.linalg.norm(seen - px, axis=2), np.nan)
    motion = np.full(len(inside), np.inf)
    some = inside.any(1)
    motion[some] = np.nanmedian(moved_px[some], axis=1) / camera.width
    return inside.mean(1), motion


def covisible(graph: KeyframeGraph, kf_id: int, before: int, most: int, min_overlap: float) -> list[int]:
    """Keyframes older than ``before`` that see what kf_id sees, least image motion first, no two neighbours.

    All of a saved map are older; the one that kf_id was tracked from is connected already.
    """
    pose = graph.variables[kf_id].cam_from_world
    found = []
    older = [k for k in graph.members() if k < max(before, graph.held)]
    for k in nearby(graph, older, pose):
        if k < graph.held and graph.connected(k, kf_id):
            continue
        share, motion = overlap(graph, k, pose)
        if share >= min_overlap and motion < 0.5:
            found.append((motion, k))
    chosen: list[int] = []
    for _, k in sorted(found):
        if len(chosen) == most:
            break
        if all(abs(k - c) > 1 for c in chosen):
            chosen.append(k)
    return chosen


def nearest_keyframe(
    graph: KeyframeGraph, cam_from_world: Array, but: int, min_overlap: float, max_motion: float
) -> int | None:
    """The keyframe of the submap being tracked, other than ``but``, with the least image motion to a view."""
    best = None
    for k in nearby(graph, [k for k in graph.members() if k != but], cam_from_world):
        share, motion = overlap(graph, k, cam_from_world)
        if share >= min_overlap and motion <= max_motion and (best is None or motion < best[0]):
            best = (motion, k)
    return None if best is None else best[1]
