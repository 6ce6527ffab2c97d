"""The frame's own depth against what the map expects there (III-A, our term a)."""

from __future__ import annotations

import math
from typing import Any

import numba as nb
import numpy as np
from numpy.typing import NDArray

from .config import DynamicsConfig
from .data import DynamicsInput

Array = NDArray[Any]
_FRONT, _BEHIND = 0.8, 0.2  # share of a moving thing's mass before and behind the background
_SPAN = 3.0  # width of the broad law on each side, in log depth: a factor of 20


def depth_log_ratio(frame: DynamicsInput, config: DynamicsConfig) -> Array:
    """log P(Z|D) - log P(Z|not D), (h, w) float32, 0 where either depth is unknown.

    Not D: normal around the background, its variance and the measurement's added, with a share of wrong depths.
    D: uniform in log depth, with more mass in front of the background than behind.
    """
    if frame.own_inv_depth is None:
        return np.zeros(frame.gray.shape, np.float32)
    maps = (frame.own_inv_depth, frame.inv_depth, frame.inv_depth_sigma)
    flat = (np.ascontiguousarray(m, np.float32).reshape(-1) for m in maps)
    shares = config.depth.noise_ratio, config.still_share, config.outlier_share
    ratio: Array = _log_ratio(*flat, *shares)
    return ratio.reshape(frame.gray.shape)


@nb.njit(cache=True, error_model="numpy", nogil=True)
def _log_ratio(
    own: Array, background: Array, background_sigma: Array, noise_ratio: float, still_share: float, wrong_share: float
) -> Array:
    out = np.zeros(len(own), np.float32)
    for n in range(len(own)):
        if not (own[n] > 0 and background[n] > 0 and math.isfinite(background_sigma[n])):
            continue
        nearer = math.log(own[n] / background[n])  # > 0: in front
        sigma = math.sqrt((background_sigma[n] / background[n]) ** 2 + noise_ratio**2)
        static = math.exp(-0.5 * (nearer / sigma) ** 2) / (sigma * math.sqrt(2 * math.pi))
        broad = (_FRONT if nearer > 0 else _BEHIND) / _SPAN
        moving = still_share * static + (1 - still_share) * broad
        out[n] = math.log(moving) - math.log((1 - wrong_share) * static + wrong_share * 0.5 / _SPAN)
    return out
