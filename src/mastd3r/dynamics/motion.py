"""Flow against the flow of a rigid scene, normalised by what both may be wrong (III-A, our term b)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from ..geometry.camera import Camera
from .config import DynamicsConfig

Array = NDArray[Any]


@dataclass(frozen=True)
class RigidFlow:
    """Where a static scene's pixels would go, and how that changes with inverse depth."""

    flow: Array  # (h, w, 2) float32 px
    slope: Array  # (h, w, 2) float32 px per unit of inverse depth: the epipolar direction and its gain
    in_front: Array  # (h, w) bool


def rigid_flow(camera: Camera, rays: Array, past_from_cur: Array, inv_depth: Array) -> RigidFlow:
    """Flow current -> past of a static scene. ``rays`` (h, w, 3) float32 with z = 1, ``inv_depth`` (h, w) >= 0."""
    rotation, t = past_from_cur[:3, :3].astype(np.float32), past_from_cur[:3, 3].astype(np.float32)
    point = rays @ rotation.T + inv_depth[..., None].astype(np.float32) * t
    z = np.maximum(point[..., 2:], 1e-3)
    xy = point[..., :2] / z
    slope = (t[:2] - xy * t[2]) / z
    focal = np.array([camera.fx_px, camera.fy_px], np.float32)
    centre = np.array([camera.cx_px, camera.cy_px], np.float32)
    if camera.k1 != 0.0:
        squared = (xy * xy).sum(-1, keepdims=True)
        slope = slope * (1 + camera.k1 * squared) + 2 * camera.k1 * xy * (xy * slope).sum(-1, keepdims=True)
        xy = xy * (1 + camera.k1 * squared)
    start = np.stack(np.meshgrid(*(np.arange(n, dtype=np.float32) for n in rays.shape[1::-1])), -1)
    return RigidFlow(xy * focal + centre - start, slope * focal, point[..., 2] > 1e-3)


def texture_information(gray: Array, window_px: int, noise: float) -> tuple[Array, Array, Array]:
    """Structure tensor over a window in units of ``noise`` grey levels: (xx, xy, yy), each (h, w), px^-2.

    Its inverse is the covariance that the image itself allows a flow vector to have there.
    """
    smooth = cv2.GaussianBlur(gray, (0, 0), 0.8).astype(np.float32)
    gx, gy = cv2.Scharr(smooth, cv2.CV_32F, 1, 0) / 32, cv2.Scharr(smooth, cv2.CV_32F, 0, 1) / 32
    size = (window_px, window_px)
    scale = window_px * window_px / (noise * noise)
    xx, xy, yy = (cv2.blur(p, size) * scale for p in (gx * gx, gx * gy, gy * gy))
    return xx, xy, yy


def flow_covariance(information: tuple[Array, Array, Array], base_px: float, widest_px: float) -> Array:
    """(h, w, 3) xx, xy, yy of the flow's covariance: the inverse texture information, between base and widest."""
    xx, xy, yy = information
    floor = 1 / (widest_px * widest_px)
    xx, yy = xx + floor, yy + floor
    det = xx * yy - xy * xy
    return np.stack([yy / det + base_px**2, -xy / det, xx / det + base_px**2], -1)


def _log_normal(residual: Array, cov: Array, extra: float) -> Array:
    xx, xy, yy = cov[..., 0] + extra, cov[..., 1], cov[..., 2] + extra
    det = np.maximum(xx * yy - xy * xy, 1e-12)
    rx, ry = residual[..., 0], residual[..., 1]
    mahalanobis = (yy * rx * rx - 2 * xy * rx * ry + xx * ry * ry) / det
    return -0.5 * (mahalanobis + np.log(det))


def motion_log_ratio(residual: Array, cov: Array, config: DynamicsConfig) -> Array:
    """log p(residual | moving) - log p(residual | static), (h, w) float32.

    Static: Normal(0, cov) with a share of wrong flow. Moving: the same widened by motion_spread_px, and a share
    that shows no motion against the background. Bounded on both sides by the shares, near 0 where cov is wide.
    """
    still = _log_normal(residual, cov, 0.0)
    wide = _log_normal(residual, cov, config.motion_spread_px**2)
    top = np.maximum(still, wide)
    a, b = np.exp(still - top), np.exp(wide - top)
    moving = config.still_share * a + (1 - config.still_share) * b
    static = (1 - config.outlier_share) * a + config.outlier_share * b
    ratio: Array = (np.log(moving) - np.log(static)).astype(np.float32)
    return ratio


def along_epipolar(cov: Array, slope: Array, inv_depth_sigma: Array) -> Array:
    """``cov`` (h, w, 3) grown by the depth's 1 sigma along ``slope`` (h, w, 2): the part a depth may explain."""
    dx, dy = slope[..., 0] * inv_depth_sigma, slope[..., 1] * inv_depth_sigma
    return cov + np.stack([dx * dx, dx * dy, dy * dy], -1)
