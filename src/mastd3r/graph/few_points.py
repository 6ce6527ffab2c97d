"""A part of a chain on a few points of each keyframe: what a decision is made on before all points are asked.

A solve on them costs a fraction of one on all, and they tell the same minima apart.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from .factors import KeyframeVariables, thinned_edge
from .intrinsics import Intrinsics, as_given
from .keyframe_graph import KeyframeGraph
from .windows import ALL_INTRINSICS, Window

Array = NDArray[Any]
State = dict[int, tuple[Array, Array]]  # cam_from_world (4, 4) and inverse depths of keyframes
MOST_POINTS = 300  # of a keyframe
KERNEL_PX = 0.5
DEPTH_PRIOR = 1e-3  # information of a depth's prior, times its square: weak


def thinned(graph: KeyframeGraph, ids: Sequence[int], points: int = MOST_POINTS) -> KeyframeGraph:
    """A graph of its own of some keyframes with some of their points; its lens is given."""
    step = max(1, max(len(graph.variables[k].px) for k in ids) // points)
    out = KeyframeGraph(graph.config, as_given(graph.intrinsics))
    out.size, out.submap, out.match_variance_px2 = graph.size, graph.submap, graph.match_variance_px2
    out.keyframes = [graph.keyframes[k] for k in ids]
    out.submap_of = dict.fromkeys(ids, graph.submap)
    for k in ids:
        v = graph.variables[k]
        inv_depth = v.inv_depth[::step]
        info = np.full(len(inv_depth), DEPTH_PRIOR / float(np.median(v.inv_depth)) ** 2)
        px = v.px[::step].copy()  # kernels are compiled for arrays without gaps
        out.variables[k] = KeyframeVariables(px, inv_depth.copy(), inv_depth.copy(), info, v.cam_from_world)
    out.edges = [thinned_edge(e, step) for e in graph.edges_among(ids)]
    return out


def chain_of_few(graph: KeyframeGraph, ids: Sequence[int], points: int = MOST_POINTS) -> KeyframeGraph:
    """``thinned``, where a speed that goes on weighs as much beside the matches as on all points."""
    part = thinned(graph, ids, points)
    share = sum(len(v.px) for v in part.variables.values()) / sum(len(graph.variables[k].px) for k in ids)
    part.config = replace(part.config, steady_speed=share * graph.config.steady_speed)
    return part


def solved(
    part: KeyframeGraph,
    steps: Sequence[tuple[float, int]],
    held: int = 0,
    tolerance: float = 1e-4,
    widest_steady_px: float = KERNEL_PX,
) -> float:
    """The cost after steps of (kernel in pixels, iterations); the first keyframe stays, and those before ``held``.

    ``widest_steady_px``: kernel up to which a speed that goes on is the likelier; not of a start, where all may be at
    one place.
    """
    cost, still = np.inf, frozenset([min(part.variables), *(k for k in part.variables if k < held)])
    for kernel_px, iterations in steps:
        steady = kernel_px <= widest_steady_px
        window = Window(list(part.variables), part.edges, still, ALL_INTRINSICS, steady=steady)
        cost = part.optimise(window, iterations, kernel_px, tolerance).cost_last
    return cost


def state_of(graph: KeyframeGraph) -> State:
    """Poses and inverse depths of all keyframes, as they are now."""
    return {k: (v.cam_from_world.copy(), v.inv_depth.copy()) for k, v in graph.variables.items()}


def put_back(graph: KeyframeGraph, state: State, lens: Intrinsics) -> None:
    """Poses and inverse depths as ``state_of`` gave them, and the intrinsics of then."""
    graph.set_intrinsics(lens)
    for k, (pose, inv_depth) in state.items():
        graph.set_keyframe_pose(k, pose)
        graph.set_depths(k, inv_depth)


def at_all_points(px: Array, thinned: Array) -> Array:
    """(p,) values at ``px`` (p, 2) from those of every n-th of them: the nearest one's."""
    step = -(-len(px) // len(thinned))
    return thinned[cKDTree(px[::step]).query(px)[1]]
