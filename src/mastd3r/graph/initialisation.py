"""The first keyframes: lens and structure from nothing, by trying several focal lengths."""

from __future__ import annotations

import logging
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from ..geometry.reprojection_kernels import N_GLOBAL, edge_residuals
from ..geometry.se3 import inverse
from .bundle_adjustment import solve
from .depth import carried
from .factors import KeyframeVariables, ReprojectionFactor
from .intrinsics import Intrinsics, camera_of
from .keyframe_graph import KeyframeGraph

Array = NDArray[Any]
log = logging.getLogger(__name__)
MIN_AGREEMENT = 0.4  # of the matches, for a start to be believed
FIRST_PAIRS = 2  # pairs of keyframes that a start is tried from
SAME = 0.01  # starts whose focal lengths and costs differ by less came to the same end
FITS_PX = 1.0  # a match further away counts as left out
FOCAL_DOUBT = 0.1  # share of the matches that a focal length e times the usual one must explain more than the others
FOCAL_RATIOS = (0.7, 0.95, 1.2, 1.5, 2.0)  # focal / sqrt(width * height), tried when the lens is not given


@dataclass(frozen=True)
class _Start:
    """Intrinsics, poses and depths that were found from one first pair and focal length."""

    cost: float
    intrinsics: Array  # (6,)
    state: dict[int, tuple[Array, Array]]  # cam_from_world (4, 4) and inverse depths of each keyframe


def bootstrap(whole: KeyframeGraph) -> bool:
    """Solve all keyframes of the submap being tracked. False where no start was found (too little parallax).

    Several first pairs and focal lengths are tried, each to the end; the start that explains the most matches is
    kept, and matches that it leaves out lose their weight: nothing else tells yet what moves. World is the submap's
    first keyframe's camera. A lens that an earlier submap has found stays as it is.
    """
    graph = whole.part()
    if whole.started:
        graph.intrinsics = Intrinsics(whole.intrinsics.values, whole.intrinsics.values, np.full(N_GLOBAL, np.inf))
    best = min(_starts(graph), key=lambda start: start.cost, default=None)
    if best is None:
        return False
    graph.intrinsics.values = best.intrinsics
    world_from_first = inverse(best.state[min(best.state)][0])
    for k, (pose, depth) in best.state.items():
        graph.variables[k].cam_from_world, graph.variables[k].inv_depth = pose @ world_from_first, depth
    agreeing = _agreement(graph)
    if agreeing < MIN_AGREEMENT:
        log.info("no start: only %.0f %% of the matches fit one camera and one static scene", 100 * agreeing)
        return False
    for k, static in _without_what_is_left(graph).items():
        whole.doubt(k, static)
    for block in graph.variables.values():  # the last start that was tried has left its own there
        _weak_prior(block)
    _solve_all(graph, graph.edges, graph.intrinsics, 5)
    graph.normalise()
    whole.intrinsics.values = graph.intrinsics.values
    whole.started.add(whole.submap)
    log.info(
        "started with %d keyframes, focal %.0f px at working size",
        len(graph.keyframes),
        np.exp(graph.intrinsics.values[0]),
    )
    return True


def _starts(graph: KeyframeGraph) -> Iterator[_Start]:
    """Every start that comes to an end, those that come to the same one once."""
    ratios = FOCAL_RATIOS if graph.intrinsics.free[0] else (None,)
    ends: list[tuple[float, float]] = []
    for pair in _first_pairs(graph):
        same = 0
        for ratio in ratios:
            lens = Intrinsics(graph.intrinsics.prior.copy(), graph.intrinsics.prior, graph.intrinsics.prior_info)
            if ratio is not None:
                lens.values[0] = np.log(ratio * np.sqrt(graph.size[0] * graph.size[1]))
            cost = _attempt(graph, lens, pair)
            if cost is None:
                continue
            if any(abs(lens.values[0] - f) < SAME and abs(cost - c) < SAME * c for f, c in ends):
                same += 1
                continue
            ends.append((float(lens.values[0]), cost))
            left_out = _settle_on_most(graph, lens)
            log.info("start from %d-%d: focal %.0f px, cost %.0f", pair.i, pair.j, np.exp(lens.values[0]), left_out)
            state = {k: (b.cam_from_world, b.inv_depth) for k, b in graph.variables.items()}
            yield _Start(left_out, lens.values, state)
        if len(ends) == 1 and same == len(FOCAL_RATIOS) - 1:
            return  # there is no other


def _settle_on_most(graph: KeyframeGraph, lens: Intrinsics) -> float:
    """Solve on with the matches that fit alone, under bounds that tighten; what is left out, by weight.

    Something that moves is not noise: its matches agree with one another, and a start that bends lens and poses
    until they nearly fit is cheap under a kernel that grows without end. A focal length far from what cameras have
    must explain more matches than one that is near.
    """
    for bound_px in (6.0, 4.0, 3.0, 2.0):
        errors = zip(graph.edges, _errors_px(graph, lens), strict=True)
        edges = [replace(e, weight=np.where(r < bound_px, e.weight, 0.0)) for e, r in errors]
        _solve_all(graph, edges, lens, 10)
    left_out = total = 0.0
    for e, r in zip(graph.edges, _errors_px(graph, lens), strict=True):
        left_out += float((e.weight * np.minimum((r / FITS_PX) ** 2, 1.0)).sum())
        total += float(e.weight.sum())
    unusual = (lens.values[0] - lens.prior[0]) ** 2 if lens.free[0] else 0.0
    return left_out + FOCAL_DOUBT * total * float(unusual)


def _errors_px(graph: KeyframeGraph, lens: Intrinsics) -> list[Array]:
    """(p,) distance in pixels of every match from where poses and depths put it, an array an edge."""
    out = []
    for e in graph.edges:
        block = graph.variables[e.i]
        j_from_i = graph.variables[e.j].cam_from_world @ inverse(block.cam_from_world)
        residual, _ = edge_residuals(block.px, block.inv_depth, e.target, j_from_i, lens.values)
        out.append(np.hypot(residual[:, 0], residual[:, 1]))
    return out


def _without_what_is_left(graph: KeyframeGraph) -> dict[int, Array]:
    """Matches far from the start lose their weight; (p,) share that every keyframe's points keep, 1 without any."""
    errors = _errors_px(graph, graph.intrinsics)
    used = np.concatenate([r[e.weight > 0.05] for e, r in zip(graph.edges, errors, strict=True)])
    bound_px = max(3.0, 5.0 * float(np.median(used)))  # a lens that is bent more than known moves the most
    kept = {k: np.zeros((2, len(b.px))) for k, b in graph.variables.items()}
    for e, r in zip(graph.edges, errors, strict=True):
        fits = r < bound_px
        kept[e.i] += e.weight * np.stack([fits, np.ones(len(fits))])
        e.weight = np.where(fits, e.weight, 0.0)
    return {k: np.where(total > 0, fit / np.maximum(total, 1e-9), 1.0) for k, (fit, total) in kept.items()}


def _agreement(graph: KeyframeGraph) -> float:
    """Share of all weighted matches within 2 px of where poses and depths put them."""
    used = [e.weight > 0.05 for e in graph.edges]
    close = sum(int((r[u] < 2.0).sum()) for r, u in zip(_errors_px(graph, graph.intrinsics), used, strict=True))
    return close / max(sum(int(u.sum()) for u in used), 1)


def _first_pairs(graph: KeyframeGraph) -> list[ReprojectionFactor]:
    """Pairs to start from: many matches and much image motion, best first."""

    def merit(edge: ReprojectionFactor) -> float:
        used = edge.weight > 0.05
        moved = np.linalg.norm(edge.target - graph.variables[edge.i].px, axis=1)[used]
        return float(used.sum() * min(np.median(moved) / (0.05 * max(graph.size)), 1.5))

    forward = [e for e in graph.edges if e.i < e.j]
    return sorted(forward, key=merit, reverse=True)[:FIRST_PAIRS]


def _attempt(graph: KeyframeGraph, lens: Intrinsics, pair: ReprojectionFactor) -> float | None:
    """Two views by the essential matrix, the others one by one, then all; the robust cost, None on failure."""
    _reset(graph)
    if not _two_view(graph, lens, pair):
        return None
    frozen = Intrinsics(lens.values, lens.prior, np.full(N_GLOBAL, np.inf))
    done = [pair.i, pair.j]
    _solve_part(graph, frozen, done, frozenset([pair.i]), 15, 2.0)
    while len(done) < len(graph.keyframes):
        k = min((k for k in graph.variables if k not in done), key=lambda k: min(abs(k - d) for d in done))
        nearest = min(done, key=lambda d: abs(k - d))
        graph.variables[k].cam_from_world = graph.variables[nearest].cam_from_world
        _carry(graph, lens, nearest, k)
        done.append(k)
        _solve_part(graph, frozen, done, frozenset(done[:-1]), 15, 4.0)
        _carry(graph, lens, nearest, k)
        _solve_part(graph, frozen, done, frozenset([pair.i]), 6, 2.0)
    cost = _solve_all(graph, graph.edges, lens, 25)
    return cost if np.isfinite(cost) else None


def _solve_all(graph: KeyframeGraph, edges: Sequence[ReprojectionFactor], lens: Intrinsics, iterations: int) -> float:
    """Poses, depths and focal length; the cost."""
    only_focal = Intrinsics(lens.values, lens.prior, np.where(np.arange(N_GLOBAL) == 0, lens.prior_info, np.inf))
    first = frozenset([min(graph.variables)])
    report = solve(graph.variables, edges, only_focal, fixed=first, iterations=iterations, kernel_px=1.0)
    lens.values = only_focal.values
    return report.cost_last


def _solve_part(
    graph: KeyframeGraph, lens: Intrinsics, ids: list[int], fixed: frozenset[int], iterations: int, kernel_px: float
) -> None:
    variables = {k: graph.variables[k] for k in ids}
    solve(variables, graph.edges_among(ids), lens, fixed=fixed, iterations=iterations, kernel_px=kernel_px)


def _reset(graph: KeyframeGraph) -> None:
    for block in graph.variables.values():
        block.cam_from_world = np.eye(4)
        block.inv_depth = np.ones(len(block.px))
        block.prior_depth = np.ones(len(block.px))
        block.prior_info = np.full(len(block.px), 1e-2)
        block.depth_info = np.zeros(0)


def _two_view(graph: KeyframeGraph, lens: Intrinsics, edge: ReprojectionFactor) -> bool:
    used = edge.weight > 0.1
    if used.sum() < 30:
        return False
    f = float(np.exp(lens.values[0]))
    matrix = np.array([[f, 0, lens.values[2]], [0, f, lens.values[3]], [0, 0, 1.0]])
    a, b = graph.variables[edge.i].px[used], edge.target[used]
    essential, inlier = cv2.findEssentialMat(a, b, matrix, cv2.USAC_MAGSAC, 0.999, 0.7)
    if essential is None or essential.shape != (3, 3):
        return False
    _, rotation, translation, _ = cv2.recoverPose(essential, a, b, matrix, mask=inlier)
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = rotation, 0.1 * translation[:, 0]
    graph.variables[edge.j].cam_from_world = pose
    return True


def _carry(graph: KeyframeGraph, lens: Intrinsics, i: int, j: int) -> None:
    a, b = graph.variables[i], graph.variables[j]
    info = graph.depth_info(i)
    j_from_i = b.cam_from_world @ inverse(a.cam_from_world)
    b.inv_depth, _ = carried(a.px, a.inv_depth, info, j_from_i, camera_of(lens, graph.size), b.px)
    b.inv_depth = np.clip(b.inv_depth, 1e-3, 50.0)
    _weak_prior(b)


def _weak_prior(block: KeyframeVariables) -> None:
    block.prior_depth = block.inv_depth.copy()
    block.prior_info = np.full(len(block.px), 1e-3 / float(np.median(block.inv_depth)) ** 2)
