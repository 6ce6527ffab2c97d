"""Sub-pixel patch alignment, the matches of eq. (7): inverse-compositional Lucas-Kanade with gain, bias
and a local affine warp.

Baker & Matthews, "Lucas-Kanade 20 years on", IJCV 2004 (inverse compositional, linear appearance variation).
The template is drawn once as the other image should show it, so that a step reads whole rows of that one.
"""

from __future__ import annotations

import math
from typing import Any

import cv2
import numba as nb
import numpy as np
from numpy.typing import NDArray

from ..concurrency import in_halves

Array = NDArray[Any]
_JIT: dict[str, Any] = {"cache": True, "fastmath": True, "error_model": "numpy", "nogil": True}
_F = np.float32
COLUMNS = 16  # a row of a patch is computed in so many pixels, the last of them without weight: two vectors
LEAST_VARIANCE = 0.25  # grey², of a patch that can be found again
LEAST_GRADIENT = 0.05  # grey²/px², trace of the normal matrix
LEAST_GAIN = 0.2  # contrast of the patch found / contrast of the patch sought
SETTLED_PX = 0.01


def wide(image: Array) -> Array:
    """(h, w + COLUMNS) float32: an image (h, w) whose rows may be read beyond their end."""
    return cv2.copyMakeBorder(image.astype(np.float32), 0, 0, 0, COLUMNS, cv2.BORDER_CONSTANT, value=0)


@nb.njit(**_JIT)
def _draw(ref: Array, px: Array, back: Array, drawn: Array) -> None:
    """Fill ``drawn`` (q + 2, COLUMNS) with ref around ``px``, under the warp ``back`` (2, 2) d ref / d new."""
    size = drawn.shape[0]
    r = size // 2
    one, x, y, next_ = _F(1), _F(px[0]), _F(px[1]), np.uintp(1)
    b00, b01, b10, b11 = _F(back[0, 0]), _F(back[0, 1]), _F(back[1, 0]), _F(back[1, 1])
    for j in range(size):
        dy, row = _F(j - r), drawn[j]
        left, top = x + b01 * dy, y + b11 * dy
        for i in range(size):
            dx = _F(i - r)
            u, v = left + b00 * dx, top + b10 * dx
            iu, iv = np.int32(u), np.int32(v)
            fu, fv = u - _F(iu), v - _F(iv)
            b, a = np.uintp(iu), np.uintp(iv)
            upper = ref[a, b] * (one - fu) + ref[a, b + next_] * fu
            lower = ref[a + next_, b] * (one - fu) + ref[a + next_, b + next_] * fu
            row[i] = upper * (one - fv) + lower * fv


# Below a patch is one row of q x COLUMNS numbers: compilers make vectors of a long loop, not of many short ones.


@nb.njit(**_JIT)
def _template(drawn: Array, weight: Array, value: Array, gx: Array, gy: Array) -> tuple[Any, Any, Any, Any]:
    """Fill ``value`` (n,), zero mean, and its gradient with gain and bias projected out; ``drawn`` is ``_draw``'s.

    Returns the 2 x 2 normal matrix, h00, h01, h11, and the weighted variance.
    """
    n, half = weight.shape[0], _F(0.5)
    mean = mx = my = _F(0)
    for k in range(n):
        w = weight[k]
        v = drawn[k + COLUMNS + 1]
        a, b = half * (drawn[k + COLUMNS + 2] - drawn[k + COLUMNS]), half * (drawn[k + 2 * COLUMNS + 1] - drawn[k + 1])
        value[k], gx[k], gy[k] = v, a, b
        mean += w * v
        mx += w * a
        my += w * b
    var = cx = cy = _F(0)
    for k in range(n):
        v = value[k] - mean
        value[k] = v
        w = weight[k] * v
        var += w * v
        cx += w * (gx[k] - mx)
        cy += w * (gy[k] - my)
    cx, cy = cx / max(var, _F(1e-9)), cy / max(var, _F(1e-9))
    h00 = h01 = h11 = _F(0)
    for k in range(n):
        a, b, w = gx[k] - mx - cx * value[k], gy[k] - my - cy * value[k], weight[k]
        gx[k], gy[k] = w * a, w * b
        h00 += w * a * a
        h01 += w * a * b
        h11 += w * b * b
    return h00, h01, h11, var


@nb.njit(**_JIT)
def _look(new: Array, x: float, y: float, weight: Array, seen: Array) -> Any:
    """Fill ``seen`` (n,) with the patch around (x, y); returns its weighted mean."""
    rows = weight.shape[0] // COLUMNS
    left, top = np.int64(x) - rows // 2, np.int64(y) - rows // 2
    fx, fy = _F(x - np.int64(x)), _F(y - np.int64(y))
    w11 = fx * fy
    w01, w10 = fx - w11, fy - w11
    w00 = _F(1) - fx - w10
    for j in range(rows):
        above, below = new[top + j, left : left + COLUMNS + 1], new[top + j + 1, left : left + COLUMNS + 1]
        row = seen[j * COLUMNS : (j + 1) * COLUMNS]
        for i in range(COLUMNS):
            row[i] = w00 * above[i] + w01 * above[i + 1] + w10 * below[i] + w11 * below[i + 1]
    mean = _F(0)
    for k in range(weight.shape[0]):
        mean += weight[k] * seen[k]
    return mean


@nb.njit(**_JIT)
def _moments(seen: Array, mean: Any, weight: Array, value: Array, gx: Array, gy: Array) -> tuple[Any, Any, Any, Any]:
    """Covariance with the template, variance of ``seen``, and the two sums that a step is made of."""
    cov = power = b0 = b1 = _F(0)
    for k in range(weight.shape[0]):
        v = seen[k] - mean
        wv = weight[k] * v
        cov += wv * value[k]
        power += wv * v
        b0 += v * gx[k]
        b1 += v * gy[k]
    return cov, power, b0, b1


def align_patches(
    ref: Array, new: Array, px: Array, start: Array, affine: Array, weight: Array, iterations: int
) -> tuple[Array, Array]:
    """Where each patch of ``ref`` lies in ``new``, on two threads: each is by itself, so the answer is that of one.

    Args: ref, new as ``wide`` makes them; px (p, 2) pixels of ref; start (p, 2) pixels of new; affine (p, 2, 2) local
        d new / d ref; weight (q, q) window over new's pixels, q odd and below COLUMNS - 1, sum 1.
    Returns: (p, 2) pixels in new, and (p,) correlation of the patches there; -1 where the patch leaves an image,
        has no texture in some direction, or does not settle.
    """
    padded = np.zeros((len(weight), COLUMNS), np.float32)
    padded[:, : len(weight)] = weight

    def some(s: slice) -> tuple[Array, Array]:
        found: tuple[Array, Array] = _align(ref, new, px[s], start[s], affine[s], padded.ravel(), iterations)
        return found

    found = in_halves(some, len(px))
    return np.concatenate([f[0] for f in found]), np.concatenate([f[1] for f in found])


@nb.njit(**_JIT)
def _align(
    ref: Array, new: Array, px: Array, start: Array, affine: Array, weight: Array, iterations: int
) -> tuple[Array, Array]:
    p, q = px.shape[0], weight.shape[0] // COLUMNS
    r = q // 2
    h, w = ref.shape[0], ref.shape[1] - COLUMNS
    out = start.copy()
    similarity = np.full(p, -1.0)
    drawn = np.zeros((q + 3, COLUMNS), np.float32)  # the last row is never filled: what is read beyond has no weight
    value, seen = np.empty(q * COLUMNS, np.float32), np.empty(q * COLUMNS, np.float32)
    gx, gy = np.empty(q * COLUMNS, np.float32), np.empty(q * COLUMNS, np.float32)
    b = np.empty((2, 2))  # d ref / d new
    for n in range(p):
        a = affine[n]
        area = a[0, 0] * a[1, 1] - a[0, 1] * a[1, 0]
        b[0, 0], b[0, 1], b[1, 0], b[1, 1] = a[1, 1] / area, -a[0, 1] / area, -a[1, 0] / area, a[0, 0] / area
        reach_x = (r + 1) * (abs(b[0, 0]) + abs(b[0, 1])) + 0.01
        reach_y = (r + 1) * (abs(b[1, 0]) + abs(b[1, 1])) + 0.01
        if not (reach_x <= px[n, 0] < w - 1 - reach_x and reach_y <= px[n, 1] < h - 1 - reach_y):
            continue
        x, y = start[n, 0], start[n, 1]
        if not (r <= x < w - 1 - r and r <= y < h - 1 - r):
            continue
        _draw(ref, px[n], b, drawn[: q + 2])
        h00, h01, h11, var = _template(drawn.ravel(), weight, value, gx, gy)
        det = h00 * h11 - h01 * h01
        if var < LEAST_VARIANCE or det < 1e-4 * (h00 + h11) ** 2 or h00 + h11 < LEAST_GRADIENT:
            continue
        step2, corr = 1.0, -1.0
        for _ in range(iterations):
            if not (r <= x < w - 1 - r and r <= y < h - 1 - r):
                step2 = 1.0
                break
            mean = _look(new, x, y, weight, seen)
            cov, power, b0, b1 = _moments(seen, mean, weight, value, gx, gy)
            gain = cov / var
            corr = cov / math.sqrt(max(power * var, 1e-12))
            if gain < LEAST_GAIN:
                step2 = 1.0
                break
            u = (h11 * b0 - h01 * b1) / (det * gain)
            v = (h00 * b1 - h01 * b0) / (det * gain)
            x -= u
            y -= v
            step2 = u * u + v * v
            if step2 < SETTLED_PX**2:
                break
        if step2 < (20 * SETTLED_PX) ** 2:
            out[n, 0], out[n, 1] = x, y
            similarity[n] = corr
    return out, similarity


def window(size_px: int, sigma_px: float) -> Array:
    """(q, q) float32 Gaussian window, sum 1."""
    at = np.arange(size_px) - size_px // 2
    one = np.exp(-0.5 * (at / sigma_px) ** 2)
    out = one[:, None] * one
    return (out / out.sum()).astype(np.float32)
