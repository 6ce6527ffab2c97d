"""Two views: a keyframe, whose depths the graph knows, and a frame. Tracking, recovery and joining all come here."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..alignment.align import align
from ..alignment.problem import AlignmentProblem
from ..alignment.reproject import StaticMatches
from ..alignment.result import Alignment
from ..concurrency import Future
from ..config import Config
from ..dynamics.soft_mask import static_at
from ..graph.keyframe_graph import Keyframe, KeyframeGraph
from ..parts import Parts
from ..pointmap.feature_matches import dense_flow, usable
from ..types import USABLE_WEIGHT, FeatureMatches, Guess, Matches, PairPrediction, WorkFrame
from .observation import Observation
from .state import TrackingState

Array = NDArray[Any]
SURE_INLIERS = 0.75  # of dense matches alone
SURE_FEATURES, SURE_INLIERS_WITH = 80, 0.5  # or so many sparse features of one geometry, beside such a share
THIN = 0.3  # share of a keyframe's static points that are matched, below: another start is tried


@dataclass(frozen=True)
class Start:
    """Where the matches of a pair are searched from."""

    flow: Array | None = None  # (h', w', 2) ref -> new; None: nothing is known
    features: FeatureMatches | None = None  # where the flow comes from sparse features
    near: bool = False  # the flow is within the motion of one frame


@dataclass(frozen=True)
class TwoView:
    """One pair, estimated: what the provider said, the static weight of its matches, and the pose."""

    anchor: Keyframe
    pair: PairPrediction
    weight: Array  # (p,) static weight of each match
    alignment: Alignment
    motion_ratio: float  # upper quartile of the image motion, its median before a start, / sqrt(width * height)
    matched: int  # weighted matches


class TwoViewEstimator:
    """Matches a pair under the static weights, and aligns it."""

    def __init__(self, config: Config, parts: Parts, graph: KeyframeGraph) -> None:
        self.config, self.parts, self.graph = config, parts, graph

    def match(self, state: TrackingState, seen: Observation, prior: Future[Array]) -> AlignmentProblem:
        """The frame against the keyframe that is followed, eq. (5)-(7), from where the last frame was."""
        if state.anchor is None or seen.blank:
            return AlignmentProblem.nothing(state.cam_from_anchor)
        return self.problem(state.anchor, seen.work, prior, Start(state.flow, near=True), state.cam_from_anchor)

    def problem(
        self, ref: Keyframe, new: WorkFrame, prior: Future[Array], start: Start, guess: Array
    ) -> AlignmentProblem:
        """``prior`` (h, w) P(moving) in new, which is waited for after matching; ``guess`` (4, 4) new_from_ref."""
        graph, started = self.graph, self._started(ref)
        variables = graph.variables[ref.id]
        inv_depth, info = (variables.inv_depth, graph.depth_info(ref.id)) if started else (None, None)
        known = Guess(graph.camera(), inv_depth, info, guess if started else None)

        def matched(start: Start) -> tuple[PairPrediction, Array]:
            # before there is structure nothing else tells right from wrong: flow is searched at its full size
            near = start.near and started
            how = replace(known, flow=start.flow, features=start.features, flow_is_near=near)
            pair = self.parts.provider.predict(ref.work, new, how)  # (7): pointmap/geometric.py
            # (5)(6), softly: a match weighs as much as both its ends are static
            return pair, pair.matches.weight * ref.static * static_at(prior.get(), pair.matches.new_px)

        pair, weight = matched(start)
        is_thin = start.features is None and matched_share(ref, weight) < THIN
        if is_thin and (found := self._far(ref, new, prior)) is not None:
            pair, weight = max((pair, weight), matched(found), key=lambda found: float(found[1].sum()))
        sigma = self.parts.provider.depth_sigma_ratio
        if not started:
            return AlignmentProblem(pair, weight, None, guess, sigma)
        info, intrinsics = graph.depth_info(ref.id), graph.intrinsics.values
        matches = StaticMatches(variables.px, variables.inv_depth, info, pair.matches.new_px, weight, intrinsics)
        return AlignmentProblem(pair, weight, matches, guess, sigma)

    def view(self, ref: Keyframe | None, problem: AlignmentProblem, alignment: Alignment) -> TwoView | None:
        """The pair with its pose; None without an anchor."""
        if ref is None:
            return None
        # before a start nothing tells what moves, and what passes in front would make the keyframes
        share = 0.75 if self._started(ref) else 0.5
        motion = _motion(problem.pair.matches, problem.weight, self.parts.provider.size, share)
        return TwoView(ref, problem.pair, problem.weight, alignment, *motion)

    def estimate(self, ref: Keyframe, new: WorkFrame, prior: Future[Array], start: Start, guess: Array) -> TwoView:
        """``problem``, and its coarse, scale and fine stage in order."""
        problem = self.problem(ref, new, prior, start, guess)
        view = self.view(ref, problem, align(self.parts.aligner, problem))
        assert view is not None
        return view

    def accepted(self, view: TwoView) -> bool:
        """Enough static matches, and enough of them agree on the pose."""
        enough = (view.weight > USABLE_WEIGHT).sum() >= self.config.alignment.min_matches
        return bool(enough) and view.alignment.inlier_ratio >= self.config.tracking.min_inlier_ratio

    def relocalised(self, kf: Keyframe, work: WorkFrame, prior: Future[Array]) -> TwoView | None:
        """``work`` seen from a keyframe that it may never have been near, then as ever.

        A provider that finds what is far needs no start; for the others sparse features give one.
        """
        start = self._far(kf, work, prior)
        if start is None and not self.parts.provider.finds_far:
            return None
        view = self.estimate(kf, work, prior, start or Start(), np.eye(4))
        return view if self.accepted(view) else None

    def beyond_doubt(self, view: TwoView, work: WorkFrame, prior: Future[Array]) -> bool:
        """Whether dense matches alone, or sparse features beside them, leave no doubt that a view shows one place.

        For where nothing else speaks for it: what moves, and two things that look alike, agree on a pose as well.
        """
        ratio = view.alignment.inlier_ratio
        if ratio >= SURE_INLIERS or ratio < SURE_INLIERS_WITH:
            return ratio >= SURE_INLIERS
        features = far_features(self.parts, view.anchor, work, prior.get())
        return features is not None and len(features.ref_px) >= SURE_FEATURES

    def _started(self, ref: Keyframe) -> bool:
        return self.graph.submap_of[ref.id] in self.graph.started

    def _far(self, kf: Keyframe, work: WorkFrame, prior: Future[Array]) -> Start | None:
        """Sparse features of the static scene, and flow from them; None where none are needed, or too few agree."""
        return far_matches(self.parts, kf, work, prior.get())


def far_matches(parts: Parts, kf: Keyframe, work: WorkFrame, moving: Array) -> Start | None:
    """``far_features``, and flow from them."""
    features = far_features(parts, kf, work, moving)
    return None if features is None else Start(dense_flow(features, *parts.provider.size), features)


def far_features(parts: Parts, kf: Keyframe, work: WorkFrame, moving: Array) -> FeatureMatches | None:
    """Sparse features of the static scene in both; None where none are needed, or too few agree."""
    if parts.provider.finds_far:
        return None
    found = parts.features.matches(kf.work.gray, work.gray, kf.moving / 255.0, moving)
    return None if found is None else usable(found, *parts.provider.size)


def matched_share(ref: Keyframe, weight: Array) -> float:
    """Share of the static points that could be matched that were, (p,) ``weight``.

    Small after a fast turn, or with someone in front.
    """
    return int((weight > USABLE_WEIGHT).sum()) / max(int((ref.work.texture * ref.static > USABLE_WEIGHT).sum()), 1)


def _motion(matches: Matches, weight: Array, size: tuple[int, int], share: float) -> tuple[float, int]:
    used = weight > USABLE_WEIGHT
    if used.sum() < 10:
        return float("inf"), 0
    moved = np.linalg.norm(matches.new_px - matches.ref_px, axis=1)[used]
    return float(np.quantile(moved, share)) / float(np.sqrt(size[0] * size[1])), int(used.sum())
