"""Equations (1)-(4) of the paper as printed, made unit-free: all depths enter as their logarithm."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from typing import Any, TypeVar

import cv2
import numpy as np
from numpy.typing import NDArray

from .config import DynamicsConfig
from .data import DynamicMask, DynamicsInput, WithoutMemory, check_image, check_input
from .refinement import EdgeRefinement, sigmoid

Array = NDArray[Any]
T = TypeVar("T")


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


class PaperMask(WithoutMemory):
    """Filter and smoother at once: eq. (1)-(4) know one frame alone."""

    appearance = None

    def __init__(self, config: DynamicsConfig, width: int, height: int) -> None:
        """``width``, ``height``: the working size of every image that comes later."""
        self.config, self.width, self.height = config, width, height
        self._semantic_log_odds = EdgeRefinement(config, width, height).semantic_log_odds

    def prior(self, gray: Array, semantic: Array | None = None, features: Array | None = None) -> Array:
        """P(D|S) of eq. (2), (h, w) float32. Raises InputError for an image of another size."""
        check_image(gray, "gray", self.width, self.height)
        return sigmoid(self._semantic_log_odds(semantic))

    def update(self, frame: DynamicsInput) -> DynamicMask:
        """Eq. (1)-(4). Z is the frame's own depth, or the background's without one. Raises InputError."""
        check_input(frame, self.width, self.height)
        c = self.config.paper
        inv = frame.inv_depth if frame.own_inv_depth is None else frame.own_inv_depth
        depth = np.where(inv > 0, 1 / np.maximum(inv, 1e-9), 0.0)
        anomaly = depth_anomaly(depth, c.window_px, c.tau_variance, c.tau_sigma)
        moving, static = depth_likelihoods(depth)
        prior = sigmoid(self._semantic_log_odds(frame.semantic)).astype(np.float64)
        log_odds = posterior_log_odds(prior, moving, static)
        mask = coarse_mask(moving_mask(log_odds, c.tau_bayes), anomaly)
        posterior = sigmoid(log_odds)
        unmarked = np.minimum(posterior, self.config.base_rate)
        probability = np.where(anomaly, posterior, unmarked).astype(np.float32)
        ratio = np.log(moving / static).astype(np.float32)
        return DynamicMask(probability, mask, {"depth": ratio, "anomaly": anomaly.astype(np.float32)})

    def masks(self, inputs: Iterable[tuple[DynamicsInput, T]]) -> Iterator[tuple[DynamicMask, T]]:
        """One mask an input, at once, with what came beside it. Raises InputError."""
        for frame, beside in inputs:
            yield self.update(frame), beside


class PaperModel:
    """Eq. (1)-(4) as printed, while tracking and after it."""

    needs_features = False

    def __init__(self, config: DynamicsConfig) -> None:
        self.config = config

    def filter(self, width: int, height: int) -> PaperMask:
        """For images of this working size."""
        return PaperMask(self.config.while_tracking(), width, height)

    def smoother(self, width: int, height: int, appearance: Any = None) -> PaperMask:
        """For images of this working size."""
        return PaperMask(self.config, width, height)


def build(config: DynamicsConfig) -> PaperModel:
    """For the registry."""
    return PaperModel(config)
