"""The frame's own depth against what the map expects there (III-A, our term a)."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from .config import DynamicsConfig
from .data import DynamicsInput

Array = NDArray[Any]
_FRONT, _BEHIND = 0.8, 0.2  # share of a moving thing's mass before and behind the background
_SPAN = 3.0  # width of the broad law on each side, in log depth: a factor of 20


def depth_log_ratio(given: DynamicsInput, config: DynamicsConfig) -> Array:
    """log P(Z|D) - log P(Z|not D), (h, w) float32, 0 where either depth is unknown.

    Not D: normal around the background, its variance and the measurement's added, with a share of wrong depths.
    D: uniform in log depth, with more mass in front of the background than behind.
    """
    if given.own_inv_depth is None:
        return np.zeros(given.gray.shape, np.float32)
    own, background = given.own_inv_depth, given.inv_depth
    known = (own > 0) & (background > 0) & np.isfinite(given.inv_depth_sigma)
    own, background = np.where(known, own, 1.0), np.where(known, background, 1.0)
    nearer = np.log(own / background)  # > 0: in front
    spread = np.where(known, given.inv_depth_sigma, 0.0) / background
    sigma = np.sqrt(spread**2 + config.depth_noise_ratio**2)
    static = np.exp(-0.5 * (nearer / sigma) ** 2) / (sigma * np.sqrt(2 * np.pi))
    broad = np.where(nearer > 0, _FRONT, _BEHIND) / _SPAN
    still, wrong = config.still_share, config.outlier_share
    ratio = np.log(still * static + (1 - still) * broad) - np.log((1 - wrong) * static + wrong * 0.5 / _SPAN)
    return np.where(known, ratio, 0.0).astype(np.float32)
