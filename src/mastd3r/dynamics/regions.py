"""Smoothing inside image edges: the guided filter (He, Sun, Tang 2013), weighted, from box filters only."""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

Array = NDArray[Any]


def box(image: Array, radius_px: int) -> Array:
    """Mean over a square window of 2 radius + 1 pixels; the border is reflected."""
    size = 2 * radius_px + 1
    return cv2.blur(image, (size, size), borderType=cv2.BORDER_REFLECT)


def guided_coefficients(guide: Array, value: Array, weight: Array, radius_px: int, edge: float) -> tuple[Array, Array]:
    """(a, b), each (h, w): around every pixel value ~ a·guide + b, a weighted least-squares line.

    ``edge`` is the guide's contrast (its own unit) that counts as an edge; the slope fades where the weights do.
    """
    total = box(weight, radius_px) + 1e-4
    mean_g = box(weight * guide, radius_px) / total
    mean_v = box(weight * value, radius_px) / total
    cov = box(weight * guide * value, radius_px) / total - mean_g * mean_v
    var = np.maximum(box(weight * guide * guide, radius_px) / total - mean_g * mean_g, 0)
    a = cov / (var + edge * edge)
    b = mean_v - a * mean_g
    share = np.minimum(total / (box(total, radius_px) + 1e-4), 4.0)
    norm = box(share, radius_px)
    return box(a * share, radius_px) / norm, box(b * share, radius_px) / norm


def guided(guide: Array, value: Array, weight: Array, radius_px: int, edge: float) -> Array:
    """``value`` (h, w) float32 smoothed inside the edges of ``guide``; pixels of weight 0 are filled in."""
    a, b = guided_coefficients(guide, value, weight, radius_px, edge)
    return a * guide + b
