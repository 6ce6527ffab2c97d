"""u(p) of eq. (16) and the residual of eq. (15) that it comes from."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from ..camera.pinhole import Camera
from ..geometry.se3 import transform
from .flow import HalfFlow

Array = NDArray[Any]
GREY_EXPLAINED = 12.0  # grey levels; where a static scene explains the photograph better than this, flow has no say
GREY_WRONG = 36.0  # where neither a static scene nor the flow comes nearer than this, there is no match


@dataclass(frozen=True)
class SeenFrom:
    """A keyframe that a frame is compared with."""

    gray: Array  # (h, w) uint8 at working size
    moving: Array  # (h, w) uint8, 255 x P(moving)
    cam_from_world: Array  # (4, 4)


def reprojection_residual_px(
    keyframes: Sequence[SeenFrom],
    camera: Camera,
    world_from_cam: Array,
    gray: Array,
    inv_depth: Array,
    flow: HalfFlow,
    unmatched_px: float,
) -> Array:
    """(h, w) float32, at ``flow``'s size, in pixels of the working image: sqrt e(p) of eq. (15), for every pixel.

    A pixel is carried into a keyframe by its expected depth and its final pose; flow then says where its match is
    in truth. On blank walls flow slides: a residual counts only where the carried grey values (5 x 5) differ too.
    Where the flow's do as well there is no match, and the residual is ``unmatched_px``.
    The least over the keyframes counts, as each hides something from the others. A keyframe does not see what
    stands behind a moving thing of its own; 0 where none sees the pixel. ``camera`` is at working size, ``inv_depth``
    (h, w) too.
    """
    size = (flow.grid.shape[1], flow.grid.shape[0])
    camera, ratio = camera.resized(*size), camera.width / size[0]
    small = cv2.resize(gray, size, interpolation=cv2.INTER_AREA)
    near = np.maximum(cv2.resize(inv_depth, size, interpolation=cv2.INTER_NEAREST), 1e-9)
    points_cam = camera.rays(flow.grid) / near[..., None]
    least = np.full(small.shape, np.inf, np.float32)
    for kf in keyframes:
        points_kf = transform(kf.cam_from_world @ world_from_cam, points_cam)
        visible = points_kf[..., 2] > 0
        target = camera.project(np.where(visible[..., None], points_kf, 1.0)).astype(np.float32)
        visible &= (target >= 0).all(-1) & (target[..., 0] <= size[0] - 1) & (target[..., 1] <= size[1] - 1)
        covered = cv2.dilate(cv2.resize(kf.moving, size), np.ones((9, 9), np.uint8))
        visible &= flow.warp(covered, target) < 128
        kf_gray = cv2.resize(kf.gray, size, interpolation=cv2.INTER_AREA)
        carried_gray = flow.warp(kf_gray, target)
        left = flow.between(small, carried_gray)
        gain = float(small[visible].mean() / max(carried_gray[visible].mean(), 1.0)) if visible.any() else 1.0
        as_static, as_flow = (
            cv2.blur(np.abs(small - np.float32(gain) * image), (5, 5))
            for image in (carried_gray, flow.warp(carried_gray, flow.grid + left))
        )
        residual = np.where(as_flow > GREY_WRONG, unmatched_px, ratio * np.hypot(left[..., 0], left[..., 1]))
        residual = residual * (as_static > GREY_EXPLAINED)
        least = np.minimum(least, np.where(visible, residual, np.inf))
    return np.where(np.isfinite(least), least, 0).astype(np.float32)


RESIDUAL_MAX_PX = 8.0  # as uncertain as can be: one wild match must not make all others small in u = e / max e


def uncertainty_weight(squared_error: Array, tau_px: float) -> Array:
    """Eq. (16): u = e / max e over R = {e > tau²}, 0 elsewhere; e is a squared norm, tau is in pixels."""
    in_r = squared_error > tau_px**2
    return np.where(in_r, squared_error / squared_error[in_r].max(), 0.0) if in_r.any() else np.zeros(len(in_r))
