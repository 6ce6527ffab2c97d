"""The first keyframes: lens and structure from nothing, by trying several focal lengths."""

from __future__ import annotations

import logging
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from ..geometry.reprojection import N_GLOBAL, edge_residuals
from ..geometry.se3 import inverse
from .bundle import Edge, Lens, solve
from .depth import carried
from .keyframe_graph import KeyframeGraph, camera_of

Array = NDArray[Any]
log = logging.getLogger(__name__)
MIN_AGREEMENT = 0.4  # of the matches, for a start to be believed
FIRST_PAIRS = 2  # pairs of keyframes that a start is tried from
FOCAL_RATIOS = (0.7, 0.95, 1.2, 1.5, 2.0)  # focal / sqrt(width * height), tried when the lens is not given


def bootstrap(whole: KeyframeGraph) -> bool:
    """Solve all keyframes of the submap being tracked. False where no start was found (too little parallax).

    Several first pairs and focal lengths are tried, each to the end; the start that explains the matches best is
    kept. World is the submap's first keyframe's camera. A lens that an earlier submap has found stays as it is.
    """
    graph = whole.part()
    if whole.started:
        graph.lens = Lens(whole.lens.g, whole.lens.g, np.full(N_GLOBAL, np.inf))
    ratios = FOCAL_RATIOS if graph.lens.free[0] else (None,)
    best: tuple[float, Array, dict[int, tuple[Array, Array]]] | None = None
    for pair in _first_pairs(graph):
        for ratio in ratios:
            lens = Lens(graph.lens.prior.copy(), graph.lens.prior, graph.lens.prior_info)
            if ratio is not None:
                lens.g[0] = np.log(ratio * np.sqrt(graph.size[0] * graph.size[1]))
            cost = _attempt(graph, lens, pair)
            log.info("start from %d-%d: focal %.0f px, cost %s", pair.i, pair.j, np.exp(lens.g[0]), cost)
            if cost is not None and (best is None or cost < best[0]):
                best = (cost, lens.g, {k: (b.cam_from_world, b.inv_depth) for k, b in graph.blocks.items()})
    if best is None:
        return False
    graph.lens.g = best[1]
    world_from_first = inverse(best[2][min(best[2])][0])
    for k, (pose, depth) in best[2].items():
        graph.blocks[k].cam_from_world, graph.blocks[k].inv_depth = pose @ world_from_first, depth
    agreeing = _agreement(graph)
    if agreeing < MIN_AGREEMENT:
        log.info("no start: only %.0f %% of the matches fit one camera and one static scene", 100 * agreeing)
        return False
    graph.normalise()
    whole.lens.g = graph.lens.g
    whole.started.add(whole.submap)
    log.info("started with %d keyframes, focal %.0f px at working size", len(graph.keyframes), np.exp(graph.lens.g[0]))
    return True


def _agreement(graph: KeyframeGraph) -> float:
    """Share of all weighted matches within 2 px of where poses and depths put them."""
    close = total = 0
    for e in graph.edges:
        block, used = graph.blocks[e.i], e.weight > 0.05
        j_from_i = graph.blocks[e.j].cam_from_world @ inverse(block.cam_from_world)
        residual, _ = edge_residuals(block.px, block.inv_depth, e.target, j_from_i, graph.lens.g)
        close += int((np.hypot(residual[:, 0], residual[:, 1])[used] < 2.0).sum())
        total += int(used.sum())
    return close / max(total, 1)


def _first_pairs(graph: KeyframeGraph) -> list[Edge]:
    """Pairs to start from: many matches and much image motion, best first."""

    def merit(edge: Edge) -> float:
        used = edge.weight > 0.05
        moved = np.linalg.norm(edge.target - graph.blocks[edge.i].px, axis=1)[used]
        return float(used.sum() * min(np.median(moved) / (0.05 * max(graph.size)), 1.5))

    forward = [e for e in graph.edges if e.i < e.j]
    return sorted(forward, key=merit, reverse=True)[:FIRST_PAIRS]


def _attempt(graph: KeyframeGraph, lens: Lens, pair: Edge) -> float | None:
    """Two views by the essential matrix, the others one by one, then all; the robust cost, None on failure."""
    _reset(graph)
    if not _two_view(graph, lens, pair):
        return None
    frozen = Lens(lens.g, lens.prior, np.full(N_GLOBAL, np.inf))
    done = [pair.i, pair.j]
    _solve_part(graph, frozen, done, frozenset([pair.i]), 15, 2.0)
    while len(done) < len(graph.keyframes):
        k = min((k for k in graph.blocks if k not in done), key=lambda k: min(abs(k - d) for d in done))
        nearest = min(done, key=lambda d: abs(k - d))
        graph.blocks[k].cam_from_world = graph.blocks[nearest].cam_from_world
        _carry(graph, lens, nearest, k)
        done.append(k)
        _solve_part(graph, frozen, done, frozenset(done[:-1]), 15, 4.0)
        _carry(graph, lens, nearest, k)
        _solve_part(graph, frozen, done, frozenset([pair.i]), 6, 2.0)
    only_focal = Lens(lens.g, lens.prior, np.where(np.arange(N_GLOBAL) == 0, lens.prior_info, np.inf))
    report = solve(
        graph.blocks, graph.edges, only_focal, fixed=frozenset([min(graph.blocks)]), iterations=25, kernel_px=1.0
    )
    lens.g = only_focal.g
    return report.cost_last if np.isfinite(report.cost_last) else None


def _solve_part(
    graph: KeyframeGraph, lens: Lens, ids: list[int], fixed: frozenset[int], iterations: int, kernel_px: float
) -> None:
    blocks = {k: graph.blocks[k] for k in ids}
    solve(blocks, graph.edges_among(ids), lens, fixed=fixed, iterations=iterations, kernel_px=kernel_px)


def _reset(graph: KeyframeGraph) -> None:
    for block in graph.blocks.values():
        block.cam_from_world = np.eye(4)
        block.inv_depth = np.ones(len(block.px))
        block.prior_depth = np.ones(len(block.px))
        block.prior_info = np.full(len(block.px), 1e-2)
        block.depth_info = np.zeros(0)


def _two_view(graph: KeyframeGraph, lens: Lens, edge: Edge) -> bool:
    used = edge.weight > 0.1
    if used.sum() < 30:
        return False
    f = float(np.exp(lens.g[0]))
    matrix = np.array([[f, 0, lens.g[2]], [0, f, lens.g[3]], [0, 0, 1.0]])
    a, b = graph.blocks[edge.i].px[used], edge.target[used]
    essential, inlier = cv2.findEssentialMat(a, b, matrix, cv2.USAC_MAGSAC, 0.999, 0.7)
    if essential is None or essential.shape != (3, 3):
        return False
    _, rotation, translation, _ = cv2.recoverPose(essential, a, b, matrix, mask=inlier)
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = rotation, 0.1 * translation[:, 0]
    graph.blocks[edge.j].cam_from_world = pose
    return True


def _carry(graph: KeyframeGraph, lens: Lens, i: int, j: int) -> None:
    a, b = graph.blocks[i], graph.blocks[j]
    info = graph.depth_info(i)
    j_from_i = b.cam_from_world @ inverse(a.cam_from_world)
    b.inv_depth, _ = carried(a.px, a.inv_depth, info, j_from_i, camera_of(lens, graph.size), b.px)
    b.inv_depth = np.clip(b.inv_depth, 1e-3, 50.0)
    b.prior_depth = b.inv_depth.copy()
    b.prior_info = np.full(len(b.px), 1e-3 / float(np.median(b.inv_depth)) ** 2)
