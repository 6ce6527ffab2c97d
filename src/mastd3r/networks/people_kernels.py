"""Convolutions of a small network on the CPU, in NumPy and numba: images are (h, w, channels) float32.

torch would do the same, but takes seconds and hundreds of MiB to be there, and a run without a map needs none of it.
What a function returns lies in the ``Kept`` that it is given, and is overwritten after the next ``again``.
"""

from __future__ import annotations

from typing import Any

import numba as nb
import numpy as np
from numpy.typing import NDArray

Array = NDArray[Any]
LINEAR, RELU, HARD_SWISH = 0, 1, 2
_F = np.float32
_JIT: dict[str, Any] = {"cache": True, "nogil": True, "fastmath": {"contract", "reassoc", "nsz"}}


class Kept:
    """Arrays for one pass after the other that ask for the same ones in the same order."""

    def __init__(self) -> None:
        self._arrays: list[Array] = []
        self._next = 0

    def again(self) -> None:
        """A new pass begins."""
        self._next = 0

    def array(self, *shape: int) -> Array:
        """Of zeros the first time, later with what is in it."""
        n, self._next = self._next, self._next + 1
        if n < len(self._arrays) and self._arrays[n].shape == shape:
            return self._arrays[n]
        self._arrays[n:] = [np.zeros(shape, _F)]
        return self._arrays[n]


def pointwise(kept: Kept, image: Array, weight: Array, bias: Array, activation: int) -> Array:
    """1 x 1 convolution: (h, w, c) by (c, d) to (h, w, d)."""
    h, w, c = image.shape
    out = kept.array(h, w, weight.shape[1])
    flat = out.reshape(h * w, -1)
    np.matmul(image.reshape(h * w, c), weight, out=flat)
    _activate(flat, bias, activation)
    return out


def patches(kept: Kept, image: Array) -> Array:
    """(h, w, c) to (h / 2, w / 2, 9 c): what a 3 x 3 kernel of stride 2 sees, zero past the lower and right border."""
    h, w, c = image.shape
    out = kept.array(h // 2, w // 2, 9 * c)
    _patches(image, out)
    return out


def depthwise(kept: Kept, image: Array, weight: Array, bias: Array, stride: int, activation: int) -> Array:
    """Each channel by its own kernel: (h, w, c) by (k, k, c) to (h / stride, w / stride, c), zero past the border.

    Of the padding that an even size needs at stride 2 the greater part is below and to the right.
    """
    h, w, c = image.shape
    k = weight.shape[0]
    before = (k - stride) // 2
    padded = kept.array(h + k - 1, w + k - 1, c)  # its border stays zero
    padded[before : before + h, before : before + w] = image
    out = kept.array(h // stride, w // stride, c)
    _depthwise(padded, weight, bias, stride, activation, out)
    return out


def twice(kept: Kept, image: Array) -> Array:
    """(h, w, c) at twice the size, bilinear, between the centres of pixels."""
    h, w, c = image.shape
    out = kept.array(2 * h, 2 * w, c)
    _twice(image, out)
    return out


def shuffled(image: Array, weight: Array, bias: Array) -> Array:
    """Transposed 2 x 2 convolution of stride 2 to one channel: (h, w, c) by (c, 4) to (2 h, 2 w), a new array."""
    h, w, c = image.shape
    four = (image.reshape(h * w, c) @ weight).reshape(h, w, 2, 2) + bias
    out: Array = four.transpose(0, 2, 1, 3).reshape(2 * h, 2 * w)
    return out


@nb.njit(**_JIT)
def channel_means(image: Array, other: Array) -> Array:
    """(c,) means of the sum of two images (h, w, c)."""
    h, w, c = image.shape
    out = np.zeros(c, np.float64)
    for j in range(h):
        row = np.zeros(c, _F)
        for i in range(w):
            for k in range(c):
                row[k] += image[j, i, k] + other[j, i, k]
        out += row
    return (out / (h * w)).astype(_F)


@nb.njit(**_JIT)
def add_gated(image: Array, other: Array, gate: Array) -> None:
    """``other``, each channel times ``gate`` (c,), is added to ``image``, both (h, w, c)."""
    h, w, c = image.shape
    for j in range(h):
        for i in range(w):
            for k in range(c):
                image[j, i, k] += other[j, i, k] * gate[k]


@nb.njit(inline="always", **_JIT)
def _activated(value: Any, activation: int) -> Any:
    if activation == 0:
        return value
    if activation == 1:
        return max(value, _F(0))
    return value * min(max(value + _F(3), _F(0)), _F(6)) * _F(1 / 6)


@nb.njit(**_JIT)
def _activate(values: Array, bias: Array, activation: int) -> None:
    n, c = values.shape
    for i in range(n):
        for k in range(c):
            values[i, k] = _activated(values[i, k] + bias[k], activation)


@nb.njit(**_JIT)
def _patches(image: Array, out: Array) -> None:
    h, w, c = image.shape
    for j in range(out.shape[0]):
        for i in range(out.shape[1]):
            n = 0
            for y in range(2 * j, 2 * j + 3):
                for x in range(2 * i, 2 * i + 3):
                    if y < h and x < w:
                        for k in range(c):
                            out[j, i, n + k] = image[y, x, k]
                    n += c


@nb.njit(**_JIT)
def _depthwise(padded: Array, weight: Array, bias: Array, stride: int, activation: int, out: Array) -> None:
    size, c = weight.shape[0], weight.shape[2]
    for j in range(out.shape[0]):
        for i in range(out.shape[1]):
            row = out[j, i]
            for k in range(c):
                row[k] = bias[k]
            for y in range(size):
                for x in range(size):
                    seen, by = padded[stride * j + y, stride * i + x], weight[y, x]
                    for k in range(c):
                        row[k] += seen[k] * by[k]
            for k in range(c):
                row[k] = _activated(row[k], activation)


@nb.njit(**_JIT)
def _twice(image: Array, out: Array) -> None:
    """Pixel 2 j of the output lies a quarter of a pixel before pixel j, pixel 2 j + 1 as far after it."""
    h, w, c = image.shape
    near, far = _F(0.75), _F(0.25)
    row = np.empty((w, c), _F)
    for j in range(2 * h):
        own = image[j // 2]
        other = image[min(max(j // 2 + (1 if j % 2 else -1), 0), h - 1)]
        for i in range(w):
            for k in range(c):
                row[i, k] = near * own[i, k] + far * other[i, k]
        for i in range(w):
            before, after = max(i - 1, 0), min(i + 1, w - 1)
            for k in range(c):
                out[j, 2 * i, k] = near * row[i, k] + far * row[before, k]
                out[j, 2 * i + 1, k] = near * row[i, k] + far * row[after, k]
