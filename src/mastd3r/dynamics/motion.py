"""Flow against the flow of a rigid scene, normalised by what both may be wrong (III-A, our term b).

Maps of pixels are made in one pass each, in float32; ``tests/plain_motion.py`` holds the same in NumPy.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import cv2
import numba as nb
import numpy as np
from numpy.typing import NDArray

from ..camera.pinhole import Camera
from .pixels import JIT

Array = NDArray[Any]
_UNKNOWN_PX = 1e4  # wide enough to say nothing, small enough for float32 squares
_F = np.float32
Information = tuple[Array, Array, Array]  # xx, xy, yy, each (h, w) px^-2


@dataclass(frozen=True)
class RigidFlow:
    """Where a static scene's pixels would go, how that changes with inverse depth and with the pose."""

    target: Array  # (h, w, 2) float32 pixels in the past image
    slope: Array  # (h, w, 2) float32 px per unit of inverse depth: the epipolar direction and its gain
    xy: Array  # (h, w, 2) float32 target on the past camera's unit plane
    inv_depth: Array  # (h, w) float32 seen from the past camera; <= 0 behind it
    inside: Array  # (h, w) float32 1 where the target lies in the past image, before its camera; else 0


def rigid_flow(camera: Camera, rays: Array, past_from_cur: Array, inv_depth: Array) -> RigidFlow:
    """A static scene's flow current -> past, its targets finite however far off the pose is.

    ``rays`` (3, h, w) float32 with z = 1, ``inv_depth`` (h, w) >= 0.
    """
    h, w = inv_depth.shape
    target, slope, xy = (np.empty((h, w, 2), _F) for _ in range(3))
    near, inside = np.empty((h, w), _F), np.empty((h, w), _F)
    lens = np.array([camera.fx_px, camera.fy_px, camera.cx_px, camera.cy_px, camera.k1, camera.k2, camera.k3], _F)
    _rigid(rays, past_from_cur.astype(_F), lens, inv_depth, target, slope, xy, near, inside)
    return RigidFlow(target, slope, xy, near, inside)


@nb.njit(**JIT)
def _rigid(
    rays: Array, m: Array, lens: Array, inv: Array, target: Array, slope: Array, xy: Array, near: Array, inside: Array
) -> None:
    h, w = inv.shape
    fx, fy, cx, cy, k1, k2, k3 = lens
    one, least = _F(1), _F(1e-3)
    right, low = _F(w - 1), _F(h - 1)
    for j in range(h):
        for i in range(w):
            rx, ry, d = rays[0, j, i], rays[1, j, i], inv[j, i]
            z = m[2, 0] * rx + m[2, 1] * ry + m[2, 2] + m[2, 3] * d
            scale = one / max(z, least)
            x = (m[0, 0] * rx + m[0, 1] * ry + m[0, 2] + m[0, 3] * d) * scale
            y = (m[1, 0] * rx + m[1, 1] * ry + m[1, 2] + m[1, 3] * d) * scale
            dx, dy = (m[0, 3] - x * m[2, 3]) * scale, (m[1, 3] - y * m[2, 3]) * scale
            r2 = x * x + y * y
            bend = one + r2 * (k1 + r2 * (k2 + k3 * r2))
            pull = _F(2) * (k1 + r2 * (_F(2) * k2 + _F(3) * k3 * r2)) * (x * dx + y * dy)
            u, v = bounded(x * bend * fx + cx), bounded(y * bend * fy + cy)  # far outside a lens' law leaves float32
            target[j, i, 0], target[j, i, 1] = u, v
            slope[j, i, 0], slope[j, i, 1] = (dx * bend + x * pull) * fx, (dy * bend + y * pull) * fy
            xy[j, i, 0], xy[j, i, 1] = x, y
            near[j, i] = d * scale if z > least else -d * scale
            inside[j, i] = one if 0 < u < right and 0 < v < low and near[j, i] >= 0 else _F(0)


def pose_jacobian(xy: Array, inv_depth: Array, focal_px: float) -> Array:
    """(..., 2, 6) change of a pixel with a small twist [v, w] of its camera's view, at unit-plane points (..., 2)."""
    x, y = xy[..., 0], xy[..., 1]
    zero = np.zeros_like(x)
    rows_x = [inv_depth, zero, -x * inv_depth, -x * y, 1 + x * x, -y]
    rows_y = [zero, inv_depth, -y * inv_depth, -(1 + y * y), x * y, x]
    return focal_px * np.stack([np.stack(rows_x, -1), np.stack(rows_y, -1)], -2)


def residual_twist(jacobian: Array, residual: Array, weight: Array, noise_px: float, prior_sigma: Array) -> Array:
    """(6,) twist that explains the residual (n, 2) of the static majority: reweighted least squares, Cauchy weights.

    ``jacobian`` (n, 2, 6), ``weight`` (n,), ``prior_sigma`` (6,): 1 sigma of how far a pose may be off.
    """
    twist = np.zeros(6)
    given = [np.ascontiguousarray(v, np.float64) for v in (jacobian, residual, weight)]
    scale, prior_info = 4 * noise_px, np.diag(1 / prior_sigma**2)
    for _ in range(6):
        normal, right = _twist_system(*given, twist, noise_px, scale)
        twist = np.linalg.solve(normal + prior_info, right)
        scale = max(0.6 * scale, 1.5 * noise_px)
    return twist


@nb.njit(**JIT)
def _twist_system(
    jacobian: Array, residual: Array, weight: Array, twist: Array, noise: float, scale: float
) -> tuple[Array, Array]:
    normal, right = np.zeros((6, 6)), np.zeros(6)
    for n in range(len(residual)):
        if weight[n] == 0:
            continue
        a, b = jacobian[n, 0], jacobian[n, 1]
        rx, ry = residual[n, 0], residual[n, 1]
        for k in range(6):
            rx -= a[k] * twist[k]
            ry -= b[k] * twist[k]
        w = weight[n] / (1 + (rx * rx + ry * ry) / (scale * scale)) / (noise * noise)
        for k in range(6):
            right[k] += w * (a[k] * residual[n, 0] + b[k] * residual[n, 1])
            for c in range(k + 1):
                normal[k, c] += w * (a[k] * a[c] + b[k] * b[c])
    for k in range(6):
        for c in range(k):
            normal[c, k] = normal[k, c]
    return normal, right


def texture_information(gray: Array, window_px: int, noise: float) -> Information:
    """Structure tensor over a window in units of ``noise`` grey levels: (xx, xy, yy), each (h, w), px^-2.

    Its inverse is the covariance that the image itself allows a flow vector to have there.
    """
    smooth = cv2.GaussianBlur(gray, (0, 0), 0.8).astype(np.float32)
    gx, gy = cv2.Scharr(smooth, cv2.CV_32F, 1, 0, scale=1 / 32), cv2.Scharr(smooth, cv2.CV_32F, 0, 1, scale=1 / 32)
    size = (window_px, window_px)
    scale = window_px * window_px / (noise * noise)
    xx, xy, yy = (cv2.blur(cv2.multiply(*pair, scale=scale), size) for pair in ((gx, gx), (gx, gy), (gy, gy)))
    return xx, xy, yy


def flow_covariance(information: Information, base_px: float, widest_px: float) -> Array:
    """(h, w, 3) xx, xy, yy of the flow's covariance: the inverse texture information, between base and widest."""
    out = np.empty((*information[0].shape, 3), _F)
    _covariance(*information, _F(base_px * base_px), _F(1 / (widest_px * widest_px)), out)
    return out


@nb.njit(**JIT)
def _covariance(xx: Array, xy: Array, yy: Array, base: float, floor: float, out: Array) -> None:
    for j in range(xx.shape[0]):
        for i in range(xx.shape[1]):
            a, b, c = xx[j, i] + floor, xy[j, i], yy[j, i] + floor
            share = _F(1) / (a * c - b * b)
            out[j, i, 0], out[j, i, 1], out[j, i, 2] = c * share + base, -b * share, a * share + base


@nb.njit(**JIT)
def bounded(value: Any) -> Any:
    """Without what is not finite, and within what float32 squares."""
    if math.isnan(value):
        return _F(_UNKNOWN_PX)
    return min(max(value, _F(-_UNKNOWN_PX)), _F(_UNKNOWN_PX))


@nb.njit(**JIT)
def widened(rx: Any, ry: Any, xx: Any, xy: Any, yy: Any, spread: Any) -> tuple[Any, Any]:
    """p(r | cov + spread) / p(r | cov) of one pixel's residual, as (log of its exponential, its other factor).

    1 where a number is not finite.
    """
    if not math.isfinite(rx + ry + xx + xy + yy):
        return _F(0), _F(1)
    x, y = float(bounded(rx)), float(bounded(ry))
    a, b, c = float(xx), float(xy), float(yy)  # along an epipolar line they are large, and det their small difference
    det = max(a * c - b * b, 1e-12)
    wide = max((a + spread) * (c + spread) - b * b, 1e-12)
    cross = 2 * b * x * y
    length = (c * x * x - cross + a * y * y) / det - ((c + spread) * x * x - cross + (a + spread) * y * y) / wide
    return _F(min(max(0.5 * length, -80.0), 80.0)), _F(math.sqrt(det / wide))


@nb.njit(**JIT)
def odds(widened: Any, still_share: Any, outlier_share: Any) -> Any:
    """p(r | moving) / p(r | static) of one pixel, where the widened normal is ``widened`` times the static one."""
    one = _F(1)
    return (still_share + (one - still_share) * widened) / ((one - outlier_share) + outlier_share * widened)


def noise_inflation(residual: Array, cov: Array, weight: Array) -> float:
    """Factor >= 1 by which ``cov`` (n, 3) is too small for the weighted majority of ``residual`` (n, 2).

    The median of the squared Mahalanobis length over that of two unit normals, 2 ln 2. Where pose or depths are worse
    than they claim, most pixels show it, and the evidence of all must weaken. ``weight`` (n,).
    """
    length = _lengths(np.ascontiguousarray(residual, float), np.ascontiguousarray(cov, float), weight)
    if len(length) < 50:
        return 1.0
    return max(1.0, float(np.median(length)) / (2 * np.log(2)))


@nb.njit(**JIT)
def _lengths(residual: Array, cov: Array, weight: Array) -> Array:
    """Squared Mahalanobis lengths of what is weighted and finite."""
    out, n = np.empty(len(residual)), 0
    for k in range(len(residual)):
        rx, ry, xx, xy, yy = residual[k, 0], residual[k, 1], cov[k, 0], cov[k, 1], cov[k, 2]
        if weight[k] > 0.5 and math.isfinite(rx + ry + xx + xy + yy):
            rx, ry = float(bounded(_F(rx))), float(bounded(_F(ry)))
            det = max(xx * yy - xy * xy, 1e-12)
            out[n] = (yy * rx * rx - 2 * xy * rx * ry + xx * ry * ry) / det
            n += 1
    return out[:n]
