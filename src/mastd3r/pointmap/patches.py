"""Sub-pixel patch alignment, the matches of eq. (7): inverse-compositional Lucas-Kanade with gain, bias
and a local affine warp.

Baker & Matthews, "Lucas-Kanade 20 years on", IJCV 2004 (inverse compositional, linear appearance variation).
"""

from __future__ import annotations

import math
from typing import Any

import numba as nb
import numpy as np
from numpy.typing import NDArray

from ..concurrency import in_halves

Array = NDArray[Any]
_JIT: dict[str, Any] = {"cache": True, "fastmath": True, "error_model": "numpy", "nogil": True}
LEAST_VARIANCE = 0.25  # grey², of a patch that can be found again
LEAST_GRADIENT = 0.05  # grey²/px², trace of the normal matrix
LEAST_GAIN = 0.2  # contrast of the patch found / contrast of the patch sought
SETTLED_PX = 0.01


@nb.njit(**_JIT)
def _template(
    ref: Array, px: Array, weight: Array, wide: Array, value: Array, grad: Array
) -> tuple[float, float, float, float]:
    """Fill ``value`` (q, q), zero mean, and ``grad`` (2, q, q) with gain and bias projected out.

    ``wide`` (q + 2, q + 2) is work space. Returns the 2 x 2 normal matrix, h00, h01, h11, and the weighted variance.
    """
    q = weight.shape[0]
    r = q // 2
    ix, iy = int(px[0]) - r - 1, int(px[1]) - r - 1
    fx, fy = np.float32(px[0] - int(px[0])), np.float32(px[1] - int(px[1]))
    one = np.float32(1)
    for j in range(q + 2):
        for i in range(q + 2):
            top = ref[iy + j, ix + i] * (one - fx) + ref[iy + j, ix + i + 1] * fx
            low = ref[iy + j + 1, ix + i] * (one - fx) + ref[iy + j + 1, ix + i + 1] * fx
            wide[j, i] = top * (one - fy) + low * fy
    mean = mx = my = 0.0
    for j in range(q):
        for i in range(q):
            w = weight[j, i]
            value[j, i] = wide[j + 1, i + 1]
            grad[0, j, i] = np.float32(0.5) * (wide[j + 1, i + 2] - wide[j + 1, i])
            grad[1, j, i] = np.float32(0.5) * (wide[j + 2, i + 1] - wide[j, i + 1])
            mean += w * value[j, i]
            mx += w * grad[0, j, i]
            my += w * grad[1, j, i]
    var = cx = cy = 0.0
    for j in range(q):
        for i in range(q):
            v = value[j, i] - mean
            value[j, i] = v
            w = weight[j, i] * v
            var += w * v
            cx += w * (grad[0, j, i] - mx)
            cy += w * (grad[1, j, i] - my)
    cx, cy = cx / max(var, 1e-9), cy / max(var, 1e-9)
    h00 = h01 = h11 = 0.0
    for j in range(q):
        for i in range(q):
            gx = grad[0, j, i] - mx - cx * value[j, i]
            gy = grad[1, j, i] - my - cy * value[j, i]
            w = weight[j, i]
            grad[0, j, i], grad[1, j, i] = w * gx, w * gy
            h00 += w * gx * gx
            h01 += w * gx * gy
            h11 += w * gy * gy
    return h00, h01, h11, var


@nb.njit(**_JIT)
def _look(new: Array, x: float, y: float, affine: Array, weight: Array, seen: Array) -> float:
    """Fill ``seen`` (q, q) with the warped patch around (x, y); returns its weighted mean."""
    q = weight.shape[0]
    r = q // 2
    mean = 0.0
    one = np.float32(1)
    a00, a01 = np.float32(affine[0, 0]), np.float32(affine[0, 1])
    a10, a11 = np.float32(affine[1, 0]), np.float32(affine[1, 1])
    for j in range(q):
        for i in range(q):
            dx, dy = np.float32(i - r), np.float32(j - r)
            u, v = np.float32(x) + a00 * dx + a01 * dy, np.float32(y) + a10 * dx + a11 * dy
            iu, iv = int(u), int(v)
            fu, fv = u - np.float32(iu), v - np.float32(iv)
            top = new[iv, iu] * (one - fu) + new[iv, iu + 1] * fu
            low = new[iv + 1, iu] * (one - fu) + new[iv + 1, iu + 1] * fu
            s = top * (one - fv) + low * fv
            seen[j, i] = s
            mean += weight[j, i] * s
    return mean


@nb.njit(**_JIT)
def _moments(seen: Array, mean: float, weight: Array, value: Array, grad: Array) -> tuple[float, float, float, float]:
    """Covariance with the template, variance of ``seen``, and the two sums that a step is made of."""
    q = weight.shape[0]
    cov = power = b0 = b1 = 0.0
    for j in range(q):
        for i in range(q):
            v = seen[j, i] - mean
            wv = weight[j, i] * v
            cov += wv * value[j, i]
            power += wv * v
            b0 += v * grad[0, j, i]
            b1 += v * grad[1, j, i]
    return cov, power, b0, b1


def align_patches(
    ref: Array, new: Array, px: Array, start: Array, affine: Array, weight: Array, iterations: int
) -> tuple[Array, Array]:
    """``align_some`` on two threads: each patch is by itself, so the answer is the same."""
    found = in_halves(lambda s: align_some(ref, new, px[s], start[s], affine[s], weight, iterations), len(px))
    return np.concatenate([f[0] for f in found]), np.concatenate([f[1] for f in found])


@nb.njit(**_JIT)
def align_some(
    ref: Array, new: Array, px: Array, start: Array, affine: Array, weight: Array, iterations: int
) -> tuple[Array, Array]:
    """Where each patch of ``ref`` lies in ``new``.

    Args: ref, new (h, w) float32; px (p, 2) pixels of ref; start (p, 2) pixels of new; affine (p, 2, 2) local
        d new / d ref; weight (q, q) window, q odd, sum 1.
    Returns: (p, 2) pixels in new, and (p,) correlation of the patches there; -1 where the patch leaves an image,
        has no texture in some direction, or does not settle.
    """
    p, q = px.shape[0], weight.shape[0]
    r = q // 2
    h, w = ref.shape
    out = start.copy()
    similarity = np.full(p, -1.0)
    wide = np.empty((q + 2, q + 2), np.float32)
    value, seen = np.empty((q, q), np.float32), np.empty((q, q), np.float32)
    grad = np.empty((2, q, q), np.float32)
    for n in range(p):
        if not (r + 1 <= px[n, 0] < w - r - 2 and r + 1 <= px[n, 1] < h - r - 2):
            continue
        h00, h01, h11, var = _template(ref, px[n], weight, wide, value, grad)
        det = h00 * h11 - h01 * h01
        if var < LEAST_VARIANCE or det < 1e-4 * (h00 + h11) ** 2 or h00 + h11 < LEAST_GRADIENT:
            continue
        a = affine[n]
        reach_x, reach_y = r * (abs(a[0, 0]) + abs(a[0, 1])) + 0.01, r * (abs(a[1, 0]) + abs(a[1, 1])) + 0.01
        x, y = start[n, 0], start[n, 1]
        step2, corr = 1.0, -1.0
        for _ in range(iterations):
            if not (reach_x <= x < w - 1 - reach_x and reach_y <= y < h - 1 - reach_y):
                step2 = 1.0
                break
            mean = _look(new, x, y, a, weight, seen)
            cov, power, b0, b1 = _moments(seen, mean, weight, value, grad)
            gain = cov / var
            corr = cov / math.sqrt(max(power * var, 1e-12))
            if gain < LEAST_GAIN:
                step2 = 1.0
                break
            u = (h11 * b0 - h01 * b1) / (det * gain)
            v = (h00 * b1 - h01 * b0) / (det * gain)
            x -= a[0, 0] * u + a[0, 1] * v
            y -= a[1, 0] * u + a[1, 1] * v
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
