"""How far matches are from where poses, depths and lens put them."""

from __future__ import annotations

import logging
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..geometry.reprojection_kernels import edge_residuals
from ..geometry.se3 import inverse
from .factors import ReprojectionFactor
from .keyframe_graph import KeyframeGraph

Array = NDArray[Any]
log = logging.getLogger(__name__)
MOST = 1_000_000  # matches that are looked at
LARGEST_PX2 = 4.0
MEDIAN_OF_TWO = 2 * float(np.log(2))  # of r² where both coordinates are normal with variance 1


def squared_residuals(graph: KeyframeGraph, edge: ReprojectionFactor) -> Array:
    """(p,) px², of all points of an edge's anchor; those without a match have weight 0."""
    v = graph.variables[edge.i]
    j_from_i = graph.variables[edge.j].cam_from_world @ inverse(v.cam_from_world)
    off, _ = edge_residuals(v.px, v.inv_depth, edge.target.astype(float), j_from_i, graph.intrinsics.values)
    return np.asarray((off**2).sum(1))


def learn_match_variance(graph: KeyframeGraph) -> None:
    """Keep what ``match_variance_px2`` gives: from now on all solves weigh a speed that goes on against it.

    Not before there are poses and depths: matches are then as far off as things have moved.
    """
    if not graph.started:
        return
    graph.match_variance_px2 = match_variance_px2(graph)
    log.info("matches are off by %.2f px (1 sigma)", graph.match_variance_px2**0.5)


def match_variance_px2(graph: KeyframeGraph) -> float:
    """Variance of a coordinate of the matches' residuals, from their weighted median; 1 where there are none.

    Only in submaps that have poses and depths. Nearly half of the matches may be of things that move; of many every
    n-th is looked at. ``LARGEST_PX2`` at the most: beyond, what is off are the poses.
    """
    edges = [e for e in graph.edges if graph.submap_of[e.i] in graph.started]
    step = 1 + sum(len(e.weight) for e in edges) // MOST
    squares = np.concatenate([np.zeros(0), *(squared_residuals(graph, e)[::step] for e in edges)])
    weights = np.concatenate([np.zeros(0), *(e.weight[::step] for e in edges)])
    if not weights.sum() > 0:
        return 1.0
    order = np.argsort(squares)
    below = np.cumsum(weights[order])
    return min(float(squares[order[np.searchsorted(below, below[-1] / 2)]]) / MEDIAN_OF_TWO, LARGEST_PX2)
