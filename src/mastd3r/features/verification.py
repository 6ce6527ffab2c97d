"""Which matches of two images agree on one geometry."""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

Array = NDArray[Any]
EPIPOLAR_PX = 1.5  # so far from its epipolar line a match may be
ITERATIONS = 2000


def of_one_geometry(ref_px: Array, new_px: Array) -> Array:
    """(n,) bool, the matches (n, 2) that agree on one epipolar geometry (MAGSAC); none of fewer than eight."""
    if len(ref_px) < 8:
        return np.zeros(len(ref_px), bool)
    a, b = (np.ascontiguousarray(p, np.float64) for p in (ref_px, new_px))
    try:
        _, inlier = cv2.findFundamentalMat(a, b, cv2.USAC_MAGSAC, EPIPOLAR_PX, 0.999, ITERATIONS)
    except cv2.error:  # an assertion of OpenCV's own where every sample is degenerate: there is no geometry
        inlier = None
    return np.zeros(len(a), bool) if inlier is None else np.asarray(inlier.ravel() > 0)


def is_static(px: Array, moving: Array | None) -> Array:
    """(n,) bool, pixels (n, 2) that probably belong to the static scene, by P(moving) (h, w)."""
    if moving is None or not len(px):
        return np.ones(len(px), bool)
    at = np.clip(np.rint(px).astype(int), 0, [moving.shape[1] - 1, moving.shape[0] - 1])
    return np.asarray(moving[at[:, 1], at[:, 0]] < 0.5)
