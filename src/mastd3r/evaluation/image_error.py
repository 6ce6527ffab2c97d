"""PSNR and SSIM of RGB images in 0..1, whole or over chosen pixels.

SSIM: Wang et al., "Image quality assessment: from error visibility to structural similarity", TIP 2004,
with the paper's Gaussian window (sigma 1.5, 11 by 11), averaged over channels.
"""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from ..errors import InputError

Array = NDArray[Any]
SIGMA_PX = 1.5
RADIUS_PX = 5  # 3.5 sigma, rounded
C1, C2 = 0.01**2, 0.03**2  # eqs. (9) and (12) with a data range of 1


def psnr(a: Array, b: Array, where: Array | None = None) -> float | None:
    """Peak signal-to-noise ratio in dB of two (h, w, 3) images in 0..1; inf where they are equal.

    ``where`` is (h, w) bool; None where it chooses no pixel. Raises InputError for shapes that differ.
    """
    a, b = _pair(a, b, where)
    squared = (a - b) ** 2
    if where is not None:
        squared = squared[where]
    if squared.size == 0:
        return None
    error = float(squared.mean())
    return float("inf") if error == 0 else float(-10 * np.log10(error))


def ssim(a: Array, b: Array, where: Array | None = None) -> float | None:
    """Mean structural similarity of two (h, w, 3) images in 0..1, TIP 2004 eq. (13).

    Pixels nearer than five to the border have no full window and do not count. ``where`` is (h, w) bool;
    None where it chooses no pixel that counts. Raises InputError for shapes that differ or are below 11 px.
    """
    a, b = _pair(a, b, where)
    if min(a.shape[:2]) <= 2 * RADIUS_PX:
        raise InputError(f"SSIM: expected images of {2 * RADIUS_PX + 1} px or more a side, got {a.shape[:2]}")
    kernel = np.exp(-0.5 * (np.arange(-RADIUS_PX, RADIUS_PX + 1) / SIGMA_PX) ** 2)
    kernel /= kernel.sum()
    inner = slice(RADIUS_PX, -RADIUS_PX)

    def blur(image: Array) -> Array:
        return np.asarray(cv2.sepFilter2D(image, cv2.CV_64F, kernel, kernel))[inner, inner]

    mean_a, mean_b = blur(a), blur(b)
    var_a, var_b = blur(a * a) - mean_a**2, blur(b * b) - mean_b**2
    covariance = blur(a * b) - mean_a * mean_b
    similarity = (2 * mean_a * mean_b + C1) * (2 * covariance + C2)
    similarity /= (mean_a**2 + mean_b**2 + C1) * (var_a + var_b + C2)
    if where is not None:
        similarity = similarity[where[inner, inner]]
    return float(similarity.mean()) if similarity.size else None


def _pair(a: Array, b: Array, where: Array | None) -> tuple[Array, Array]:
    a, b = np.ascontiguousarray(a, float), np.ascontiguousarray(b, float)
    if a.shape != b.shape or a.ndim != 3:
        raise InputError(f"image error: expected two (h, w, 3) images of one shape, got {a.shape} and {b.shape}")
    if where is not None and where.shape != a.shape[:2]:
        raise InputError(f"image error: expected pixels to compare of shape {a.shape[:2]}, got {where.shape}")
    return a, b
