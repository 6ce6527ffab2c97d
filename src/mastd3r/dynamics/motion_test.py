"""One frame against its past: which pixels move against the rigid scene (III-A, our term b, put together)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from ..camera.pinhole import Camera
from ..concurrency import Worker
from ..geometry.se3 import inverse
from .config import DynamicsConfig
from .data import DynamicsInput
from .flow import HalfFlow
from .motion import (
    Information,
    RigidFlow,
    along_epipolar,
    flow_covariance,
    motion_log_ratio,
    noise_inflation,
    pose_jacobian,
    residual_twist,
    rigid_flow,
)
from .photometric import mismatch, photo_variance

Array = NDArray[Any]


@dataclass(frozen=True)
class Past:
    """What is kept of an earlier frame, all at half the working size."""

    gray: Array  # (h, w) uint8
    world_from_cam: Array  # (4, 4)
    moving: Array  # (h, w) float32 P(moving)


@dataclass(frozen=True)
class Present:
    """What comparing needs of a frame whose pose and depths are known, at half the working size."""

    gray: Array  # (h, w) uint8
    world_from_cam: Array  # (4, 4)
    inv_depth: Array  # (h, w) float32, no gaps
    inv_depth_sigma: Array  # (h, w) float32
    flow_cov: Array  # (h, w, 3) float32 of flow from this texture
    photo_var: Array  # (h, w) float32 of grey values


@dataclass(frozen=True)
class Comparison:
    """A frame against one past frame."""

    log_ratio: Array  # (h, w) float32
    flow: Array  # (h, w, 2) float32, current -> past


class MotionTest:
    """Holds the lens and the flow engine; knows nothing of earlier log-odds."""

    def __init__(self, config: DynamicsConfig, flow: HalfFlow, width: int, height: int) -> None:
        self.config, self.width, self.height = config, width, height
        self._flow = flow
        self._camera: Camera | None = None
        self._rays = np.zeros((3, height, width), np.float32)
        self._worker = Worker("compare")

    def present(self, frame: DynamicsInput, small: Array, texture: Information) -> Present:
        """What ``compare`` is to know of a frame; ``small`` is its (h, w) uint8 grey image."""
        self._lens(frame.camera)
        inv_depth, sigma = self._background(frame)
        cov = flow_covariance(texture, self.config.motion.flow_noise_px, 2 * self.config.motion.spread_px)
        return Present(small, frame.world_from_cam, inv_depth, sigma, cov, photo_variance(texture, self.config))

    def compare(self, pairs: Sequence[tuple[Present, Array, Past]]) -> list[Comparison]:
        """Log ratios of each (frame, its prior P(static) (h, w), other frame), in order, on two threads.

        Every other one beside, always the same ones: what a flow engine finds may hang on what it was shown before.
        """
        beside = self._worker.submit(lambda: [self._one(*pair) for pair in pairs[1::2]])
        found = [self._one(*pair) for pair in pairs[::2]]
        for n, other in enumerate(beside.get()):
            found.insert(2 * n + 1, other)
        return found

    def _one(self, frame: Present, static: Array, past: Past) -> Comparison:
        """The past image is first drawn as a rigid scene would show it now; only what is left is flow."""
        assert self._camera is not None
        c = self.config.motion
        small = frame.gray
        past_from_cur = inverse(past.world_from_cam) @ frame.world_from_cam
        rigid = rigid_flow(self._camera, self._rays, past_from_cur, frame.inv_depth)
        stable = self._flow.warp(past.gray, rigid.target)
        left = self._flow.between(small, stable)
        inside = self._inside(rigid)
        error = self._flow.round_trip_px(left, self._flow.quick(stable, small))
        confidence = np.exp(-0.5 * (error / c.round_trip_px) ** 2) * inside
        residual = left - self._pose_error(rigid, left, confidence * static)
        wide = along_epipolar(frame.flow_cov, rigid.slope, frame.inv_depth_sigma)
        if c.noise_inflation:
            wide = wide * np.float32(max(1.0, noise_inflation(residual, wide, inside) / c.noise_tolerance))
        covered = self._flow.warp(past.moving, rigid.target)
        failed = 0.0
        if c.doubts_unmatched:
            scene = inside * static * (1 - covered)
            failed = 1 - float((confidence * scene).sum()) / max(float(scene.sum()), 1.0)
        ratio = motion_log_ratio(residual, wide, self._at_failure(failed)) * confidence
        unmatched = (1 - confidence) * (1 - covered)
        ratio += inside * self._grey_values(small, stable, left, inside, frame.photo_var, unmatched, failed)
        return Comparison(ratio.astype(np.float32), rigid.target - self._flow.grid + left)

    def _grey_values(
        self, small: Array, stable: Array, left: Array, inside: Array, noise: Array, unmatched: Array, failed: float
    ) -> Array:
        """Static where the rigid warp fits better than the flow; moving where neither flow nor warp explains it.

        What a moving thing covered in the past frame cannot match, and says nothing. Nor does it say more than
        -log ``failed`` where that share of the static scene cannot be matched: as between views far apart.
        """
        cur, still = small.astype(np.float32), stable.astype(np.float32)
        still *= float((cur * inside).mean()) / max(float((still * inside).mean()), 1e-3)
        as_static = mismatch(cur, still, noise)
        if self.config.motion.noise_inflation:
            typical = float(np.median(as_static[inside > 0])) if inside.any() else 1.0
            noise = noise * max(1.0, typical / self.config.motion.noise_tolerance)
            as_static = mismatch(cur, still, noise)
        as_flow = mismatch(cur, self._flow.warp(still, self._flow.grid + left), noise)
        unexplained = (1 - np.exp(-0.5 * np.maximum(as_static - 2, 0))) * unmatched
        fits = np.clip(self.config.photometric.gain * (as_static - as_flow), -3, 0)
        gain = min(self.config.photometric.unexplained_gain, -np.log(max(failed, 1e-6)))
        return np.float32(gain) * unexplained + fits

    def _at_failure(self, failed: float) -> DynamicsConfig:
        """Where flow fails for a share of the static scene, more of what it does find is wrong as well."""
        wrong = max(self.config.outlier_share, self.config.motion.wrong_where_failed * failed**2)
        return replace(self.config, outlier_share=wrong)

    def _background(self, frame: DynamicsInput) -> tuple[Array, Array]:
        """Half-size inverse depth and 1 sigma; unknown pixels get the median and a sigma as wide as the scene."""
        size = (self.width, self.height)
        inv_depth = cv2.resize(frame.inv_depth, size, interpolation=cv2.INTER_NEAREST).astype(np.float32)
        sigma = cv2.resize(frame.inv_depth_sigma, size, interpolation=cv2.INTER_NEAREST).astype(np.float32)
        known = np.isfinite(sigma) & np.isfinite(inv_depth) & (inv_depth >= 0)
        middle = float(np.median(inv_depth[known])) if known.any() else 1.0
        wide = 3 * max(middle, 1e-6)
        return np.where(known, inv_depth, middle), np.where(known, np.minimum(sigma, wide), wide)

    def _lens(self, camera: Camera) -> None:
        small = camera.resized(self.width, self.height)
        if small != self._camera:
            self._rays = np.moveaxis(small.rays(small.pixel_grid()), -1, 0).astype(np.float32)
            self._camera = small

    def _inside(self, rigid: RigidFlow) -> Array:
        x, y = rigid.target[..., 0], rigid.target[..., 1]
        inside = (x > 0) & (y > 0) & (x < self.width - 1) & (y < self.height - 1) & (rigid.inv_depth >= 0)
        return inside.astype(np.float32)

    def _pose_error(self, rigid: RigidFlow, left: Array, weight: Array) -> Array:
        """The part of the flow left over that a small error of the relative pose explains, (h, w, 2) float32."""
        assert self._camera is not None
        focal = self._camera.fx_px
        rows = (slice(3, None, 6), slice(3, None, 6))
        near = max(float(np.median(rigid.inv_depth[rows])), 1e-9)
        limit = np.deg2rad(self.config.motion.pose_sigma_deg)
        twist = residual_twist(
            pose_jacobian(rigid.xy[rows].reshape(-1, 2), rigid.inv_depth[rows].ravel(), focal),
            left[rows].reshape(-1, 2).astype(float),
            weight[rows].ravel().astype(float),
            self.config.motion.flow_noise_px,
            np.array([limit / near] * 3 + [limit] * 3),
        )
        x, y, near_by = rigid.xy[..., 0], rigid.xy[..., 1], rigid.inv_depth
        v, w = (focal * twist[:3]).astype(np.float32), (focal * twist[3:]).astype(np.float32)
        along_x = near_by * (v[0] - x * v[2]) - x * y * w[0] + (1 + x * x) * w[1] - y * w[2]
        along_y = near_by * (v[1] - y * v[2]) - (1 + y * y) * w[0] + x * y * w[1] + x * w[2]
        return cv2.merge([along_x.astype(np.float32), along_y.astype(np.float32)])
