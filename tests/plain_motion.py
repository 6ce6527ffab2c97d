"""The motion term in plain NumPy and OpenCV: what its kernels are held to (``test_dynamics_kernels.py``)."""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from mastd3r.camera.pinhole import Camera

Array = NDArray[Any]
_UNKNOWN_PX = 1e4  # wide enough to say nothing, small enough for float32 squares


def rigid_flow(
    camera: Camera, rays: Array, past_from_cur: Array, inv_depth: Array
) -> tuple[Array, Array, Array, Array]:
    """(target, slope, xy, inv_depth) of ``motion.rigid_flow``."""
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
    target = np.nan_to_num(np.clip(target, -_UNKNOWN_PX, _UNKNOWN_PX), nan=_UNKNOWN_PX)
    slope = cv2.merge([dx * camera.fx_px, dy * camera.fy_px])
    return target, slope, cv2.merge([x, y]), inv_depth * scale * np.where(z > 1e-3, 1.0, -1.0)


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


def motion_log_ratio(residual: Array, cov: Array, spread: float, still_share: float, outlier_share: float) -> Array:
    """log p(residual | moving) - log p(residual | static), (...,) float64; ``spread`` in px²."""
    residual, cov = residual.astype(float), cov.astype(float)
    finite = np.isfinite(residual).all(-1) & np.isfinite(cov).all(-1)
    residual = np.clip(np.where(finite[..., None], residual, 0), -_UNKNOWN_PX, _UNKNOWN_PX)
    cov = np.where(finite[..., None], cov, 1)
    still, wide = _log_normal(residual, cov), _log_normal(residual, cov + np.array([spread, 0, spread]))
    top = np.maximum(still, wide)
    a, b = np.exp(still - top), np.exp(wide - top)
    ratio = np.log(still_share * a + (1 - still_share) * b) - np.log((1 - outlier_share) * a + outlier_share * b)
    return np.asarray(np.where(finite, ratio, 0))


def _log_normal(residual: Array, cov: Array) -> Array:
    rx, ry, xx, xy, yy = residual[..., 0], residual[..., 1], cov[..., 0], cov[..., 1], cov[..., 2]
    det = np.maximum(xx * yy - xy * xy, 1e-12)
    return -0.5 * ((yy * rx * rx - 2 * xy * rx * ry + xx * ry * ry) / det + np.log(det))


def along_epipolar(cov: Array, slope: Array, inv_depth_sigma: Array) -> Array:
    """``cov`` (h, w, 3) widened by the depth's 1 sigma along ``slope`` (h, w, 2): the part a depth may explain."""
    reach = np.nan_to_num(slope * inv_depth_sigma[..., None], nan=_UNKNOWN_PX, posinf=_UNKNOWN_PX, neginf=-_UNKNOWN_PX)
    reach = np.clip(reach, -_UNKNOWN_PX, _UNKNOWN_PX)
    dx, dy = reach[..., 0], reach[..., 1]
    return cv2.add(cov, cv2.merge([dx * dx, dx * dy, dy * dy]))


def confidence(grid: Array, forward: Array, backward: Array, inside: Array, sigma_px: float) -> Array:
    """(h, w) how well forward and backward flow agree."""
    outside = {"borderMode": cv2.BORDER_CONSTANT, "borderValue": (1e3, 1e3)}
    total = forward + cv2.remap(backward, grid + forward, None, cv2.INTER_LINEAR, **outside)
    return np.asarray(np.exp(-0.5 * (np.hypot(total[..., 0], total[..., 1]) / sigma_px) ** 2) * inside)


def pose_error(xy: Array, inv_depth: Array, twist: Array) -> Array:
    """(h, w, 2) flow of a small twist (6,), which is given times the focal length."""
    x, y, v, w = xy[..., 0], xy[..., 1], twist[:3], twist[3:]
    along_x = inv_depth * (v[0] - x * v[2]) - x * y * w[0] + (1 + x * x) * w[1] - y * w[2]
    along_y = inv_depth * (v[1] - y * v[2]) - (1 + y * y) * w[0] + x * y * w[1] + x * w[2]
    return np.stack([along_x, along_y], -1)


def mismatch(square: Array, variance: Array) -> Array:
    """(h, w) mean squared grey difference of a 3x3 window over its variance: about 1 where the two agree."""
    return np.asarray(cv2.blur(square, (3, 3)) / variance)


def region_mean(guide: Array, value: Array, weight: Array, radius_px: float, edge: float) -> Array:
    """The recursive filter of ``regions.region_mean``, row by row; ``guide`` (h, w, layers)."""
    steps = [1 + radius_px / edge * np.abs(np.diff(guide.astype(float), axis=axis)).sum(-1) for axis in (1, 0)]
    over, total = value * weight.astype(float), weight.astype(float)
    for i in range(3):
        sigma = radius_px * np.sqrt(3) * 2 ** (2 - i) / np.sqrt(4**3 - 1)
        for part in (over, total):
            for values, step in ((part.T, steps[0].T), (part, steps[1])):
                passed = np.exp(-np.sqrt(2) / sigma * step)
                for n in range(1, len(values)):
                    values[n] += passed[n - 1] * (values[n - 1] - values[n])
                for n in range(len(values) - 2, -1, -1):
                    values[n] += passed[n] * (values[n + 1] - values[n])
    return over / total
