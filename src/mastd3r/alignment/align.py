"""Coarse, scale, fine in order; each can be switched off (Table IV)."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..config import AlignmentConfig, CorrectionKind
from ..geometry.sim3 import procrustes
from ..types import PairPrediction
from .coarse import icp, resect
from .fine import OwnPoints, align_fine
from .reproject import StaticMatches, solve_pose
from .result import Alignment
from .scale import correct_scale

Array = NDArray[Any]


def align(
    pair: PairPrediction,
    matches: StaticMatches,
    guess: Array,
    correction: CorrectionKind,
    config: AlignmentConfig,
    sigma_ratio: float | None,
) -> Alignment:
    """Pose of the new view of ``pair`` against its ref (III-B).

    ``none`` is what the pair says by itself: the closed form over all its matches for a provider that measures
    depth, the guess brought on to the matches by plain (almost unrobust) least squares otherwise.
    """
    if matches.count < config.min_matches:
        return Alignment.failed(guess, f"too few static matches ({matches.count} < {config.min_matches})")
    own = _own_points(pair, matches, sigma_ratio)
    pose, scale, stages = _raw(pair, matches, own, guess), 1.0, ["raw"]
    converged, iterations = True, 0
    if correction in ("coarse", "coarse-to-fine"):
        coarse = resect(matches, pose) if own is None else icp(own.ref, own.new, own.weight, pose)
        pose, converged, iterations = coarse.new_from_ref, coarse.converged, coarse.iterations
        stages.append("coarse")
        if own is not None:
            scale = _scale_of(own, matches, guess)
            pose = icp(own.ref, scale * own.new, own.weight, pose).new_from_ref
            stages.append("scale")
    information = np.zeros((6, 6))
    if correction in ("fine", "coarse-to-fine"):
        printed = config.as_printed and own is not None
        fine, scale = align_fine(matches, own, pose, scale, chamfer_weight=config.chamfer_weight, as_printed=printed)
        pose, converged, information = fine.new_from_ref, fine.converged, fine.information
        iterations += fine.iterations
        stages.append("fine")
    inlier_ratio, error_px = matches.quality(pose)
    return Alignment(pose, scale, converged, iterations, inlier_ratio, error_px, information, tuple(stages))


def _own_points(pair: PairPrediction, matches: StaticMatches, sigma_ratio: float | None) -> OwnPoints | None:
    if pair.new_own is None or sigma_ratio is None:
        return None
    weight = matches.weight * (pair.new_own.confidence > 0) * (pair.ref.confidence > 0)
    if (weight > 0.05).sum() < 30:
        return None
    return OwnPoints(pair.ref.points, pair.new_own.points, weight, sigma_ratio)


def _raw(pair: PairPrediction, matches: StaticMatches, own: OwnPoints | None, guess: Array) -> Array:
    if own is not None:
        return procrustes(own.new, own.ref, (own.weight > 0).astype(float)).rigid
    return solve_pose(matches, guess, kernel_px=50.0, iterations=10).new_from_ref


def _scale_of(own: OwnPoints, matches: StaticMatches, guess: Array) -> float:
    """Eq. (9) under the pose that the matches give: a rigid fit of the clouds hides the scale in its translation."""
    pose = resect(matches, guess).new_from_ref
    return correct_scale(own.ref, own.new, matches.target, own.weight, pose)
