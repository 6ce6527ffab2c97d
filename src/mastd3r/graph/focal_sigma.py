"""How well the focal length is known: the solver's sigma, made honest."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from .intrinsics import PRIOR_FOCAL_SIGMA
from .keyframe_graph import KeyframeGraph
from .match_noise import squared_residuals

CORRELATION = 20.0  # errors of matches are alike within a view, so that they say less than as many independent ones
SYSTEMATIC = 0.027  # 1 sigma of what no number of matches takes away, from sequences with truth
ASSUMED = 0.5  # of the prior's sigma: where more is left, the data have hardly spoken


@dataclass(frozen=True)
class FocalKnowledge:
    """1 sigma of log f, and whether that is the usual guess rather than what the video says."""

    sigma_ratio: float
    assumed: bool


def focal_knowledge(graph: KeyframeGraph) -> FocalKnowledge | None:
    """After ``solve_all``; None where the focal length is given, or nothing was solved yet.

    The solver's information on log f, under unit pixel noise and without the prior's part of it, is divided by the
    variance of the weighted residuals and by ``CORRELATION`` squared; ``SYSTEMATIC`` is added to the sigma that is
    left, then the prior's own information. docs/joint_optimisation.md says how the two constants were found.
    """
    report, intrinsics = graph.last_report, graph.intrinsics
    if report is None or not intrinsics.free[0]:
        return None
    found = 0.0
    if np.isfinite(report.focal_sigma_ratio):
        unit = max(report.focal_sigma_ratio**-2 - float(intrinsics.prior_info[0]), 0.0)
        noise = CORRELATION * max(residual_sigma_px(graph, graph.config.kernel_px), 1e-6)
        found = 1 / (noise**2 / max(unit, 1e-12) + SYSTEMATIC**2)
    sigma = float((found + PRIOR_FOCAL_SIGMA**-2) ** -0.5)
    return FocalKnowledge(sigma, sigma > ASSUMED * PRIOR_FOCAL_SIGMA)


def residual_sigma_px(graph: KeyframeGraph, kernel_px: float) -> float:
    """1 sigma of a coordinate of the residuals as the robust solver weighs them: sqrt(Σ u² |r|² / 2 Σ u).

    With u the weight that each match has in the normal equations, this times the solver's sigma is that of errors
    which are independent, whatever their distribution.
    """
    squares = weights = 0.0
    for e in graph.edges:
        r2 = squared_residuals(graph, e)
        u = e.weight / (1 + r2 / kernel_px**2)
        squares, weights = squares + float((u**2 * r2).sum()), weights + float(u.sum())
    return float(np.sqrt(squares / max(2 * weights, 1e-12)))


def focal_facts(graph: KeyframeGraph, *, given: bool) -> dict[str, Any]:
    """Where the focal length comes from, and its relative 1-sigma; None where it is ``given``."""
    if given:
        return {"found": "given", "focal_sigma_ratio": None}
    known = focal_knowledge(graph)
    assumed = known is None or known.assumed
    start = "EXIF" if graph.intrinsics.focal_source == "EXIF" else "assumed"
    sigma_ratio = PRIOR_FOCAL_SIGMA if known is None else known.sigma_ratio
    return {"found": start if assumed else "from the video", "focal_sigma_ratio": sigma_ratio}
