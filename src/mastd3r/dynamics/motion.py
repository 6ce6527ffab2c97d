"""Flow against the flow of a rigid scene, normalised by what both may be wrong (III-A, our term b)."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import cv2
import numba as nb
import numpy as np
from numpy.typing import NDArray

from ..camera.pinhole import Camera
from .config import DynamicsConfig

Array = NDArray[Any]
_UNKNOWN_PX = 1e4  # wide enough to say nothing, small enough for float32 squares
Information = tuple[Array, Array, Array]  # xx, xy, yy, each (h, w) px^-2


@dataclass(frozen=True)
class RigidFlow:
    """Where a static scene's pixels would go, how that changes with inverse depth and with the pose."""

    target: Array  # (h, w, 2) float32 pixels in the past image
    slope: Array  # (h, w, 2) float32 px per unit of inverse depth: the epipolar direction and its gain
    xy: Array  # (h, w, 2) float32 target on the past camera's unit plane
    inv_depth: Array  # (h, w) float32 seen from the past camera; <= 0 behind it


def rigid_flow(camera: Camera, rays: Array, past_from_cur: Array, inv_depth: Array) -> RigidFlow:
    """A static scene's flow current -> past. ``rays`` (3, h, w) float32 with z = 1, ``inv_depth`` (h, w) >= 0."""
    m = past_from_cur.astype(np.float32)
    x, y, z = (m[i, 0] * rays[0] + m[i, 1] * rays[1] + m[i, 2] + m[i, 3] * inv_depth for i in range(3))
    scale = 1 / np.maximum(z, 1e-3)
    x, y = x * scale, y * scale
    dx, dy = (m[0, 3] - x * m[2, 3]) * scale, (m[1, 3] - y * m[2, 3]) * scale
    u, v = x, y
    if camera.distorted:
        r2 = x * x + y * y
        bend = 1 + r2 * (camera.k1 + r2 * (camera.k2 + camera.k3 * r2))
        pull = 2 * (camera.k1 + r2 * (2 * camera.k2 + 3 * camera.k3 * r2)) * (x * dx + y * dy)
        dx, dy = dx * bend + x * pull, dy * bend + y * pull
        u, v = x * bend, y * bend
    target = cv2.merge([u * camera.fx_px + camera.cx_px, v * camera.fy_px + camera.cy_px])
    slope = cv2.merge([dx * camera.fx_px, dy * camera.fy_px])
    return RigidFlow(target, slope, cv2.merge([x, y]), inv_depth * scale * np.where(z > 1e-3, 1.0, -1.0))


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
    rows, target = jacobian.reshape(-1, 6).astype(np.float64), residual.reshape(-1)
    scale, prior_info = 4 * noise_px, np.diag(1 / prior_sigma**2)
    for _ in range(6):
        left = (target - rows @ twist).reshape(-1, 2)
        w = weight / (1 + (left**2).sum(-1) / scale**2) / noise_px**2
        weighted = rows * np.repeat(w, 2)[:, None]
        twist = np.linalg.solve(rows.T @ weighted + prior_info, weighted.T @ target)
        scale = max(0.6 * scale, 1.5 * noise_px)
    return twist


def texture_information(gray: Array, window_px: int, noise: float) -> Information:
    """Structure tensor over a window in units of ``noise`` grey levels: (xx, xy, yy), each (h, w), px^-2.

    Its inverse is the covariance that the image itself allows a flow vector to have there.
    """
    smooth = cv2.GaussianBlur(gray, (0, 0), 0.8).astype(np.float32)
    gx, gy = cv2.Scharr(smooth, cv2.CV_32F, 1, 0) / 32, cv2.Scharr(smooth, cv2.CV_32F, 0, 1) / 32
    size = (window_px, window_px)
    scale = window_px * window_px / (noise * noise)
    xx, xy, yy = (cv2.blur(p, size) * scale for p in (gx * gx, gx * gy, gy * gy))
    return xx, xy, yy


def flow_covariance(information: Information, base_px: float, widest_px: float) -> Array:
    """(h, w, 3) xx, xy, yy of the flow's covariance: the inverse texture information, between base and widest."""
    xx, xy, yy = information
    floor = 1 / (widest_px * widest_px)
    xx, yy = xx + floor, yy + floor
    det = xx * yy - xy * xy
    return cv2.merge([yy / det + base_px**2, -xy / det, xx / det + base_px**2])


def noise_inflation(residual: Array, cov: Array, weight: Array) -> float:
    """Factor >= 1 by which ``cov`` (h, w, 3) is too small for the weighted majority of ``residual`` (h, w, 2).

    The median of the squared Mahalanobis length over that of two unit normals, 2 ln 2. Where pose or depths are worse
    than they claim, most pixels show it, and the evidence of all must weaken.
    """
    rows = (slice(2, None, 4), slice(2, None, 4))
    r, c, w = residual[rows].astype(float), cov[rows].astype(float), weight[rows]
    known = (w > 0.5) & np.isfinite(r).all(-1) & np.isfinite(c).all(-1)
    if known.sum() < 50:
        return 1.0
    r, c = np.clip(r[known], -_UNKNOWN_PX, _UNKNOWN_PX), c[known]
    det = np.maximum(c[:, 0] * c[:, 2] - c[:, 1] ** 2, 1e-12)
    length = (c[:, 2] * r[:, 0] ** 2 - 2 * c[:, 1] * r[:, 0] * r[:, 1] + c[:, 0] * r[:, 1] ** 2) / det
    return max(1.0, float(np.median(length)) / (2 * np.log(2)))


def motion_log_ratio(residual: Array, cov: Array, config: DynamicsConfig) -> Array:
    """log p(residual | moving) - log p(residual | static), (h, w) float32.

    Static: Normal(0, cov) with a share of wrong flow. Moving: the same widened by ``motion.spread_px``, and a share
    that shows no motion against the background. Bounded on both sides by the shares, near 0 where cov is wide, and 0
    where a number is not finite.
    """
    flat = residual.reshape(-1, 2), cov.reshape(-1, 3)
    contiguous = (np.ascontiguousarray(v, np.float32) for v in flat)
    ratio: Array = _log_ratio(*contiguous, config.motion.spread_px**2, config.still_share, config.outlier_share)
    return ratio.reshape(residual.shape[:-1])


@nb.njit(cache=True, error_model="numpy", nogil=True)
def _log_normal(rx: float, ry: float, xx: float, xy: float, yy: float) -> float:
    det = max(xx * yy - xy * xy, 1e-12)
    return -0.5 * ((yy * rx * rx - 2 * xy * rx * ry + xx * ry * ry) / det + math.log(det))


@nb.njit(cache=True, error_model="numpy", nogil=True)
def _log_ratio(residual: Array, cov: Array, spread: float, still_share: float, outlier_share: float) -> Array:
    out = np.zeros(len(residual), np.float32)
    for n in range(len(residual)):
        rx, ry = float(residual[n, 0]), float(residual[n, 1])
        xx, xy, yy = float(cov[n, 0]), float(cov[n, 1]), float(cov[n, 2])  # squares of a lost pixel's leave float32
        if not math.isfinite(rx + ry + xx + xy + yy):
            continue
        rx, ry = min(max(rx, -_UNKNOWN_PX), _UNKNOWN_PX), min(max(ry, -_UNKNOWN_PX), _UNKNOWN_PX)
        still = _log_normal(rx, ry, xx, xy, yy)
        wide = _log_normal(rx, ry, xx + spread, xy, yy + spread)
        top = max(still, wide)
        a, b = math.exp(still - top), math.exp(wide - top)
        moving = still_share * a + (1 - still_share) * b
        static = (1 - outlier_share) * a + outlier_share * b
        out[n] = math.log(moving) - math.log(static)
    return out


def along_epipolar(cov: Array, slope: Array, inv_depth_sigma: Array) -> Array:
    """``cov`` (h, w, 3) widened by the depth's 1 sigma along ``slope`` (h, w, 2): the part a depth may explain."""
    reach = np.nan_to_num(slope * inv_depth_sigma[..., None], nan=_UNKNOWN_PX, posinf=_UNKNOWN_PX, neginf=-_UNKNOWN_PX)
    reach = np.clip(reach, -_UNKNOWN_PX, _UNKNOWN_PX)
    dx, dy = reach[..., 0], reach[..., 1]
    return cv2.add(cov, cv2.merge([dx * dx, dx * dy, dy * dy]))
