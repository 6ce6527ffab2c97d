"""Submaps: pieces of a trajectory with a world and a scale of their own, and how they become one again."""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from ..geometry.sim3 import Sim3
from ..types import USABLE_WEIGHT, Matches
from .depth import depth_confidence
from .keyframe_graph import KeyframeGraph

Array = NDArray[Any]
MIN_COMMON = 20  # matches whose depth is known on both sides, for a scale


def with_scale(graph: KeyframeGraph, i: int, j: int, j_from_i: Array, matches: Matches, weight: Array) -> Sim3 | None:
    """A pose between two submaps as a similarity: the median ratio of matched depths; None where too few are known.

    ``j_from_i`` (4, 4) in i's lengths; ``matches`` of i's pixels in j, ``weight`` (p,). What is returned takes points
    of camera i, in the lengths of its submap, to those of camera j in the lengths of the other.
    """
    a, b, grid = graph.variables[i], graph.variables[j], graph.keyframes[j].work.grid
    known_a = depth_confidence(a.inv_depth, graph.depth_info(i)) > 0.5
    points = graph.camera().unproject(a.px, np.maximum(a.inv_depth, 1e-9))
    depth = points @ j_from_i[2, :3] + j_from_i[2, 3]
    cell_px = min(graph.size[0] // grid[1], graph.size[1] // grid[0])
    at = matches.new_px / cell_px - 0.5 + 0.5 / cell_px
    xy = at.astype(np.float32)[:, None]
    inv_b = cv2.remap(b.inv_depth.reshape(grid).astype(np.float32), xy, None, cv2.INTER_NEAREST)[:, 0]
    confidence_b = depth_confidence(b.inv_depth, graph.depth_info(j)).reshape(grid).astype(np.float32)
    known_b = cv2.remap(confidence_b, xy, None, cv2.INTER_NEAREST)[:, 0] > 0.5
    used = known_a & known_b & (weight > USABLE_WEIGHT) & (depth > 0) & (inv_b > 0)
    if used.sum() < MIN_COMMON:
        return None
    return Sim3.from_rigid(j_from_i).in_lengths(1 / float(np.median(depth[used] * inv_b[used])))


def join(graph: KeyframeGraph, i: int, j: int, j_from_i: Sim3) -> None:
    """Bring j's submap into the world of i's; they are one from here on. A saved map stays where it is.

    ``j_from_i``: from points of camera i, in the lengths of its submap, to those of camera j in the lengths of its own.
    """
    if graph.held and graph.submap_of[j] == 0:
        return join(graph, j, i, j_from_i.inverse())
    keep, gone = graph.submap_of[i], graph.submap_of[j]
    if graph.held and keep == 0:
        graph.found_in_map(graph.records[-1].index)
    bring(graph, gone, keep, world_from_seen(graph, i, j, j_from_i))


def world_from_seen(graph: KeyframeGraph, i: int, j: int, j_from_i: Sim3) -> Sim3:
    """From where j is, to where i sees it: what hangs together with j is moved by it. ``j_from_i`` as for ``join``."""
    cam_i, cam_j = (Sim3.from_rigid(graph.variables[k].cam_from_world) for k in (i, j))
    return cam_i.inverse() @ j_from_i.inverse() @ cam_j


def bring(graph: KeyframeGraph, gone: int, keep: int, keep_from_gone: Sim3) -> None:
    """Bring a submap into the world of another one; they are one from here on."""
    moved = graph.members(gone)
    graph.transform_keyframes(moved, keep_from_gone)
    for k in moved:
        graph.submap_of[k] = keep
    graph.started.discard(gone)
    if graph.submap == gone:
        graph.submap = keep
