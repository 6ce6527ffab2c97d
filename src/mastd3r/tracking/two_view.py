"""One pair, compared: pointmaps, mask and pose. Tracking, loops, recovery and joining all come here."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..alignment.align import align
from ..alignment.reproject import StaticMatches
from ..alignment.result import Alignment
from ..concurrency import Future
from ..config import Config
from ..dynamics.soft_mask import static_at
from ..graph.keyframe_graph import Keyframe, KeyframeGraph
from ..parts import Parts
from ..types import Guess, Matches, PairPrediction, WorkFrame

Array = NDArray[Any]
THIN = 0.3  # share of a keyframe's static points that are matched, below: another start is tried


@dataclass(frozen=True)
class TwoView:
    """One pair, compared: what the provider said, the static weight of its matches, and the pose."""

    pair: PairPrediction
    weight: Array  # (p,) static weight of each match
    alignment: Alignment
    motion_ratio: float  # upper quartile of the image motion, its median before a start, / sqrt(width * height)
    matched: int  # weighted matches


class TwoViewEstimator:
    """The front end for one pair: a keyframe, whose depths the graph knows, and a frame."""

    def __init__(self, config: Config, parts: Parts, graph: KeyframeGraph) -> None:
        self.config, self.parts, self.graph = config, parts, graph

    def compare(
        self, ref: Keyframe, new: WorkFrame, prior: Future[Array], flow: Array | None, guess: Array, near: bool = True
    ) -> TwoView:
        """``prior`` (h, w) P(moving) in new, which is waited for after matching; ``flow`` (h, w, 2) start ref -> new,
        ``near``: within the motion of one frame; ``guess`` (4, 4) new_from_ref."""
        graph, started = self.graph, self.graph.submap_of[ref.id] in self.graph.started
        block = graph.variables[ref.id]
        inv_depth, info = (block.inv_depth, graph.depth_info(ref.id)) if started else (None, None)
        known = Guess(graph.camera(), inv_depth, info, guess if started else None)

        def matched(start: Array | None) -> tuple[PairPrediction, Array]:
            # III-A: both pointmaps, in ref's camera
            pair = self.parts.provider.predict(ref.work, new, replace(known, flow=start))
            # (5)(6), softly
            return pair, pair.matches.weight * ref.static * static_at(prior.get(), pair.matches.new_px)

        pair, weight = matched(flow)
        if near and matched_share(ref, weight) < THIN and (start := self._far_start(ref, new, prior)) is not None:
            pair, weight = max((pair, weight), matched(start), key=lambda found: float(found[1].sum()))
        if started:
            info = graph.depth_info(ref.id)
            matches = StaticMatches(
                block.px, block.inv_depth, info, pair.matches.new_px, weight, graph.intrinsics.values
            )
            sigma = self.parts.provider.depth_sigma_ratio
            alignment = align(pair, matches, guess, self.config.correction, self.config.alignment, sigma)  # III-B
        else:
            alignment = Alignment(guess, 1.0, True, 0, 1.0, 0.0, np.zeros((6, 6)), ("flow only",))
        # before a start nothing tells what moves, and what passes in front would make the keyframes
        share = 0.75 if started else 0.5
        return TwoView(pair, weight, alignment, *_motion(pair.matches, weight, self.parts.size, share))

    def accepted(self, view: TwoView) -> bool:
        """Enough static matches, and enough of them agree on the pose."""
        enough = (view.weight > 0.05).sum() >= self.config.alignment.min_matches
        return bool(enough) and view.alignment.inlier_ratio >= self.config.tracking.min_inlier_ratio

    def relocalised(self, kf: Keyframe, work: WorkFrame, prior: Future[Array]) -> TwoView | None:
        """``work`` seen from a keyframe that it may never have been near, then as ever.

        A provider that finds what is far needs no start; for the others corner features give one.
        """
        start = self._far_start(kf, work, prior)
        if start is None and not self.parts.provider.finds_far:
            return None
        view = self.compare(kf, work, prior, start, np.eye(4), near=False)
        return view if self.accepted(view) else None

    def _far_start(self, kf: Keyframe, work: WorkFrame, prior: Future[Array]) -> Array | None:
        """Flow from corner features of the static scene; None where the provider needs none, or too few agree."""
        if self.parts.provider.finds_far:
            return None
        return self.parts.features.flow(kf.work.gray, work.gray, kf.moving / 255.0, prior.get())


def matched_share(ref: Keyframe, weight: Array) -> float:
    """Share of the static points that could be matched that were, (p,) ``weight``.

    Small after a fast turn, or with someone in front.
    """
    return int((weight > 0.05).sum()) / max(int((ref.work.texture * ref.static > 0.05).sum()), 1)


def _motion(matches: Matches, weight: Array, size: tuple[int, int], share: float) -> tuple[float, int]:
    used = weight > 0.05
    if used.sum() < 10:
        return float("inf"), 0
    moved = np.linalg.norm(matches.new_px - matches.ref_px, axis=1)[used]
    return float(np.quantile(moved, share)) / float(np.sqrt(size[0] * size[1])), int(used.sum())
