"""The static cloud: keyframe points that stand still and that something supports."""

from __future__ import annotations

import logging
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..graph.depth import depth_confidence, inpainted
from ..graph.keyframe_graph import KeyframeGraph
from ..types import StaticCloud

Array = NDArray[Any]
log = logging.getLogger(__name__)


@dataclass(frozen=True)
class PlacedPoints:
    """The points of one keyframe in the world."""

    points_world: Array  # (p, 3)
    depth: Array  # (p,) along the keyframe's axis
    own_confidence: Array  # (p,) 0..1, how well the pixel's own depth is known
    confidence: Array  # (p,) 0..1, also where the depth is that of the neighbours
    keep: Array  # (p,) bool: it stands still, and something supports it


def static_cloud(graph: KeyframeGraph, colors: dict[int, Array], moving: dict[int, Array]) -> StaticCloud:
    """Fused static points of the keyframes in ``colors``: (p, 3) uint8 at each keyframe's px; ``moving`` (p,).

    Moving points and points without support are pruned. A pixel whose own depth is unsure stands at its
    neighbours' depth, with the confidence halved.
    """
    parts = []
    for k, color in colors.items():
        placed = placed_points(graph, k, moving[k])
        keep = placed.keep
        cell = graph.size[0] / graph.keyframes[k].work.grid[1]
        parts.append(
            (
                placed.points_world[keep],
                color[keep],
                placed.confidence[keep],
                (placed.depth * cell / graph.camera().fx_px)[keep],
                np.full(int(keep.sum()), k),
            )
        )
    if not parts:
        return StaticCloud(np.zeros((0, 3), np.float32), np.zeros((0, 3), np.uint8), *_no_points())
    points, color, confidence, spacing, kf_id = (np.concatenate(c) for c in zip(*parts, strict=True))
    return StaticCloud(
        points.astype(np.float32),
        color.astype(np.uint8),
        confidence.astype(np.float32),
        spacing.astype(np.float32),
        kf_id.astype(np.int32),
    )


def placed_points(graph: KeyframeGraph, kf_id: int, moving: Array) -> PlacedPoints:
    """The points of a keyframe's px, ``moving`` (p,) P(moving) of each."""
    v, grid = graph.variables[kf_id], graph.keyframes[kf_id].work.grid
    info = graph.depth_info(kf_id)
    own = depth_confidence(v.inv_depth, info)
    inv_depth = inpainted(v.inv_depth, info, grid)
    support = inpainted(np.maximum(own, 1e-3), np.full(len(own), 1e12), grid)
    confidence = np.where(own > 0.5, own, 0.5 * support) * (1 - moving)
    keep = (confidence > 0.05) & (moving < 0.5) & (inv_depth > 0.02 * np.median(inv_depth))
    depth = 1 / np.maximum(inv_depth, 1e-9)
    points_cam = graph.camera().rays(v.px) * depth[:, None]
    pose = graph.world_from_cam(kf_id)
    return PlacedPoints(points_cam @ pose[:3, :3].T + pose[:3, 3], depth, own, confidence, keep)


def _no_points() -> tuple[Array, Array, Array]:
    return np.zeros(0, np.float32), np.zeros(0, np.float32), np.zeros(0, np.int32)
