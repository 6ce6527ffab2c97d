"""What the moving things of this video look like: a small Bayesian classifier, learned online from motion (III-A).

Logistic regression on random Fourier features (Rahimi, Recht 2007) of any dense descriptors: DINOv2 tokens, or plain
ones. It is taught by the geometric evidence, and no class list is needed. The weights
are a Gaussian that every frame sharpens (a Newton step of the log posterior; old frames are forgotten slowly), so that
what was never seen is answered by "unknown": 0.
"""

from __future__ import annotations

from copy import deepcopy
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from .config import DynamicsConfig

Array = NDArray[Any]
WAVES = 64  # random features beside the descriptors themselves
SAMPLES = 400  # pixels that one frame teaches
SURE_LOG_ODDS = 3.0  # evidence from which a pixel teaches with full weight
STANDING_SHARE = 0.25  # how often a thing that can move is seen to stand: one such sample says only so much
PRIOR_INFO = 4.0  # of every weight, in pixels' worth
FINE_CELLS = 96  # a row: twice as many as what is asked needs
FRAME_SHARE = 0.2  # pixels of a frame repeat one another: each counts for so much


class AppearanceClassifier:
    """One per video; tracking and the smoothing pass may share it. Deterministic."""

    def __init__(self, config: DynamicsConfig) -> None:
        self.config = config
        self._rng = np.random.default_rng(1)
        self._centre = self._scale = self._waves = self._phase = np.zeros(0, np.float32)
        self._weights = self._start = np.zeros(0)
        self._info = np.zeros((0, 0))
        self._moving_samples = 0.0  # samples that moved

    def __getstate__(self) -> dict[str, Any]:
        """Plain data."""
        return {**vars(self), "_rng": self._rng.bit_generator.state}

    def __setstate__(self, state: dict[str, Any]) -> None:
        vars(self).update(state)
        self._rng = np.random.default_rng()
        bits = self._rng.bit_generator
        bits.state = state["_rng"]

    def copy(self) -> AppearanceClassifier:
        """What it knows now; either may learn on without the other."""
        return deepcopy(self)

    def learn(self, features: Array, log_odds: Array) -> None:
        """One frame: ``features`` (h', w', c), and the geometric evidence (h, w) as log-odds without a prior."""
        size = (features.shape[1], features.shape[0])
        target = cv2.resize(log_odds, size, interpolation=cv2.INTER_AREA).reshape(-1).astype(np.float64)
        at = self._rng.integers(0, len(target), SAMPLES)
        sure = np.minimum(np.abs(target[at]) / SURE_LOG_ODDS, 1) ** 2
        cells = features.reshape(-1, features.shape[2]).astype(np.float32)
        if len(self._weights) == 0 or len(self._centre) != features.shape[2]:
            self._begin(cells)
        z = self._lifted(cells[at]).astype(np.float64)
        evidence = np.clip(target[at], np.log(STANDING_SHARE), SURE_LOG_ODDS)
        label = 1 / (1 + np.exp(-(z @ self._weights + evidence)))  # what may move is not refuted by standing
        self._moving_samples += float((target[at] > SURE_LOG_ODDS).sum())
        memory = self.config.appearance.memory
        prior = PRIOR_INFO * np.eye(len(self._weights))
        old, kept = self._weights.copy(), memory * self._info + (1 - memory) * prior
        for _ in range(2):  # Newton, from the weights so far
            p = 1 / (1 + np.exp(-z @ self._weights))
            curved = FRAME_SHARE * sure * np.maximum(p * (1 - p), 1e-3)
            info = kept + (z * curved[:, None]).T @ z
            slope = z.T @ (FRAME_SHARE * sure * (label - p)) - kept @ (self._weights - old)
            self._weights = self._weights + np.linalg.solve(
                info, slope - (1 - memory) * PRIOR_INFO * (old - self._start)
            )
        self._info = info

    def log_odds(self, features: Array) -> Array | None:
        """(h', w') float32 log-odds of moving by appearance alone; None before anything was seen to move.

        Beyond the base rate. Shrunk where the weights are unsure (MacKay's approximation), bounded by
        ``appearance.max_log_odds``. Of fine ``features`` every four cells are answered together.
        """
        if self._moving_samples < SAMPLES / 4 or len(self._centre) != features.shape[2]:
            return None
        if features.shape[1] >= FINE_CELLS:
            features = _every_four(features)
        z = self._lifted(features.reshape(-1, features.shape[2]).astype(np.float32))
        spread = np.linalg.cholesky(np.linalg.inv(self._info)).astype(np.float32)
        variance = ((z @ spread) ** 2).sum(1)
        value = z @ self._weights.astype(np.float32) / np.sqrt(1 + np.pi / 8 * variance)
        limit = self.config.appearance.max_log_odds
        value = value - np.float32(self._start[0])
        return np.clip(value, -limit, limit).reshape(features.shape[:2]).astype(np.float32)

    def _begin(self, cells: Array) -> None:
        """Scale by the first frame; wavelengths are of the size of the descriptors' spread."""
        self._centre, self._scale = cells.mean(0), 1 / (cells.std(0) + 1e-3)
        channels = cells.shape[1]
        rng = np.random.default_rng(0)
        self._waves = (rng.normal(size=(channels, WAVES)) * 1.5 / np.sqrt(channels)).astype(np.float32)
        self._phase = rng.uniform(0, 2 * np.pi, WAVES).astype(np.float32)
        n = 1 + min(channels, WAVES) + WAVES
        self._start = np.zeros(n)
        self._start[0] = np.log(self.config.base_rate / (1 - self.config.base_rate))
        self._weights, self._info = self._start.copy(), PRIOR_INFO * np.eye(n)
        self._moving_samples = 0.0

    def _lifted(self, cells: Array) -> Array:
        """(n, 1 + linear + WAVES): a constant, the descriptors (few channels only) and their waves."""
        x = np.clip((cells - self._centre) * self._scale, -6, 6)
        linear = x[:, : min(x.shape[1], WAVES)] * np.float32(0.5)
        waves = np.cos(x @ self._waves + self._phase) * np.float32(np.sqrt(2 / WAVES) * 3)
        return np.concatenate([np.ones((len(x), 1), np.float32), linear, waves], 1)


def _every_four(features: Array) -> Array:
    """(h' // 2, w' // 2, c) means of two by two cells."""
    h, w = features.shape[0] // 2 * 2, features.shape[1] // 2 * 2
    f = features[:h, :w]
    return np.asarray((f[::2, ::2] + f[1::2, ::2] + f[::2, 1::2] + f[1::2, 1::2]) * np.float32(0.25))


def plain_descriptors(image: Array, width: int, height: int) -> Array:
    """(height, width, 11) float32 of a photograph (h, w, 3) uint8: colour at three scales, strength of its edges.

    CIE Lab; no position is in it, so that a thing is known wherever it stands.
    """
    small = cv2.resize(image, (width, height), interpolation=cv2.INTER_AREA).astype(np.float32) / 255
    lab = cv2.cvtColor(small, cv2.COLOR_RGB2LAB) / np.array([50, 25, 25], np.float32)
    step_x, step_y = (cv2.Sobel(lab[..., 0], cv2.CV_32F, *axis) for axis in ((1, 0), (0, 1)))
    edges = [np.hypot(step_x, step_y), np.abs(step_x) - np.abs(step_y)]
    return cv2.merge([lab, *(cv2.GaussianBlur(lab, (0, 0), s) for s in (1.5, 4.0)),
                      *(cv2.GaussianBlur(e, (0, 0), 2.0) for e in edges)])  # fmt: skip
