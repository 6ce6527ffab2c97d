"""Where an image was taken in a map that is finished: its pose, how sure that is, or that it was not found."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from ..alignment.reproject import StaticMatches
from ..concurrency import Future
from ..config import Config
from ..geometry.least_squares import Damping, levenberg_marquardt
from ..geometry.se3 import inverse, se3_exp, so3_log
from ..graph.covisibility import overlap
from ..graph.keyframe_graph import Keyframe, KeyframeGraph
from ..graph.prediction import rigid_flow_to
from ..parts import Parts
from ..types import USABLE_WEIGHT, WorkFrame
from .places import most_alike, not_unlike
from .two_view import Start, TwoView, TwoViewEstimator

Array = NDArray[Any]
LOOKED_AT = 4  # keyframes by small pictures, and as many by features, that an image is compared with
LEAST_ALIKE = 0.02  # share of features that both have; where a map's edge is seen it is small, elsewhere below 0.02
LEAST_VIEWS = 2  # keyframes that must put an image at one place
ENOUGH_VIEWS, MOST_VIEWS = 3, 5  # that are looked for, and that its pose is found from
LEAST_OVERLAP = 0.15  # share of a keyframe's points in view, for it to be searched from a pose
AT_ONE_TURN, AT_ONE_SHIFT = 0.05, 0.05  # rad, and of the median depth: two keyframes that differ by less agree
NEAR_TURN, NEAR_SHIFT = 0.5, 0.5  # the same for keyframes that may see what an image sees
KERNEL_PX, ITERATIONS = 1.0, 20
INLIER_PX = 2.0
DEPTH_NOISE = 5.0  # the same of depths, which many keyframes measure by one patch: held to them, far poses bend
NOISE = 20.0  # errors of matches are alike within a view: so many times one match's, as in graph/focal_sigma.py


@dataclass(frozen=True)
class Place:
    """Where an image was taken, in the map's frame and unit."""

    world_from_cam: Array  # (4, 4)
    covariance: Array  # (6, 6) of a small motion of the camera: its translation in its own axes, then its rotation, rad
    keyframes: tuple[int, ...]  # that agree on it, the best first
    inliers: int  # matches within INLIER_PX of where the pose puts them
    inlier_ratio: float  # share of the matches
    is_found: ClassVar[bool] = True

    @property
    def position_sigma(self) -> float:
        """1 sigma of the position, in the map's unit, all axes together."""
        return float(np.sqrt(np.trace(self.covariance[:3, :3])))

    @property
    def rotation_sigma_deg(self) -> float:
        """1 sigma of the rotation, all axes together."""
        return float(np.degrees(np.sqrt(np.trace(self.covariance[3:, 3:]))))


@dataclass(frozen=True)
class Unplaced:
    """Why an image has no place in the map."""

    reason: str
    is_found: ClassVar[bool] = False


@dataclass(frozen=True)
class _Seen:
    """An image seen from a keyframe."""

    view: TwoView
    cam_from_world: Array


class Localiser:
    """Finds images in a map; the map stays as it is."""

    def __init__(self, config: Config, parts: Parts, graph: KeyframeGraph, submap: int = 0) -> None:
        """``submap``: the part of the graph that is the map."""
        self.parts, self.graph, self.submap = parts, graph, submap
        self.two_view = TwoViewEstimator(config, parts, graph)

    def find(self, work: WorkFrame, moving: Array, near: Place | None = None) -> Place | Unplaced:
        """The place of an image; ``moving`` (h, w) P(moving), ``near`` that of the image before in a video.

        It is believed where ``LEAST_VIEWS`` keyframes see it at one place, each by matches of its own.
        """
        prior = Future.done(moving)
        if near is not None and len(group := self._tracked(work, prior, inverse(near.world_from_cam))) >= LEAST_VIEWS:
            return self._place(group)
        looked_at, seen, asked = self._candidates(work), list[_Seen](), set[int]()
        group = []
        for kf in looked_at:
            group = self._with(seen, asked, kf, work, prior, group)
            if len(group) >= ENOUGH_VIEWS:
                break
        for kf in self._around(group or seen, asked):
            if len(group) >= ENOUGH_VIEWS:
                break
            group = self._with(seen, asked, kf, work, prior, group)
        if len(group) >= LEAST_VIEWS:
            again = self._tracked(work, prior, inverse(self._place(group).world_from_cam))
            return self._place(again if len(again) >= LEAST_VIEWS else group)
        if not looked_at:
            return Unplaced("no keyframe looks like it")
        if not seen:
            return Unplaced(f"none of the {len(looked_at)} keyframes most like it shows its place")
        return Unplaced(f"no {LEAST_VIEWS} of the {len(asked)} keyframes compared put it at one place")

    def _with(
        self,
        seen: list[_Seen],
        asked: set[int],
        kf: Keyframe,
        work: WorkFrame,
        prior: Future[Array],
        group: list[_Seen],
    ) -> list[_Seen]:
        """The largest group that agrees, once a keyframe more has been asked."""
        asked.add(kf.id)
        view = self.two_view.relocalised(kf, work, prior)
        if view is None:
            return group
        seen.append(self._seen(view))
        return _agreeing(self.graph, seen)

    def _seen(self, view: TwoView) -> _Seen:
        anchor = self.graph.variables[view.anchor.id].cam_from_world
        return _Seen(view, view.alignment.new_from_ref @ anchor)

    def _candidates(self, work: WorkFrame) -> list[Keyframe]:
        """By small pictures and by features in turn, none twice."""
        graph, ids = self.graph, self.graph.members(self.submap)
        by_features = most_alike(self.parts, graph, work, ids, LOOKED_AT, LEAST_ALIKE)
        by_picture = not_unlike(self.parts, work, self.parts.places.best(graph, work, ids, LOOKED_AT), LEAST_ALIKE)
        both = [kf for n in range(LOOKED_AT) for found in (by_features, by_picture) for kf in found[n : n + 1]]
        return list({kf.id: kf for kf in both}.values())

    def _around(self, seen: Sequence[_Seen], asked: set[int]) -> list[Keyframe]:
        """Keyframes near those that see an image, not asked yet, nearest first."""
        if not seen:
            return []
        graph = self.graph
        pose, anchor = seen[0].cam_from_world, seen[0].view.anchor.id
        apart = {k: _apart(graph, graph.variables[k].cam_from_world, pose, anchor) for k in graph.members(self.submap)}
        near = [k for k, (turn, shift) in apart.items() if turn < NEAR_TURN and shift < NEAR_SHIFT and k not in asked]
        return [graph.keyframes[k] for k in sorted(near, key=lambda k: sum(apart[k]))[:LOOKED_AT]]

    def _tracked(self, work: WorkFrame, prior: Future[Array], cam_from_world: Array) -> list[_Seen]:
        """The image seen from the keyframes that see most from about its pose (4, 4), searched from there; those that
        agree."""
        graph = self.graph
        seen = {k: overlap(graph, k, cam_from_world) for k in graph.members(self.submap)}
        best = sorted(seen, key=lambda k: seen[k][1] - seen[k][0])[:MOST_VIEWS]
        views = []
        for k in (k for k in best if seen[k][0] >= LEAST_OVERLAP):
            start = Start(rigid_flow_to(graph, k, cam_from_world), near=True)
            guess = cam_from_world @ inverse(graph.variables[k].cam_from_world)
            view = self.two_view.estimate(graph.keyframes[k], work, prior, start, guess)
            if self.two_view.accepted(view):
                views.append(self._seen(view))
        return _agreeing(graph, views)

    def _place(self, group: list[_Seen]) -> Place:
        """One pose from the matches of all keyframes that agree."""
        graph = self.graph
        group = sorted(group, key=lambda s: -float(s.view.weight.sum()))[:MOST_VIEWS]
        terms = []
        for seen in group:
            v, k = graph.variables[seen.view.anchor.id], seen.view.anchor.id
            target, weight = seen.view.pair.matches.new_px, seen.view.weight
            info = graph.depth_info(k) / DEPTH_NOISE**2
            matches = StaticMatches(v.px, v.inv_depth, info, target, weight, graph.intrinsics.values)
            terms.append((matches, inverse(v.cam_from_world)))
        start = _Pose(tuple(terms), group[0].cam_from_world)
        end = levenberg_marquardt(start, Damping(), iterations=ITERATIONS, tolerance=1e-6).estimate
        used = [m.weight > USABLE_WEIGHT for m, _ in terms]
        error = [m.residual_px(end.cam_from_world @ w)[u] for (m, w), u in zip(terms, used, strict=True)]
        count = sum(int((e < INLIER_PX).sum()) for e in error)
        return Place(
            inverse(end.cam_from_world),
            end.covariance(),
            tuple(s.view.anchor.id for s in group),
            count,
            count / max(sum(map(len, error)), 1),
        )


@dataclass(frozen=True)
class _Pose:
    """The solver's estimate: one pose, by matches with several keyframes."""

    terms: tuple[tuple[StaticMatches, Array], ...]  # and world_from_ref of each
    cam_from_world: Array

    @cached_property
    def _system(self) -> tuple[Array, Array, float]:
        parts = [m.system(self.cam_from_world @ world_from_ref, KERNEL_PX) for m, world_from_ref in self.terms]
        return sum(h for h, _, _ in parts), sum(b for _, b, _ in parts), sum(c for _, _, c in parts)  # type: ignore[return-value]

    def linearised(self) -> tuple[Array, Array, float]:
        return self._system

    def cost(self) -> float:
        return self._system[2]

    def moved(self, step: Array) -> _Pose:
        return _Pose(self.terms, se3_exp(step) @ self.cam_from_world)

    def covariance(self) -> Array:
        """(6, 6) of a step, by the normal matrix and the spread of the residuals as the robust solver weighs them."""
        squares = weights = 0.0
        for matches, world_from_ref in self.terms:
            r2 = matches.residual_px(self.cam_from_world @ world_from_ref) ** 2
            u = matches.weight / (1 + r2 / KERNEL_PX**2)
            squares, weights = squares + float((u**2 * r2).sum()), weights + float(u.sum())
        variance = NOISE**2 * squares / max(2 * weights, 1e-12)
        return np.asarray(variance * np.linalg.pinv(self._system[0], hermitian=True))


def _agreeing(graph: KeyframeGraph, seen: Sequence[_Seen]) -> list[_Seen]:
    """The largest group that puts the image where one of it does."""
    groups = [[b for b in seen if _agree(graph, a, b)] for a in seen]
    return max(groups, key=len, default=[])


def _agree(graph: KeyframeGraph, a: _Seen, b: _Seen) -> bool:
    turn, shift = _apart(graph, a.cam_from_world, b.cam_from_world, a.view.anchor.id)
    return turn <= AT_ONE_TURN and shift <= AT_ONE_SHIFT


def _apart(graph: KeyframeGraph, a: Array, b: Array, kf_id: int) -> tuple[float, float]:
    """Rad, and share of the median depth of a keyframe, between two poses (4, 4) cam_from_world."""
    between = b @ inverse(a)
    shift = float(np.linalg.norm(between[:3, 3])) * graph.median_inv_depth(kf_id)
    return float(np.linalg.norm(so3_log(between[:3, :3]))), shift
