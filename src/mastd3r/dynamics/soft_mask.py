"""The soft mask where it is used: P(static) of pixels, and the margin around what moves."""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

Array = NDArray[Any]


def static_at(moving: Array, px: Array) -> Array:
    """(p,) P(static) at pixels of a P(moving) map (h, w); the nearest pixel inside counts."""
    x = np.clip(np.round(px[:, 0]).astype(int), 0, moving.shape[1] - 1)
    y = np.clip(np.round(px[:, 1]).astype(int), 0, moving.shape[0] - 1)
    return 1.0 - moving[y, x].astype(float)


def dilated(moving: Array, by_px: int = 5) -> Array:
    """P(moving) of the worst pixel within ``by_px``: a match's window there sees the moving thing too."""
    return cv2.dilate(moving.astype(np.float32), np.ones((2 * by_px + 1, 2 * by_px + 1), np.uint8))
