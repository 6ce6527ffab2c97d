"""What floats: a depth that nothing holds is no depth of a static thing (III-A, beside our term b).

A thing that moves along the epipolar line moves as a static point of some other depth would, and flow alone cannot
tell. But what stands, lies or hangs is held by something as near as itself, which is held in turn, up to the image's
border. So from a static pixel a way leads to the border on which depth never leaps back. A wrong depth stands alone.
"""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from .config import DynamicsConfig
from .data import DynamicsInput

Array = NDArray[Any]
CELL_PX = 8  # depths are solved for cells of about this size
LEAST_LEAP, SURE_LEAP = np.log(2.0), np.log(3.0)  # of depth, on the best way to the border, beyond both sigmas


def floating_log_ratio(frame: DynamicsInput, config: DynamicsConfig) -> Array:
    """log P(leap | moving) - log P(leap | static), (h, w) float32 in 0 … ``floating_gain``; 0 where depth is held."""
    leap = leap_to_border(frame.inv_depth, frame.inv_depth_sigma)
    ratio = config.support.floating_gain * np.clip((leap - LEAST_LEAP) / (SURE_LEAP - LEAST_LEAP), 0, 1)
    height, width = frame.inv_depth.shape
    full: Array = cv2.resize(ratio.astype(np.float32), (width, height), interpolation=cv2.INTER_LINEAR)
    return full


def leap_to_border(inv_depth: Array, sigma: Array) -> Array:
    """(h', w') float32, a cell each: how far back in log depth one must go on the best way to the image's border.

    Negative or 0 where there is a way that never goes back. The thing is taken as far and the way as near as 1 sigma
    allows; a cell's neighbours count as the way, as supports may be thin.
    """
    size = (max(inv_depth.shape[1] // CELL_PX, 3), max(inv_depth.shape[0] // CELL_PX, 3))
    unknown = ~(np.isfinite(sigma) & (inv_depth > 0))
    inv = cv2.resize(np.where(unknown, 1e-9, inv_depth).astype(np.float32), size, interpolation=cv2.INTER_AREA)
    wide = cv2.resize(np.where(unknown, 1.0, sigma).astype(np.float32), size, interpolation=cv2.INTER_AREA)
    spread = np.log1p(np.minimum(wide / inv, 1.0))
    around = np.ones((3, 3), np.uint8)
    near = cv2.dilate(np.log(inv) + spread, around)
    level = near.copy()
    level[1:-1, 1:-1] = -np.inf
    for _ in range(size[0] * size[1]):
        reached = np.minimum(cv2.dilate(level, around), near)
        if np.array_equal(reached, level):
            break
        level = reached
    leap: Array = cv2.erode((np.log(inv) - spread - level).astype(np.float32), around)  # cells at an edge are mixed
    return leap
