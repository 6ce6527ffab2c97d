"""Equations (1)-(4) of the paper as printed, made unit-free: all depths enter as their logarithm."""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

Array = NDArray[Any]


def local_log_variance(log_depth: Array, valid: Array, window_px: int) -> Array:
    """sigma_local^2 of eq. (1): variance of log depth over the valid pixels of a square window, (h, w) float32."""
    size = (window_px, window_px)
    weight = valid.astype(np.float64)
    centre = float(log_depth[valid].mean()) if valid.any() else 0.0
    shifted = np.where(valid, log_depth - centre, 0.0)
    count = np.maximum(cv2.blur(weight, size), 1e-9)
    mean = cv2.blur(shifted, size) / count
    square = cv2.blur(shifted * shifted, size) / count
    return np.where(valid, np.maximum(square - mean * mean, 0.0), 0.0).astype(np.float32)


def depth_anomaly(depth: Array, window_px: int, tau_variance: float, tau_sigma: float) -> Array:
    """M_depth of eq. (1), (h, w) bool. Depth in any unit, 0 = none; unknown pixels are no anomaly.

    mu and sigma are those of log depth over the whole image, so that the result does not change with the unit.
    """
    valid = depth > 0
    log_depth = np.log(np.where(valid, depth, 1.0).astype(np.float64))
    if not valid.any():
        return np.zeros(depth.shape, bool)
    mean, sigma = float(log_depth[valid].mean()), float(log_depth[valid].std())
    far_off = np.abs(log_depth - mean) > tau_sigma * sigma
    uneven = local_log_variance(log_depth, valid, window_px) > tau_variance
    return valid & (uneven | far_off)


def posterior_log_odds(prior: Array, depth_given_moving: Array, depth_given_static: Array) -> Array:
    """Eq. (2) in log-odds: log P(D|S)/P(not D|S) + log P(Z|D)/P(Z|not D). Likelihoods > 0, prior in (0, 1)."""
    return np.log(prior) - np.log1p(-prior) + np.log(depth_given_moving) - np.log(depth_given_static)


def moving_mask(log_odds: Array, tau_bayes: float) -> Array:
    """M_dynamic of eq. (3): posterior above tau_bayes, decided in log-odds."""
    return log_odds > np.log(tau_bayes) - np.log1p(-tau_bayes)


def coarse_mask(moving: Array, anomaly: Array) -> Array:
    """M_coarse of eq. (4): the intersection."""
    return moving & anomaly


def depth_likelihoods(depth: Array) -> tuple[Array, Array]:
    """(P(Z|D), P(Z|not D)) of log depth; the paper leaves them open.

    Static: the image's own Gaussian of eq. (1). Moving: uniform over the range of log depth seen. Unknown depth
    gives equal likelihoods.
    """
    valid = depth > 0
    even = np.ones(depth.shape)
    if not valid.any():
        return even, even
    log_depth = np.log(np.where(valid, depth, 1.0).astype(np.float64))
    mean, sigma = float(log_depth[valid].mean()), max(float(log_depth[valid].std()), 1e-3)
    span = max(float(np.ptp(log_depth[valid])), 1e-3)
    static = np.exp(-0.5 * ((log_depth - mean) / sigma) ** 2) / (sigma * np.sqrt(2 * np.pi))
    return np.where(valid, 1 / span, even), np.where(valid, np.maximum(static, 1e-12), even)
