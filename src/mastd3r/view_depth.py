"""Depth between the stages: what a view is expected to see, and the flow that follows from it."""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from .dynamics.data import DynamicsInput
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
