"""III-B in three stages, coarse, scale, fine; each can be switched off (Table IV)."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

from numpy.typing import NDArray

from ..config import AlignmentConfig
from ..geometry.sim3 import procrustes
from ..protocols import Aligner
from ..types import USABLE_WEIGHT, PairPrediction
from .coarse import icp, resect
from .fine import OwnPoints, align_fine
from .problem import AlignmentProblem
from .reproject import StaticMatches, solve_pose
from .result import Alignment
from .scale import correct_scale

Array = NDArray[Any]


class CoarseToFine:
    """The paper's aligner. Where the map has no structure yet there is nothing to align with: the guess stays."""

    def __init__(self, config: AlignmentConfig, *, use_coarse: bool = True, use_fine: bool = True) -> None:
        """Without coarse and fine the pose is what the pair says by itself.

        That is the closed form over all its matches for a provider that measures depth, and otherwise the guess
        brought on to the matches by plain (almost unrobust) least squares.
        """
        self.config, self.use_coarse, self.use_fine = config, use_coarse, use_fine

    def coarse(self, problem: AlignmentProblem) -> Alignment:
        """Eq. (8): ICP of both clouds, or of the static points in the image where new has no cloud of its own."""
        matches, guess = problem.matches, problem.guess
        if matches is None:
            return Alignment(guess, 1.0, True, 1.0, 0.0, ("flow only",))
        if matches.count < self.config.min_matches:
            few = f"too few static matches ({matches.count} < {self.config.min_matches})"
            return Alignment.failed(guess, few)
        own = _own_points(problem.pair, matches, problem.sigma_ratio)
        pose = _raw(matches, own, guess)
        if not self.use_coarse:
            return Alignment(pose, 1.0, True, 0.0, float("inf"), ("raw",))
        found = resect(matches, pose) if own is None else icp(own.ref, own.new, own.weight, pose)
        return Alignment(found.new_from_ref, 1.0, found.converged, 0.0, float("inf"), ("raw", "coarse"))

    def scale(self, problem: AlignmentProblem, coarse: Alignment) -> Alignment:
        """Eq. (9)(10): new's lengths brought to the map's, and the clouds aligned once more."""
        matches = problem.matches
        if matches is None or coarse.has_failed or not self.use_coarse:
            return coarse
        own = _own_points(problem.pair, matches, problem.sigma_ratio)
        if own is None:
            return coarse
        scale = _scale_of(own, matches, problem.guess)
        pose = icp(own.ref, scale * own.new, own.weight, coarse.new_from_ref).new_from_ref
        return replace(coarse, new_from_ref=pose, scale=scale, stages=(*coarse.stages, "scale"))

    def fine(self, problem: AlignmentProblem, scaled: Alignment) -> Alignment:
        """Eq. (11)(12), and what share of the matches the pose explains in the end."""
        matches = problem.matches
        if matches is None or scaled.has_failed:
            return scaled
        found = scaled
        if self.use_fine:
            own = _own_points(problem.pair, matches, problem.sigma_ratio)
            fine, scale = align_fine(
                matches,
                own,
                scaled.new_from_ref,
                scaled.scale,
                chamfer_weight=self.config.chamfer_weight,
                as_printed=self.config.as_printed and own is not None,
            )
            found = replace(
                scaled,
                new_from_ref=fine.new_from_ref,
                scale=scale,
                converged=fine.converged,
                stages=(*scaled.stages, "fine"),
            )
        inlier_ratio, error_px = matches.quality(found.new_from_ref)
        return replace(found, inlier_ratio=inlier_ratio, error_px=error_px)


def align(aligner: Aligner, problem: AlignmentProblem) -> Alignment:
    """All three stages in order."""
    return aligner.fine(problem, aligner.scale(problem, aligner.coarse(problem)))


def build_none(config: AlignmentConfig) -> CoarseToFine:
    """What the pair says by itself."""
    return CoarseToFine(config, use_coarse=False, use_fine=False)


def build_coarse(config: AlignmentConfig) -> CoarseToFine:
    """Eq. (8)-(10) alone."""
    return CoarseToFine(config, use_fine=False)


def build_fine(config: AlignmentConfig) -> CoarseToFine:
    """Eq. (11)(12) alone."""
    return CoarseToFine(config, use_coarse=False)


def build_coarse_to_fine(config: AlignmentConfig) -> CoarseToFine:
    """Eq. (8)-(12)."""
    return CoarseToFine(config)


def _own_points(pair: PairPrediction, matches: StaticMatches, sigma_ratio: float | None) -> OwnPoints | None:
    if pair.new_own is None or sigma_ratio is None:
        return None
    weight = matches.weight * (pair.new_own.confidence > 0) * (pair.ref.confidence > 0)
    if (weight > USABLE_WEIGHT).sum() < 30:
        return None
    return OwnPoints(pair.ref.points, pair.new_own.points, weight, sigma_ratio)


def _raw(matches: StaticMatches, own: OwnPoints | None, guess: Array) -> Array:
    if own is not None:
        return procrustes(own.new, own.ref, (own.weight > 0).astype(float)).rigid
    return solve_pose(matches, guess, kernel_px=50.0, iterations=10).new_from_ref


def _scale_of(own: OwnPoints, matches: StaticMatches, guess: Array) -> float:
    """Eq. (9) under the pose that the matches give: a rigid fit of the clouds hides the scale in its translation."""
    pose = resect(matches, guess).new_from_ref
    return correct_scale(own.ref, own.new, matches.target, own.weight, pose)
