"""Whether the video tells a lens that bends lines from one that does not."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from .focal_sigma import CORRELATION, residual_sigma_px
from .intrinsics import RADIAL
from .keyframe_graph import KeyframeGraph

Array = NDArray[Any]
CHI2_95 = (0.0, 3.84, 5.99, 7.81)  # by the number of terms: what chance alone seldom exceeds


def radial_is_told(graph: KeyframeGraph) -> bool:
    """After ``solve_all``: False where the cost would hardly rise without the radial terms that were found.

    The cost that the solver foresees (its information on them, all else moving along) is measured in the variance of
    the residuals and ``CORRELATION`` squared, as the sigma of the focal length is. True where they are given, none, or
    nothing is known of them.
    """
    report, g = graph.last_report, graph.intrinsics
    terms = [n for n in RADIAL if g.free[n] and g.values[n] != 0.0]
    if report is None or report.lens_covariance is None or not terms:
        return True
    covariance = report.lens_covariance[np.ix_(terms, terms)]
    moved = np.diag(covariance) > 0  # a term that waits for more keyframes has none
    if not moved.any():
        return True
    values = g.values[terms][moved]
    rise = float(values @ np.linalg.solve(covariance[np.ix_(moved, moved)], values))
    noise = CORRELATION * max(residual_sigma_px(graph, graph.config.kernel_px), 1e-6)
    return rise > CHI2_95[int(moved.sum())] * noise**2
