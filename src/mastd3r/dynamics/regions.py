"""Smoothing inside image edges: the guided filter (He, Sun, Tang 2013) and a recursive filter."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import cv2
import numba
import numpy as np
from numpy.typing import NDArray

Array = NDArray[Any]
Layer = tuple[Array, float]  # (h, w) uint8 or float32, and what a unit of it counts


def box(image: Array, radius_px: int) -> Array:
    """Mean over a square window of 2 radius + 1 pixels; the border is reflected."""
    size = 2 * radius_px + 1
    return cv2.blur(image, (size, size), borderType=cv2.BORDER_REFLECT)


def guided_coefficients(guide: Array, value: Array, radius_px: int, edge: float) -> tuple[Array, Array]:
    """(a, b), each (h, w) float32: around every pixel value ~ a·guide + b, a least-squares line.

    ``edge`` is the guide's contrast (its own unit) that counts as an edge.
    """
    mean_g, mean_v = box(guide, radius_px), box(value, radius_px)
    cov = box(guide * value, radius_px) - mean_g * mean_v
    var = np.maximum(box(guide * guide, radius_px) - mean_g * mean_g, 0)
    a = cov / (var + np.float32(edge * edge))
    return box(a, radius_px), box(mean_v - a * mean_g, radius_px)


ROUNDS = 3  # of the recursive filter, each half as wide as the one before
ROWS_AT_ONCE = 8  # a row is one chain of sums: several side by side keep the processor busy


def region_mean(guide: Sequence[Layer], value: Array, weight: Array | None, radius_px: float, edge: float) -> Array:
    """Weighted mean of ``value`` over the region that each pixel belongs to, (h, w) float32; plain mean without weight.

    A recursive filter in the domain transform of ``guide`` (Gastal, Oliveira 2011): an edge of ``edge`` grey levels,
    summed over its layers, is as long a way as ``radius_px`` pixels. Unlike a window it follows regions of any shape.
    """
    widest = radius_px * np.sqrt(3) * 2 ** (ROUNDS - 1) / np.sqrt(4**ROUNDS - 1)
    decay = np.float32(-np.sqrt(2) / widest)
    share_x, share_y = np.full(value.shape, decay), np.full(value.shape, decay)
    for layer, gain in guide:
        _add_ways(layer, decay * np.float32(gain * radius_px / edge), share_x, share_y)
    for share in (share_x, share_y):
        np.exp(share, out=share)
    if weight is None:  # all ones stay ones
        mean = np.array(value, np.float32)
        _filtered(mean, share_x, share_y)
        return mean
    total, over = np.array(weight, np.float32), (value * weight).astype(np.float32)
    _filtered(over, share_x.copy(), share_y.copy())
    _filtered(total, share_x, share_y)
    return np.asarray(over / np.maximum(total, np.float32(1e-6)))


def _filtered(values: Array, share_x: Array, share_y: Array) -> None:
    """All rounds, in place. The shares of a narrower round are the squares of those before: they change too."""
    for n in range(ROUNDS):
        _along_x(values, share_x)
        _along_y(values, share_y)
        if n < ROUNDS - 1:
            for share in (share_x, share_y):
                cv2.multiply(share, share, dst=share)


_JIT: dict[str, Any] = {"cache": True, "nogil": True, "error_model": "numpy"}


@numba.njit(fastmath={"contract", "reassoc"}, **_JIT)
def _add_ways(layer: Array, scale: float, right: Array, below: Array) -> None:
    """Add ``scale`` times the steps of one layer, from each pixel to the one right of it and to the one below."""
    h, w = layer.shape
    for j in range(h):
        for i in range(w - 1):
            right[j, i] += scale * abs(np.float32(layer[j, i + 1]) - np.float32(layer[j, i]))
    for j in range(h - 1):
        for i in range(w):
            below[j, i] += scale * abs(np.float32(layer[j + 1, i]) - np.float32(layer[j, i]))


@numba.njit(fastmath=False, **_JIT)
def _along_x(values: Array, share: Array) -> None:
    h, w = values.shape
    for top in range(0, h, ROWS_AT_ONCE):
        end = min(top + ROWS_AT_ONCE, h)
        for x in range(1, w):
            for y in range(top, end):
                values[y, x] += share[y, x - 1] * (values[y, x - 1] - values[y, x])
        for x in range(w - 2, -1, -1):
            for y in range(top, end):
                values[y, x] += share[y, x] * (values[y, x + 1] - values[y, x])


@numba.njit(fastmath=False, **_JIT)
def _along_y(values: Array, share: Array) -> None:
    h, w = values.shape
    for y in range(1, h):
        for x in range(w):
            values[y, x] += share[y - 1, x] * (values[y - 1, x] - values[y, x])
    for y in range(h - 2, -1, -1):
        for x in range(w):
            values[y, x] += share[y, x] * (values[y + 1, x] - values[y, x])
