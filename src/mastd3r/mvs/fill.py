"""Bare surfaces filled from what is known around them: a membrane over inverse depth that tears at image edges.

Inverse depth is affine over a plane's image, and a membrane through an affine outline is that plane exactly.
"""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from .fill_kernels import relax

Array = NDArray[Any]
EDGE_LEVELS = 3.0  # a difference of colour by so much divides the membrane's hold by e
LEAST_HOLD = 1e-3
DATA_WEIGHT = 5.0  # of a known pixel, in holds of the membrane
LEVELS = 5  # sizes, each half of the one before, the smallest first
SWEEPS, OVER = 24, 1.7


def filled(inv_depth: Array, known: Array, color: Array) -> Array:
    """(h, w) float32: the membrane through pixels known to the degree (h, w) 0..1, over (h, w, 3) uint8 colours.

    Known pixels are smoothed a little with their like. All 0 where nothing is known.
    """
    if not (known > 0).any():
        return np.zeros_like(inv_depth)
    value: Array | None = None
    for level in reversed(range(LEVELS)):
        h, w = (max(1, n >> level) for n in inv_depth.shape)
        size = (w, h)
        weight = cv2.resize(known.astype(np.float32), size, interpolation=cv2.INTER_AREA)
        data = cv2.resize((known * inv_depth).astype(np.float32), size, interpolation=cv2.INTER_AREA)
        data /= np.maximum(weight, 1e-9)
        if value is None:
            value = np.full((h, w), np.median(inv_depth[known > 0]), np.float32)
        else:
            value = cv2.resize(value, size, interpolation=cv2.INTER_LINEAR)
        image = cv2.resize(color, size, interpolation=cv2.INTER_AREA).astype(np.float32)
        relax(value, data, DATA_WEIGHT * weight, *_holds(image), OVER, SWEEPS)
    assert value is not None
    return value


def _holds(image: Array) -> tuple[Array, Array]:
    """(h, w) float32 weights of the differences to the right and down; 0 at the border."""
    right, down = np.zeros(image.shape[:2], np.float32), np.zeros(image.shape[:2], np.float32)
    right[:, :-1] = np.maximum(np.exp(-np.abs(np.diff(image, axis=1)).max(-1) / EDGE_LEVELS), LEAST_HOLD)
    down[:-1] = np.maximum(np.exp(-np.abs(np.diff(image, axis=0)).max(-1) / EDGE_LEVELS), LEAST_HOLD)
    return right, down
