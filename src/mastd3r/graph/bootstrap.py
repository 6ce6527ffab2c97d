"""The first keyframes: lens and structure from nothing, by trying several focal lengths."""

from __future__ import annotations

import logging
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from ..geometry.se3 import inverse
from .bundle import Edge, Lens, solve
from .depth import carried
from .keyframe_graph import KeyframeGraph, camera_of

Array = NDArray[Any]
log = logging.getLogger(__name__)
FOCAL_RATIOS = (0.6, 0.8, 1.0, 1.3, 1.7)  # focal / longer image side, tried when the lens is not given


def bootstrap(graph: KeyframeGraph) -> bool:
    """Solve all keyframes of a graph that has none solved yet. False where no start was found (too little parallax)."""
    given = not graph.lens.free[0]
    best: tuple[float, Lens, dict[int, tuple[Array, Array]]] | None = None
    for ratio in (None,) if given else FOCAL_RATIOS:
        lens = Lens(graph.lens.prior.copy(), graph.lens.prior, graph.lens.prior_info)
        if ratio is not None:
            lens.g[0] = np.log(ratio * max(graph.size))
        cost = _attempt(graph, lens)
        if cost is not None and (best is None or cost < best[0]):
            state = {k: (b.cam_from_world, b.inv_depth) for k, b in graph.blocks.items()}
            best = (cost, Lens(lens.g, lens.prior, lens.prior_info), state)
    if best is None:
        return False
    graph.lens = best[1]
    for k, (pose, depth) in best[2].items():
        graph.blocks[k].cam_from_world, graph.blocks[k].inv_depth = pose, depth
    graph.normalise()
    graph.initialised = True
    log.info(
        "started with %d keyframes, focal %.0f px at working size",
        len(graph.keyframes),
        np.exp(graph.lens.g[0]),
    )
    return True


def _attempt(graph: KeyframeGraph, lens: Lens) -> float | None:
    """Two views by the essential matrix, the others one by one, then all; the robust cost, None on failure."""
    _reset(graph)
    first = next((e for e in graph.edges if e.i == 0 and e.j == 1), None)
    if first is None or not _two_view(graph, lens, first):
        return None
    frozen = Lens(lens.g, lens.prior, np.full(4, np.inf))
    done = [0, 1]
    solve(
        {k: graph.blocks[k] for k in done},
        graph.edges_among(done),
        frozen,
        fixed=frozenset([0]),
        iterations=15,
        kernel_px=2.0,
    )
    for k in range(2, len(graph.keyframes)):
        before, block = graph.blocks[k - 1], graph.blocks[k]
        block.cam_from_world = before.cam_from_world
        block.inv_depth = before.inv_depth.copy()
        _carry(graph, lens, k - 1, k)
        done.append(k)
        hold = frozenset(done[:-1])
        near = {q: graph.blocks[q] for q in done}
        edges = [e for e in graph.edges_among(done) if k in (e.i, e.j)]
        solve(near, edges, frozen, fixed=hold, iterations=15, kernel_px=4.0)
        _carry(graph, lens, k - 1, k)
        solve(near, graph.edges_among(done), frozen, fixed=frozenset([0]), iterations=6, kernel_px=2.0)
    only_focal = Lens(lens.g, lens.prior, np.where(np.arange(4) == 0, lens.prior_info, np.inf))
    report = solve(graph.blocks, graph.edges, only_focal, fixed=frozenset([0]), iterations=25, kernel_px=1.0)
    lens.g = only_focal.g
    log.info("  start tried: focal %.0f px, cost %.1f", np.exp(lens.g[0]), report.cost_last)
    return report.cost_last if np.isfinite(report.cost_last) else None


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
    a, b = graph.blocks[0].px[used], edge.target[used]
    essential, inlier = cv2.findEssentialMat(a, b, matrix, cv2.USAC_MAGSAC, 0.999, 0.7)
    if essential is None or essential.shape != (3, 3):
        return False
    _, rotation, translation, _ = cv2.recoverPose(essential, a, b, matrix, mask=inlier)
    graph.blocks[1].cam_from_world = np.eye(4)
    graph.blocks[1].cam_from_world[:3, :3] = rotation
    graph.blocks[1].cam_from_world[:3, 3] = 0.1 * translation[:, 0]
    return True


def _carry(graph: KeyframeGraph, lens: Lens, i: int, j: int) -> None:
    a, b = graph.blocks[i], graph.blocks[j]
    info = graph.depth_info(i)
    j_from_i = b.cam_from_world @ inverse(a.cam_from_world)
    b.inv_depth, _ = carried(a.px, a.inv_depth, info, j_from_i, camera_of(lens, graph.size), b.px)
    b.inv_depth = np.clip(b.inv_depth, 1e-3, 50.0)
    b.prior_depth = b.inv_depth.copy()
    b.prior_info = np.full(len(b.px), 1e-3 / float(np.median(b.inv_depth)) ** 2)
