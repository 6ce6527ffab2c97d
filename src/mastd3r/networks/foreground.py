"""Which cells of an image are foreground, from their features alone: no classes, no training.

The paper takes the normalised DINOv2 response as prior P(D|S) and defines it no further (III-A, eq. (2)). Here it is
the first principal component of the features, scaled to 0..1. Its sign is not given by the data, so it is stated:
the border of an image is background on average.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.sparse.linalg import eigsh

from ..errors import InputError

Array = NDArray[Any]

MEMORY_FRAMES = 30  # about a second of video
LOW_PERCENT, HIGH_PERCENT = 2.0, 98.0  # of the cells, mapped to 0 and 1
TURN_RATIO = 0.1  # the border must contradict the sign by so many deviations before it is turned
DENSE_CHANNELS = 32  # below, the dense eigenvectors are quicker
FLAT_RATIO = 1e-9  # variance along the component / mean square of the features, below: nothing stands out


def foreground_prior(features: Array) -> Array:
    """(rows, cols, c) features of one image to (rows, cols) float32 in 0..1, 1 = foreground. Raises InputError."""
    return ForegroundPrior()(features)


class ForegroundPrior:
    """The same over a video: component, sign and scale are running means, so that the prior does not flicker."""

    def __init__(self, memory_frames: int = MEMORY_FRAMES) -> None:
        self.memory_frames, self.frames = memory_frames, 0
        self.covariance: Array = np.zeros(0)  # (c, c) within frames
        self.border: Array = np.zeros(0)  # (c,) mean of the border minus mean of the rest
        self.axis: Array | None = None  # (c,) unit length, towards the foreground
        self.limits: Array = np.zeros(2)  # projections that are mapped to 0 and 1

    def __call__(self, features: Array) -> Array:
        """(rows, cols, c) of the next frame to (rows, cols) float32 in 0..1; all 0 where nothing stands out.

        Raises InputError for features that are not finite.
        """
        if not np.isfinite(features).all():
            raise InputError("foreground prior: expected finite features, got some that are not")
        rows, cols, channels = features.shape
        cells = features.reshape(-1, channels).astype(np.float64)
        centred = cells - cells.mean(0)
        at_border = border_cells(rows, cols).reshape(-1)
        self.frames += 1
        share = max(1 / self.frames, 1 / self.memory_frames)
        self.covariance = _mixed(self.covariance, centred.T @ centred / len(cells), share)
        self.border = _mixed(self.border, centred[at_border].mean(0) - centred[~at_border].mean(0), share)
        axis, variance = _first_component(self.covariance, self.axis)
        if variance <= FLAT_RATIO * np.mean(cells**2):
            return np.zeros((rows, cols), np.float32)
        axis, turned = self._towards_foreground(axis, variance)
        projection = cells @ axis
        limits = np.percentile(projection, [LOW_PERCENT, HIGH_PERCENT])
        before = -self.limits[::-1] if turned else self.limits
        self.limits = limits if self.axis is None else _mixed(before, limits, share)
        self.axis = axis
        span = max(self.limits[1] - self.limits[0], np.finfo(np.float64).tiny)
        prior = np.clip((projection - self.limits[0]) / span, 0.0, 1.0)
        return prior.reshape(rows, cols).astype(np.float32)

    def _towards_foreground(self, axis: Array, variance: float) -> tuple[Array, bool]:
        """The axis with its sign, and whether that is another sign than before."""
        if self.axis is None:
            return (-axis if axis @ self.border > 0 else axis), False
        axis = -axis if axis @ self.axis < 0 else axis
        if axis @ self.border > TURN_RATIO * np.sqrt(variance):
            return -axis, True
        return axis, False


def border_cells(rows: int, cols: int) -> Array:
    """(rows, cols) bool: the outer ring, a tenth of the shorter side wide. Smaller grids than 3 x 3 have no inside."""
    wide = max(1, min(rows, cols) // 10)
    ring = np.ones((rows, cols), bool)
    ring[wide : rows - wide, wide : cols - wide] = False
    if ring.all():
        raise InputError(f"foreground prior: expected at least 3 x 3 cells, got {rows} x {cols}")
    return ring


def _mixed(old: Array, new: Array, share: float) -> Array:
    return new if old.shape != new.shape else (1 - share) * old + share * new


def _first_component(covariance: Array, start: Array | None) -> tuple[Array, float]:
    """Unit eigenvector of the largest eigenvalue, and that eigenvalue."""
    if len(covariance) < DENSE_CHANNELS:
        values, vectors = np.linalg.eigh(covariance)
        return vectors[:, -1], float(values[-1])
    if start is None or len(start) != len(covariance):
        start = covariance[:, np.argmax(np.diag(covariance))]
    if not start.any():
        return np.eye(len(covariance))[0], 0.0
    values, vectors = eigsh(covariance, k=1, which="LA", v0=start)
    return vectors[:, 0], float(values[0])
