"""Depth between the stages: what a view is expected to see, and the flow that follows from it."""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from .dynamics.data import DynamicsInput
from .dynamics.flow import HalfFlow
from .geometry.se3 import inverse, transform
from .graph.depth import carried, filled, upsampled
from .graph.keyframe_graph import KeyframeGraph
from .pointmap.geometric import sample_own
from .types import WorkFrame

Array = NDArray[Any]


def static_at(moving: Array, px: Array) -> Array:
    """(p,) P(static) at pixels of a P(moving) map (h, w); the nearest pixel inside counts."""
    x = np.clip(np.round(px[:, 0]).astype(int), 0, moving.shape[1] - 1)
    y = np.clip(np.round(px[:, 1]).astype(int), 0, moving.shape[0] - 1)
    return 1.0 - moving[y, x].astype(float)


def grown(moving: Array, by_px: int = 5) -> Array:
    """P(moving) of the worst pixel within ``by_px``: a match's window there sees the moving thing too."""
    return cv2.dilate(moving.astype(np.float32), np.ones((2 * by_px + 1, 2 * by_px + 1), np.uint8))


def invert_flow(flow: Array, grid_px: Array) -> Array:
    """Approximate flow new -> ref from flow ref -> new: one fixed-point step."""
    return -cv2.remap(flow, grid_px - flow, None, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)


def chained_flow(first: Array, second: Array, grid_px: Array) -> Array:
    """Flow a -> c from a -> b and b -> c."""
    return first + cv2.remap(second, grid_px + first, None, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)


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
        block = graph.blocks[kf.id]
        if kf.work.own_inv_depth is None or len(block.depth_info) == 0:
            continue
        own = sample_own(kf.work, block.px)
        sure = (own > 0) & (block.inv_depth > 0) & (block.depth_info * block.inv_depth**2 > 1 / 0.05**2)
        if sure.sum() >= 20:
            ratio = np.log(own[sure] / block.inv_depth[sure])
            leaning = 1 + block.prior_info[sure] / block.depth_info[sure]
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
    block = graph.blocks[kf_id]
    if not graph.initialised:
        return np.ones(len(work.px)), np.full(len(work.px), 1e-2)
    new_from_ref = cam_from_world @ inverse(block.cam_from_world)
    value, _ = carried(block.px, block.inv_depth, graph.depth_info(kf_id), new_from_ref, graph.camera(), work.px)
    median = float(np.median(value))
    value = np.clip(value, 0.01 * median, 100 * median)
    info = np.full(len(value), 1e-3 / median**2)
    if sigma_ratio is not None:
        own, own_info = own_depth_prior(work, scale, sigma_ratio)
        measured = sample_own(work, work.px) > 0
        value, info = np.where(measured, own, value), np.where(measured, own_info, info)
    return value, info


def rigid_flow(graph: KeyframeGraph, i: int, j: int) -> Array:
    """(h, w, 2) flow i -> j that the graph's poses and depths predict."""
    return rigid_flow_to(graph, i, graph.blocks[j].cam_from_world)


def rigid_flow_to(graph: KeyframeGraph, i: int, cam_from_world: Array) -> Array:
    """(h, w, 2) flow of a static scene from keyframe i into a view; computed a cell, interpolated between."""
    kf, block, camera = graph.keyframes[i], graph.blocks[i], graph.camera()
    inv_depth = filled(block.inv_depth, graph.depth_info(i), kf.work.grid)
    centres = cell_centres(kf.work.grid, *graph.size)
    j_from_i = cam_from_world @ inverse(block.cam_from_world)
    points = transform(j_from_i, camera.rays(centres) / np.maximum(inv_depth, 1e-6)[:, None])
    points[:, 2] = np.maximum(points[:, 2], 1e-2 / float(np.median(inv_depth)))
    limit = 2.0 * max(graph.size)
    flow = np.clip(camera.project(points) - centres, -limit, limit)
    return cv2.merge([upsampled(flow[:, n], kf.work.grid, *graph.size) for n in (0, 1)])


def cell_centres(grid: tuple[int, int], width: int, height: int) -> Array:
    """(p, 2) pixel centres of the cells, row by row."""
    cell_px = min(width // grid[1], height // grid[0])
    y, x = np.divmod(np.arange(grid[0] * grid[1]), grid[1])
    return np.stack([x, y], 1) * cell_px + (cell_px - 1) / 2


def dynamics_input(
    graph: KeyframeGraph,
    kf_id: int,
    world_from_cam: Array,
    work: WorkFrame,
    scale: float,
    features: Array | None = None,
) -> DynamicsInput:
    """What the mask is told of a frame: pose, expected static depth with its 1-sigma, own depth, semantics, looks."""
    block, camera = graph.blocks[kf_id], graph.camera()
    new_from_ref = inverse(world_from_cam) @ inverse(block.cam_from_world)
    value, trusted = carried(block.px, block.inv_depth, graph.depth_info(kf_id), new_from_ref, camera, work.px)
    sigma = 0.1 * value * np.sqrt(1 / np.maximum(trusted, 1e-4) - 1) + 0.02 * value
    own = None if work.own_inv_depth is None else work.own_inv_depth / np.float32(scale)
    return DynamicsInput(
        work.index,
        work.timestamp_s,
        work.gray,
        camera,
        world_from_cam,
        upsampled(value, work.grid, *graph.size),
        upsampled(sigma, work.grid, *graph.size),
        own,
        work.semantic,
        features=features,
    )


GREY_DOUBT = 12.0  # grey levels; where a static scene explains the photograph better than this, flow has no say
GREY_WRONG = 36.0  # where neither a static scene nor the flow comes nearer than this, there is no match


def reprojection_residual_px(
    graph: KeyframeGraph,
    kf_ids: list[int],
    world_from_cam: Array,
    gray: Array,
    inv_depth: Array,
    flow: HalfFlow,
    unmatched_px: float,
) -> Array:
    """(h, w) float32, at ``flow``'s size, in pixels of the working image: sqrt e(p) of eq. (15), for every pixel.

    A pixel is carried into a keyframe by its expected depth and its final pose; flow then says where its match is
    in truth. On blank walls flow slides: a residual counts only where the carried grey values (5 x 5) differ too.
    Where the flow's do as well there is no match, and the residual is ``unmatched_px``.
    The least over the keyframes counts, as each hides something from the others. A keyframe does not see what
    stands behind a moving thing of its own; 0 where none sees the pixel.
    """
    size = (flow.grid.shape[1], flow.grid.shape[0])
    camera, ratio = graph.camera().resized(*size), graph.size[0] / size[0]
    small = cv2.resize(gray, size, interpolation=cv2.INTER_AREA)
    near = np.maximum(cv2.resize(inv_depth, size, interpolation=cv2.INTER_NEAREST), 1e-9)
    points_cam = camera.rays(flow.grid) / near[..., None]
    least = np.full(small.shape, np.inf, np.float32)
    for kf_id in kf_ids:
        points_kf = transform(graph.blocks[kf_id].cam_from_world @ world_from_cam, points_cam)
        seen = points_kf[..., 2] > 0
        target = camera.project(np.where(seen[..., None], points_kf, 1.0)).astype(np.float32)
        seen &= (target >= 0).all(-1) & (target[..., 0] <= size[0] - 1) & (target[..., 1] <= size[1] - 1)
        covered = cv2.dilate(cv2.resize(graph.keyframes[kf_id].moving, size), np.ones((9, 9), np.uint8))
        seen &= flow.warp(covered, target) < 128
        kf_gray = cv2.resize(graph.keyframes[kf_id].work.gray, size, interpolation=cv2.INTER_AREA)
        carried_gray = flow.warp(kf_gray, target)
        left = flow.between(small, carried_gray)
        gain = float(small[seen].mean() / max(carried_gray[seen].mean(), 1.0)) if seen.any() else 1.0
        as_static, as_flow = (
            cv2.blur(np.abs(small - np.float32(gain) * image), (5, 5))
            for image in (carried_gray, flow.warp(carried_gray, flow.grid + left))
        )
        residual = np.where(as_flow > GREY_WRONG, unmatched_px, ratio * np.hypot(left[..., 0], left[..., 1]))
        residual = residual * (as_static > GREY_DOUBT)
        least = np.minimum(least, np.where(seen, residual, np.inf))
    return np.where(np.isfinite(least), least, 0).astype(np.float32)
