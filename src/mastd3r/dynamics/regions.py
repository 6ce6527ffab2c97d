"""Smoothing inside image edges: the guided filter (He, Sun, Tang 2013), weighted, from box filters only."""

from __future__ import annotations

from typing import Any

import cv2
import numba
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


def region_mean(guide: Array, value: Array, weight: Array, radius_px: float, edge: float) -> Array:
    """Weighted mean of ``value`` over the region that each pixel belongs to, (h, w) float32.

    A recursive filter in the domain transform of ``guide`` (Gastal, Oliveira 2011): an edge of ``edge`` grey levels
    is as long a way as ``radius_px`` pixels. Unlike a window it follows regions of any shape.
    """
    step_x: Array = np.ones((1, 1), np.float32)
    step_y: Array = np.ones((1, 1), np.float32)
    for layer in [guide] if guide.ndim == 2 else cv2.split(guide):
        step_x = step_x + np.float32(radius_px / edge) * np.abs(np.diff(layer, axis=1))
        step_y = step_y + np.float32(radius_px / edge) * np.abs(np.diff(layer, axis=0))
    both = cv2.merge([(value * weight).astype(np.float32), weight.astype(np.float32)])
    rounds = 3
    for i in range(rounds):
        sigma = radius_px * np.sqrt(3) * 2 ** (rounds - 1 - i) / np.sqrt(4**rounds - 1)
        decay = np.float32(-np.sqrt(2) / sigma)
        _recursive_x(both, np.exp(decay * step_x).astype(np.float32))
        _recursive_y(both, np.exp(decay * step_y).astype(np.float32))
    return both[..., 0] / np.maximum(both[..., 1], np.float32(1e-6))


@numba.njit(cache=True, fastmath=False, nogil=True)
def _recursive_x(both: Array, pass_on: Array) -> None:
    h, w, n = both.shape
    for y in range(h):
        for x in range(1, w):
            a = pass_on[y, x - 1]
            for k in range(n):
                both[y, x, k] += a * (both[y, x - 1, k] - both[y, x, k])
        for x in range(w - 2, -1, -1):
            a = pass_on[y, x]
            for k in range(n):
                both[y, x, k] += a * (both[y, x + 1, k] - both[y, x, k])


@numba.njit(cache=True, fastmath=False, nogil=True)
def _recursive_y(both: Array, pass_on: Array) -> None:
    h, w, n = both.shape
    for y in range(1, h):
        for x in range(w):
            a = pass_on[y - 1, x]
            for k in range(n):
                both[y, x, k] += a * (both[y - 1, x, k] - both[y, x, k])
    for y in range(h - 2, -1, -1):
        for x in range(w):
            a = pass_on[y, x]
            for k in range(n):
                both[y, x, k] += a * (both[y + 1, x, k] - both[y, x, k])
