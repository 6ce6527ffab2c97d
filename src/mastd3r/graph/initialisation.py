"""The first keyframes: intrinsics and structure from nothing, by trying several focal lengths."""

from __future__ import annotations

import logging
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from ..geometry.reprojection_kernels import edge_residuals
from ..geometry.se3 import inverse
from ..types import USABLE_WEIGHT
from .depth import carried
from .factors import ReprojectionFactor
from .intrinsics import Intrinsics, as_given
from .keyframe_graph import KeyframeGraph
from .observability import explained_by_turn
from .turning import observed
from .windows import ALL_INTRINSICS, Window

Array = NDArray[Any]
log = logging.getLogger(__name__)
MIN_AGREEMENT = 0.4  # of the matches, for a start to be accepted
LOOKED_AT = 8  # latest keyframes whose image motion must show parallax, before anything is tried
ONE_BY_ONE = (15, 6)  # iterations of a keyframe by itself, and of all so far, where one after another is added
FIRST_PAIRS = 2  # pairs of keyframes that a start is tried from
SAME = 0.01  # starts whose focal lengths and costs differ by less came to the same end
FITS_PX = 1.0  # a match further away counts as left out
FOCAL_DOUBT = 0.1  # share of the matches that a focal length e times the usual one must explain more than the others
WITHOUT_PARALLAX = {"none": "that stands still", "rotation": "that only turns"}
FOCAL_RATIOS = (0.7, 0.95, 1.2, 1.5, 2.0)  # focal / sqrt(width * height), tried when the intrinsics are not given
FOCAL_RATIOS_AROUND = (1.0, 0.85, 1.2)  # of the focal length that EXIF says, tried where it does


@dataclass(frozen=True)
class _Start:
    """Intrinsics, poses and depths that were found from one first pair and focal length."""

    cost: float
    intrinsics: Intrinsics
    state: dict[int, tuple[Array, Array]]  # cam_from_world (4, 4) and inverse depths of each keyframe


@dataclass(frozen=True)
class StartReport:
    """What came of trying to start the submap being tracked."""

    started: bool
    agreeing: float | None = None  # share of the matches that the best start explains; None where none was tried


def bootstrap(whole: KeyframeGraph, *, hurry: bool = False) -> StartReport:
    """Solve all keyframes of the submap being tracked, where one camera and one static scene explain their matches.

    As long as there is no map at all, keyframes between which the camera stands still, or only turns, are not tried:
    a start would be found, and mean nothing (graph/observability.py).

    Several first pairs and focal lengths are tried, each to the end; the start that explains the most matches is
    kept, and matches that it leaves out lose their weight: nothing else tells yet what moves. World is the submap's
    first keyframe's camera. Intrinsics that an earlier submap has found stay as they are. In a ``hurry`` no more are
    tried once two focal lengths have come to the same end.
    """
    graph = whole.part()
    turns: set[tuple[int, int]] = set()
    if whole.started:
        graph.set_intrinsics(as_given(whole.intrinsics))
    if not whole.started - ({0} if whole.held else set()):
        seen, pairs = observed(graph, graph.members()[-LOOKED_AT:])
        if seen.kind in ("none", "rotation"):
            log.info("no start: the image motion is that of a camera %s", WITHOUT_PARALLAX[seen.kind])
            return StartReport(False)
        turns = {(p.ref, p.new) for p in pairs if explained_by_turn(p, seen.noise_px, graph.size)}
    best = min(_starts(graph, turns, hurry), key=lambda start: start.cost, default=None)
    if best is None:
        return StartReport(False, 0.0)
    graph.set_intrinsics(best.intrinsics)
    whole.set_intrinsics(replace(whole.intrinsics, values=best.intrinsics.values))  # the best guess, if it fails too
    world_from_first = inverse(best.state[min(best.state)][0])
    for k, (pose, depth) in best.state.items():
        graph.set_keyframe_pose(k, pose @ world_from_first)
        graph.set_depths(k, depth)
    agreeing = _agreement(graph)
    if agreeing < MIN_AGREEMENT:
        log.info("no start: only %.0f %% of the matches fit one camera and one static scene", 100 * agreeing)
        return StartReport(False, agreeing)
    for k, static in _without_what_is_left(graph).items():
        whole.discount_points(k, static)
    for k in graph.variables:  # the last start that was tried has left its own there
        _hold_weakly(graph, k)
    _solve_all(graph, graph.edges, 5)
    graph.normalise()
    whole.set_intrinsics(replace(whole.intrinsics, values=graph.intrinsics.values))
    whole.started.add(whole.submap)
    log.info(
        "started with %d keyframes, focal %.0f px at working size",
        len(graph.keyframes),
        _focal_px(graph),
    )
    return StartReport(True, agreeing)


def _starts(graph: KeyframeGraph, turns: set[tuple[int, int]], hurry: bool) -> Iterator[_Start]:
    """Every start that comes to an end, those that come to the same one once; not from pairs that are ``turns``."""
    known = graph.intrinsics
    focals = first_focals(graph)
    ends: list[tuple[float, float]] = []
    for pair in first_pairs(graph, turns):
        same = 0
        for focal_px in focals:
            first = known.prior.copy()
            if focal_px is not None:
                first[0] = np.log(focal_px)
            graph.set_intrinsics(replace(known, values=first))
            cost = attempt(graph, pair)
            if cost is None:
                continue
            log_focal = float(graph.intrinsics.values[0])
            if any(abs(log_focal - f) < SAME and abs(cost - c) < SAME * c for f, c in ends):
                same += 1
                if hurry:
                    return
                continue
            ends.append((log_focal, cost))
            left_out = _settle_on_most(graph)
            log.info("start from %d-%d: focal %.0f px, cost %.0f", pair.i, pair.j, _focal_px(graph), left_out)
            state = {k: (v.cam_from_world, v.inv_depth) for k, v in graph.variables.items()}
            yield _Start(left_out, graph.intrinsics, state)
        if len(focals) > 1 and len(ends) == 1 and same == len(focals) - 1:
            return  # there is no other


def first_focals(graph: KeyframeGraph) -> list[float | None]:
    """Focal lengths in working pixels to start from; None alone where it is known."""
    known = graph.intrinsics
    if not known.free[0]:
        return [None]
    if known.focal_source == "EXIF":
        return [ratio * float(np.exp(known.prior[0])) for ratio in FOCAL_RATIOS_AROUND]
    return [ratio * float(np.sqrt(graph.size[0] * graph.size[1])) for ratio in FOCAL_RATIOS]


def _focal_px(graph: KeyframeGraph) -> float:
    return float(np.exp(graph.intrinsics.values[0]))


def _settle_on_most(graph: KeyframeGraph) -> float:
    """Solve on with the matches that fit alone, under bounds that tighten; what is left out, by weight.

    Something that moves is not noise: its matches agree with one another, and a start that distorts lens and poses
    until they nearly fit is cheap under a kernel that grows without end. A focal length far from what cameras have
    must explain more matches than one that is near.
    """
    for bound_px in (6.0, 4.0, 3.0, 2.0):
        errors = zip(graph.edges, errors_px(graph, graph.edges), strict=True)
        edges = [replace(e, weight=np.where(r < bound_px, e.weight, 0.0)) for e, r in errors]
        _solve_all(graph, edges, 10)
    left_out = total = 0.0
    for e, r in zip(graph.edges, errors_px(graph, graph.edges), strict=True):
        left_out += float((e.weight * np.minimum((r / FITS_PX) ** 2, 1.0)).sum())
        total += float(e.weight.sum())
    found = graph.intrinsics
    unusual = (found.values[0] - found.prior[0]) ** 2 if found.free[0] else 0.0
    return left_out + FOCAL_DOUBT * total * float(unusual)


def errors_px(graph: KeyframeGraph, edges: Sequence[ReprojectionFactor]) -> list[Array]:
    """(p,) distance in pixels of every match from where poses and depths put it, an array an edge."""
    out = []
    for e in edges:
        v = graph.variables[e.i]
        j_from_i = graph.variables[e.j].cam_from_world @ inverse(v.cam_from_world)
        residual, _ = edge_residuals(v.px, v.inv_depth, e.target.astype(float), j_from_i, graph.intrinsics.values)
        out.append(np.hypot(residual[:, 0], residual[:, 1]))
    return out


def _without_what_is_left(graph: KeyframeGraph) -> dict[int, Array]:
    """Matches far from the start lose their weight; (p,) share that every keyframe's points keep, 1 without any."""
    errors = errors_px(graph, graph.edges)
    used = np.concatenate([r[e.weight > USABLE_WEIGHT] for e, r in zip(graph.edges, errors, strict=True)])
    bound_px = max(3.0, 5.0 * float(np.median(used)))  # a lens that is distorted more than known moves the most
    kept = {k: np.zeros((2, len(v.px))) for k, v in graph.variables.items()}
    for e, r in zip(graph.edges, errors, strict=True):
        fits = r < bound_px
        kept[e.i] += e.weight * np.stack([fits, np.ones(len(fits))])
        graph.set_weights(e, np.where(fits, e.weight, 0.0))
    return {k: np.where(total > 0, fit / np.maximum(total, 1e-9), 1.0) for k, (fit, total) in kept.items()}


def _agreement(graph: KeyframeGraph) -> float:
    """Share of all weighted matches within 2 px of where poses and depths put them."""
    used = [e.weight > USABLE_WEIGHT for e in graph.edges]
    close = sum(int((r[u] < 2.0).sum()) for r, u in zip(errors_px(graph, graph.edges), used, strict=True))
    return close / max(sum(int(u.sum()) for u in used), 1)


def first_pairs(
    graph: KeyframeGraph, turns: set[tuple[int, int]], count: int = FIRST_PAIRS
) -> list[ReprojectionFactor]:
    """Pairs to start from: many matches and much image motion, best first; ``turns`` say nothing of depth."""

    def merit(edge: ReprojectionFactor) -> float:
        used = edge.weight > USABLE_WEIGHT
        moved = np.linalg.norm(edge.target - graph.variables[edge.i].px, axis=1)[used]
        return float(used.sum() * min(np.median(moved) / (0.05 * max(graph.size)), 1.5))

    forward = [e for e in graph.edges if e.i < e.j and (e.i, e.j) not in turns]
    return sorted(forward, key=merit, reverse=True)[:count]


def attempt(graph: KeyframeGraph, pair: ReprojectionFactor) -> float | None:
    """Two views by the essential matrix, the others one by one, then all; the robust cost, None on failure."""
    if not from_two_views(graph, pair):
        return None
    cost = _solve_all(graph, graph.edges, 25)
    return cost if np.isfinite(cost) else None


def from_two_views(graph: KeyframeGraph, pair: ReprojectionFactor, iterations: tuple[int, int] = ONE_BY_ONE) -> bool:
    """Two views by the essential matrix, the others one by one; whether the two tell of a pose."""
    _reset(graph)
    pose = two_view_pose(graph, pair)
    if pose is None:
        return False
    pose[:3, 3] *= 0.1
    graph.set_keyframe_pose(pair.j, pose)
    first = [pair.i, pair.j]
    _solve_part(graph, first, frozenset([pair.i]), 15, 2.0)
    add_one_by_one(graph, first, iterations)
    return True


def add_one_by_one(graph: KeyframeGraph, first: Sequence[int], iterations: tuple[int, int] = ONE_BY_ONE) -> None:
    """Poses and depths of the other keyframes from those of ``first``, the nearest first; ``first[0]`` stays.

    ``iterations``: of each by itself, and of all that are there then.
    """
    done, (alone, together) = list(first), iterations
    while len(done) < len(graph.keyframes):
        k = min((k for k in graph.variables if k not in done), key=lambda k: min(abs(k - d) for d in done))
        nearest = min(done, key=lambda d: abs(k - d))
        graph.set_keyframe_pose(k, graph.variables[nearest].cam_from_world)
        _carry(graph, nearest, k)
        done.append(k)
        _solve_part(graph, done, frozenset(done[:-1]), alone, 4.0)
        _carry(graph, nearest, k)
        _solve_part(graph, done, frozenset([done[0]]), together, 2.0)


def _solve_all(graph: KeyframeGraph, edges: list[ReprojectionFactor], iterations: int) -> float:
    """Poses, depths and focal length; the cost."""
    ids = graph.variables.keys()
    return graph.optimise(Window(ids, edges, frozenset([min(ids)]), ALL_INTRINSICS - {0}), iterations).cost_last


def _solve_part(graph: KeyframeGraph, ids: list[int], fixed: frozenset[int], iterations: int, kernel_px: float) -> None:
    """Poses and depths of some keyframes."""
    graph.optimise(Window(ids, graph.edges_among(ids), fixed, ALL_INTRINSICS), iterations, kernel_px)


def _reset(graph: KeyframeGraph) -> None:
    for k, v in graph.variables.items():
        graph.set_keyframe_pose(k, np.eye(4))
        graph.set_depths(k, np.ones(len(v.px)))
        graph.hold_depths(k, np.full(len(v.px), 1e-2))
        graph.forget_matched_depths(k)


def two_view_pose(graph: KeyframeGraph, edge: ReprojectionFactor) -> Array | None:
    """(4, 4) j_from_i of an edge by its essential matrix, the step's length 1; None where its matches tell of none."""
    used = edge.weight > 0.1
    if used.sum() < 30:
        return None
    g = graph.intrinsics.values
    f = float(np.exp(g[0]))
    matrix = np.array([[f, 0, g[2]], [0, f, g[3]], [0, 0, 1.0]])
    a, b = graph.variables[edge.i].px[used], edge.target[used].astype(float)
    essential, inlier = cv2.findEssentialMat(a, b, matrix, cv2.USAC_MAGSAC, 0.999, 0.7)
    if essential is None or essential.shape != (3, 3):
        return None
    _, rotation, translation, _ = cv2.recoverPose(essential, a, b, matrix, mask=inlier)
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = rotation, translation[:, 0]
    return pose


def _carry(graph: KeyframeGraph, i: int, j: int) -> None:
    a, b = graph.variables[i], graph.variables[j]
    j_from_i = b.cam_from_world @ inverse(a.cam_from_world)
    inv_depth, _ = carried(a.px, a.inv_depth, graph.depth_info(i), j_from_i, graph.camera(), b.px)
    graph.set_depths(j, np.clip(inv_depth, 1e-3, 50.0))
    _hold_weakly(graph, j)


def _hold_weakly(graph: KeyframeGraph, k: int) -> None:
    v = graph.variables[k]
    graph.hold_depths(k, np.full(len(v.px), 1e-3 / float(np.median(v.inv_depth)) ** 2))
