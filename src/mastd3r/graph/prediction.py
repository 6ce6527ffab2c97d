"""What the graph expects a view to see: the flow of its static scene."""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from ..geometry.se3 import inverse, transform
from .depth import inpainted, upsampled
from .keyframe_graph import KeyframeGraph

Array = NDArray[Any]


def rigid_flow(graph: KeyframeGraph, i: int, j: int) -> Array:
    """(h, w, 2) flow i -> j that the graph's poses and depths predict."""
    return rigid_flow_to(graph, i, graph.variables[j].cam_from_world)


def rigid_flow_to(graph: KeyframeGraph, i: int, cam_from_world: Array) -> Array:
    """(h, w, 2) flow of a static scene from keyframe i into a view; computed a cell, interpolated between."""
    kf, v, camera = graph.keyframes[i], graph.variables[i], graph.camera()
    inv_depth = inpainted(v.inv_depth, graph.depth_info(i), kf.work.grid)
    centres = cell_centres(kf.work.grid, *graph.size)
    j_from_i = cam_from_world @ inverse(v.cam_from_world)
    points = transform(j_from_i, camera.unproject(centres, np.maximum(inv_depth, 1e-6)))
    points[:, 2] = np.maximum(points[:, 2], 1e-2 / float(np.median(inv_depth)))
    limit = 2.0 * max(graph.size)
    flow = np.clip(camera.project(points) - centres, -limit, limit)
    return cv2.merge([upsampled(flow[:, n], kf.work.grid, *graph.size) for n in (0, 1)])


def cell_centres(grid: tuple[int, int], width: int, height: int) -> Array:
    """(p, 2) pixel centres of the cells, row by row."""
    cell_px = min(width // grid[1], height // grid[0])
    y, x = np.divmod(np.arange(grid[0] * grid[1]), grid[1])
    return np.stack([x, y], 1) * cell_px + (cell_px - 1) / 2
