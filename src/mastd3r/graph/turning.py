"""A camera that only turns: the graph with all points at infinity, where rotations and the lens are all there is.

With inverse depths of 0 the joint optimisation has no translation: x' = K R K⁻¹ x, with the lens bent as ever. So one
solver serves both, and its lens is calibrated by the turn.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..geometry.reprojection_kernels import edge_residuals
from ..geometry.se3 import inverse
from ..types import USABLE_WEIGHT
from .bundle_adjustment import solve
from .factors import KeyframeVariables, ReprojectionFactor, Variables, thinned_edge
from .intrinsics import HELD_AT_FIRST, Intrinsics
from .keyframe_graph import KeyframeGraph
from .observability import MODEL_ERROR_RATIO, Observability, PairMotion, observability

Array = NDArray[Any]
STEPS = ((50.0, 10), (8.0, 10), (2.0, 15), (0.5, 15))  # kernel in pixels, and iterations
HOPELESS = 0.5  # share of the matches within 5 model errors after the first two, below: it is no rotation
MOST_POINTS = 3000  # over all keyframes, for a decision
APART = 3  # keyframes that a pair lies apart at most, for the same
FOCAL_BELIEVED = 2.5  # focal / sqrt(width * height): under a longer one a shift looks like a turn


def observed(graph: KeyframeGraph, ids: Sequence[int]) -> tuple[Observability, list[PairMotion]]:
    """What the matches between some keyframes let be known, and what rotation alone leaves of each pair."""
    variables, edges = _thinned(graph, ids)
    intrinsics = _lens_before(graph)
    if edges:
        _turn(variables, edges, intrinsics, graph.size)
    pairs = [_pair(variables, e, intrinsics) for e in edges]
    found = observability(pairs, graph.size)
    too_long = np.exp(intrinsics.values[0]) > FOCAL_BELIEVED * np.sqrt(graph.size[0] * graph.size[1])
    if found.kind == "rotation" and too_long and intrinsics.free[0]:
        found = replace(found, kind="plane")
    return found, pairs


def turned(graph: KeyframeGraph) -> dict[int, Array]:
    """cam_from_first (4, 4), of rotation alone, of every keyframe: what explains most image motion without depth."""
    variables, edges = _thinned(graph, graph.members())
    if edges:
        _turn(variables, edges, _lens_before(graph), graph.size)
    return {k: v.cam_from_world for k, v in variables.items()}


def put_at_infinity(graph: KeyframeGraph) -> None:
    """Keyframes of the submap being tracked turn about one place, every point is at infinity; the lens is theirs."""
    ids = graph.members()
    variables, edges = _at_infinity(graph, ids, 1), graph.edges_among(ids)
    intrinsics = _lens_before(graph)
    _turn(variables, edges, intrinsics, graph.size)
    graph.set_intrinsics(replace(graph.intrinsics, values=intrinsics.values))
    for k, v in variables.items():
        graph.set_keyframe_pose(k, v.cam_from_world)
        graph.set_depths(k, v.inv_depth)
        graph.hold_depths(k, v.prior_info)
        graph.forget_matched_depths(k)
    graph.started.add(graph.submap)


def _lens_before(graph: KeyframeGraph) -> Intrinsics:
    """The lens before anything is seen; what few views cannot tell apart is held."""
    known = graph.intrinsics
    info = known.prior_info.copy()
    info[list(HELD_AT_FIRST)] = np.inf
    values = np.where(known.free, known.prior, known.values)
    return Intrinsics(values, values.copy(), info)


def _thinned(graph: KeyframeGraph, ids: Sequence[int]) -> tuple[Variables, list[ReprojectionFactor]]:
    """Keyframes with some of their points at infinity, and the edges between near ones."""
    count = sum(len(graph.variables[k].px) for k in ids)
    step = max(1, round(count / MOST_POINTS))
    place = {k: n for n, k in enumerate(ids)}
    edges = [e for e in graph.edges_among(ids) if abs(place[e.i] - place[e.j]) <= APART]
    return _at_infinity(graph, ids, step), [thinned_edge(e, step) for e in edges]


def _at_infinity(graph: KeyframeGraph, ids: Sequence[int], step: int) -> Variables:
    out = {}
    for k in ids:
        px = graph.variables[k].px[::step].copy()  # kernels are compiled for arrays without gaps
        none = np.zeros(len(px))
        out[k] = KeyframeVariables(px, none, none.copy(), np.ones(len(px)), np.eye(4))
    return out


def _turn(variables: Variables, edges: list[ReprojectionFactor], intrinsics: Intrinsics, size: tuple[int, int]) -> None:
    """Rotations and lens, from none and the usual one; given up where they explain too little."""
    first = frozenset([min(variables)])
    for n, (kernel_px, iterations) in enumerate(STEPS):
        if n == 2 and _near_share(variables, edges, intrinsics, size) < HOPELESS:
            return
        solve(variables, edges, intrinsics, fixed=first, iterations=iterations, kernel_px=kernel_px)


def _near_share(
    variables: Variables, edges: list[ReprojectionFactor], intrinsics: Intrinsics, size: tuple[int, int]
) -> float:
    bound_px = 5 * MODEL_ERROR_RATIO * float(np.sqrt(size[0] * size[1]))
    pairs = [_pair(variables, e, intrinsics) for e in edges]
    shares = [(np.linalg.norm(p.off_turn_px, axis=1) < bound_px).mean() for p in pairs if len(p.ref_px)]
    return float(np.median(shares)) if shares else 0.0


def _pair(variables: Variables, edge: ReprojectionFactor, intrinsics: Intrinsics) -> PairMotion:
    v, used = variables[edge.i], edge.weight > USABLE_WEIGHT
    j_from_i = variables[edge.j].cam_from_world @ inverse(v.cam_from_world)
    residual, _ = edge_residuals(v.px, v.inv_depth, edge.target.astype(float), j_from_i, intrinsics.values)
    return PairMotion(edge.i, edge.j, v.px[used], edge.target[used].astype(float), residual[used])
