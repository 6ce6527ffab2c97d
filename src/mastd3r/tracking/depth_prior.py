"""First depths of a keyframe, and what its own measurements say of the solved ones."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..geometry.se3 import inverse
from ..graph.depth import carried
from ..graph.keyframe_graph import KeyframeGraph
from ..pointmap.geometric import sample_own
from ..types import WorkFrame

Array = NDArray[Any]


def own_depth_prior(work: WorkFrame, scale: float, sigma_ratio: float | None) -> tuple[Array, Array]:
    """(p,) inverse depths that the frame measured itself, and their information; ones, unknown, where it did not.

    ``scale`` brings the frame's own lengths to the graph's.
    """
    own = sample_own(work, work.px) / scale
    known = own > 0
    if sigma_ratio is None or not known.any():
        return np.ones(len(work.px)), np.full(len(work.px), 1e-2)
    inv_depth = np.where(known, own, float(np.median(own[known])))
    info = np.where(known, 1 / (sigma_ratio * inv_depth) ** 2, 1e-2 / inv_depth**2)
    return inv_depth, info


def own_depth_spread(graph: KeyframeGraph) -> float | None:
    """Relative 1-sigma of the keyframes' own depths against the solved ones; None where fewer than 200 can tell.

    Only depths that matches alone fix to 5 % (one pixel of noise) are compared. A solved depth leans on the own one as
    much as its prior weighs: that is undone. Each frame's own scale is taken out, and the spread is that of the median
    deviation: what ``depth_sigma_ratio`` of a provider should be.
    """
    found = []
    for kf in graph.keyframes:
        v = graph.variables[kf.id]
        if kf.work.own_inv_depth is None or len(v.depth_info) == 0:
            continue
        own = sample_own(kf.work, v.px)
        sure = (own > 0) & (v.inv_depth > 0) & (v.depth_info * v.inv_depth**2 > 1 / 0.05**2)
        if sure.sum() >= 20:
            ratio = np.log(own[sure] / v.inv_depth[sure])
            leaning = 1 + v.prior_info[sure] / v.depth_info[sure]
            found.append(leaning * np.abs(ratio - np.median(ratio)))
    away = np.concatenate(found) if found else np.zeros(0)
    return 1.4826 * float(np.median(away)) if len(away) >= 200 else None


def predicted_depth(
    graph: KeyframeGraph,
    kf_id: int,
    cam_from_world: Array,
    work: WorkFrame,
    scale: float,
    sigma_ratio: float | None,
) -> tuple[Array, Array]:
    """First inverse depths (p,) and information of a new keyframe: its own where measured, carried over otherwise."""
    v = graph.variables[kf_id]
    if not graph.initialised:
        return np.ones(len(work.px)), np.full(len(work.px), 1e-2)
    new_from_ref = cam_from_world @ inverse(v.cam_from_world)
    value, _ = carried(v.px, v.inv_depth, graph.depth_info(kf_id), new_from_ref, graph.camera(), work.px)
    median = float(np.median(value))
    value = np.clip(value, 0.01 * median, 100 * median)
    info = np.full(len(value), 1e-3 / median**2)
    if sigma_ratio is not None:
        own, own_info = own_depth_prior(work, scale, sigma_ratio)
        measured = sample_own(work, work.px) > 0
        value, info = np.where(measured, own, value), np.where(measured, own_info, info)
    return value, info
