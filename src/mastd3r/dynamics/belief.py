"""P(moving) of every pixel, carried through the video: priors before a pose is known, posteriors after (III-A)."""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from ..errors import InputError
from ..geometry.camera import Camera
from ..geometry.se3 import inverse
from . import paper
from .config import DynamicsConfig
from .data import DynamicMask, DynamicsInput
from .depth import depth_log_ratio
from .flow import HalfFlow
from .motion import (
    RigidFlow,
    along_epipolar,
    flow_covariance,
    motion_log_ratio,
    pose_jacobian,
    residual_twist,
    rigid_flow,
    texture_information,
)
from .photo import mismatch, photo_variance
from .regions import guided_coefficients, region_mean

Array = NDArray[Any]


@dataclass(frozen=True)
class _Past:
    """What is kept of a frame: half-size grey image and pose."""

    gray: Array
    world_from_cam: Array
    moving: Array


class DynamicBelief:
    """The one owner of the mask's memory. Deterministic; frames must come in order and be of one size."""

    def __init__(self, config: DynamicsConfig, width: int, height: int) -> None:
        self.config, self.width, self.height = config, width, height
        self._w, self._h = (width + 1) // 2, (height + 1) // 2
        self._flow = HalfFlow(self._w, self._h)
        self._past: deque[_Past] = deque(maxlen=1 + max(config.gaps))
        self._belief: Array | None = None  # log-odds of evidence at half size, without the semantic prior
        self._carried: tuple[Array, Array | None, Array] | None = None  # small gray, flow to last, carried belief
        self._camera: Camera | None = None
        self._rays = np.zeros((3, self._h, self._w), np.float32)

    def prior(self, gray: Array, semantic: Array | None = None) -> Array:
        """P(moving) (h, w) float32 before the pose is known: the last posterior along the flow, and the semantics.

        Raises InputError for an image of another size.
        """
        if self.config.variant == "none":
            self._check(gray, "gray")
            return np.zeros((self.height, self.width), np.float32)
        _, _, carried = self._carry(gray)
        return _sigmoid(self._full(carried) + self._semantic_log_odds(semantic))

    def update(self, given: DynamicsInput) -> DynamicMask:
        """P(moving) once the frame's pose is known; the belief moves on to this frame. Raises InputError."""
        self._check(given.gray, "gray")
        self._check(given.inv_depth, "inv_depth")
        self._check(given.inv_depth_sigma, "inv_depth_sigma")
        if self.config.variant == "none":
            nothing = np.zeros((self.height, self.width), np.float32)
            return DynamicMask(nothing, nothing > 0.5, {})
        if self.config.variant == "paper":
            return self._paper(given)
        small, _to_last, carried = self._carry(given.gray)
        self._past.append(_Past(small, given.world_from_cam, np.zeros_like(carried)))
        evidence: dict[str, Array] = {}
        fresh = np.zeros((self._h, self._w), np.float32)
        if self.config.use_motion:
            evidence["motion"] = self._motion(given, small, carried)
            fresh = fresh + evidence["motion"]
        if self.config.use_depth and given.own_inv_depth is not None:
            evidence["depth"] = self._shrink(depth_log_ratio(given, self.config))
            fresh = fresh + evidence["depth"]
        evidence["time"] = carried
        if self.config.use_regions:
            weight = 0.02 + np.abs(fresh) / (1 + np.abs(fresh))
            fresh = region_mean(
                small.astype(np.float32), fresh, weight, self.config.region_px, self.config.region_contrast
            )
        belief = carried + self.config.evidence_gain * fresh
        limit = self.config.max_log_odds
        belief = np.clip(belief, -limit, limit).astype(np.float32)
        semantic = self._semantic_log_odds(given.semantic)
        if given.semantic is not None and self.config.use_semantic:
            evidence["semantic"] = semantic
        shown = self._smooth(belief, small, given)
        self._belief = belief
        self._carried = None
        probability = _sigmoid(shown + semantic)
        self._past[-1] = _Past(small, given.world_from_cam, self._shrink(probability))
        return DynamicMask(probability, probability > 0.5, evidence)

    def _motion(self, given: DynamicsInput, small: Array, carried: Array) -> Array:
        """Sum of the motion log ratios against one near and one far past frame, (h', w') float32."""
        total = np.zeros((self._h, self._w), np.float32)
        if len(self._past) < 2:
            return total
        inv_depth, sigma = self._depth(given)
        information = texture_information(small, 7, self.config.texture_noise)
        cov = flow_covariance(information, self.config.flow_noise_px, 2 * self.config.motion_spread_px)
        static = 1 / (1 + np.exp(carried))
        for gap in self._gaps():
            past = self._past[-1 - gap]
            camera, rays = self._lens(given.camera)
            rigid = rigid_flow(camera, rays, inverse(past.world_from_cam) @ given.world_from_cam, inv_depth)
            stable = self._flow.warp(past.gray, rigid.target)
            residual = self._flow.between(small, stable)
            inside = self._inside(rigid)
            cur, still = small.astype(np.float32), stable.astype(np.float32)
            still = still * (float((cur * inside).mean()) / max(float((still * inside).mean()), 1e-3))
            noise = photo_variance(information, self.config)
            as_static = mismatch(cur, still, noise)
            as_flow = mismatch(cur, self._flow.pull(still, residual), noise)
            if self.config.round_trip_px > 0:
                error = self._flow.round_trip_px(residual, self._flow.between(stable, small))
                trust = np.exp(-0.5 * (error / self.config.round_trip_px) ** 2) * inside
            else:
                trust = np.exp(-0.5 * np.maximum(as_flow - 1, 0)) * inside
            residual = residual - self._pose_error(rigid, residual, trust * static, camera.fx_px)
            wide = along_epipolar(cov, rigid.slope, sigma)
            covered = self._flow.warp(past.moving, rigid.target)
            clash = (1 - np.exp(-0.5 * np.maximum(as_static - 2, 0))) * (1 - trust) * (1 - covered)
            fits = np.clip(self.config.photo_gain * (as_static - as_flow), -3, 0)
            total += motion_log_ratio(residual, wide, self.config) * trust
            total += inside * (self.config.clash_gain * clash + fits)
        return total

    def _gaps(self) -> list[int]:
        return sorted({g for g in self.config.gaps if g < len(self._past)}) or [1]

    def _inside(self, rigid: RigidFlow) -> Array:
        x, y = rigid.target[..., 0], rigid.target[..., 1]
        inside = (x > 0) & (y > 0) & (x < self._w - 1) & (y < self._h - 1) & (rigid.inv_depth >= 0)
        return inside.astype(np.float32)

    def _pose_error(self, rigid: RigidFlow, residual: Array, weight: Array, focal_px: float) -> Array:
        """The part of the residual that a small error of the relative pose explains, (h', w', 2) float32."""
        step = slice(3, None, 6)
        near = float(np.median(rigid.inv_depth[step, step])) + 1e-9
        limit = np.deg2rad(self.config.pose_doubt_deg)
        sigma = np.array([limit / near] * 3 + [limit] * 3)
        part = pose_jacobian(rigid.xy[step, step].reshape(-1, 2), rigid.inv_depth[step, step].ravel(), focal_px)
        twist = residual_twist(
            part.astype(float),
            residual[step, step].reshape(-1, 2).astype(float),
            weight[step, step].ravel().astype(float),
            self.config.flow_noise_px,
            sigma,
        )
        x, y = rigid.xy[..., 0], rigid.xy[..., 1]
        v, w = (focal_px * twist[:3]).astype(np.float32), (focal_px * twist[3:]).astype(np.float32)
        along_x = rigid.inv_depth * (v[0] - x * v[2]) - x * y * w[0] + (1 + x * x) * w[1] - y * w[2]
        along_y = rigid.inv_depth * (v[1] - y * v[2]) - (1 + y * y) * w[0] + x * y * w[1] + x * w[2]
        return cv2.merge([along_x.astype(np.float32), along_y.astype(np.float32)])

    def _carry(self, gray: Array) -> tuple[Array, Array | None, Array]:
        """(half-size image, flow to the last frame, evidence carried along it and faded)."""
        self._check(gray, "gray")
        small = self._shrink(gray)
        if self._carried is not None and np.array_equal(self._carried[0], small):
            return self._carried
        carried = np.zeros((self._h, self._w), np.float32)
        to_last = None
        if self._past:
            to_last = self._flow.between(small, self._past[-1].gray)
            if self.config.use_time and self._belief is not None:
                seen = self._flow.pull(self._past[-1].gray.astype(np.float32), to_last, -100.0)
                noise = photo_variance(texture_information(small, 5, self.config.texture_noise), self.config)
                same = np.exp(
                    -0.5 * np.maximum(mismatch(small.astype(np.float32), seen, noise) - self.config.carry_mismatch, 0)
                )
                carried = self.config.memory * same * self._flow.pull(self._belief, to_last)
        self._carried = (small, to_last, carried)
        return self._carried

    def _depth(self, given: DynamicsInput) -> tuple[Array, Array]:
        """Half-size inverse depth and 1 sigma; unknown pixels get the median and a sigma as wide as the scene."""
        inv_depth = cv2.resize(given.inv_depth, (self._w, self._h), interpolation=cv2.INTER_NEAREST)
        sigma = cv2.resize(given.inv_depth_sigma, (self._w, self._h), interpolation=cv2.INTER_NEAREST)
        known = np.isfinite(sigma) & np.isfinite(inv_depth) & (inv_depth > 0)
        middle = float(np.median(inv_depth[known])) if known.any() else 1.0
        wide = 3 * middle
        return np.where(known, inv_depth, middle), np.where(known, np.minimum(sigma, wide), wide)

    def _lens(self, camera: Camera) -> tuple[Camera, Array]:
        small = camera.resized(self._w, self._h)
        if small != self._camera:
            self._camera = small
            self._rays = np.moveaxis(small.rays(small.pixel_grid()), -1, 0).astype(np.float32)
        return small, self._rays

    def _semantic_log_odds(self, semantic: Array | None) -> Array:
        base = np.float32(np.log(self.config.base_rate) - np.log1p(-self.config.base_rate))
        if semantic is None or not self.config.use_semantic:
            return np.full((self.height, self.width), base, np.float32)
        self._check(semantic, "semantic")
        floor = self.config.semantic_floor
        p = np.clip(semantic, floor, 1 - floor)
        return (self.config.semantic_gain * np.log(p / (1 - p))).astype(np.float32)

    def _smooth(self, belief: Array, small: Array, given: DynamicsInput) -> Array:
        if not self.config.use_regions:
            return self._full(belief)
        weight = 0.05 + np.minimum(np.abs(belief), 3.0) / 3
        a, b = guided_coefficients(
            small.astype(np.float32), belief, weight, self.config.edge_px, self.config.region_contrast
        )
        limit = self.config.max_log_odds
        return np.clip(self._full(a) * given.gray + self._full(b), -limit, limit).astype(np.float32)

    def _paper(self, given: DynamicsInput) -> DynamicMask:
        """Eq. (1)-(4). Z is the frame's own depth, or the background's where the provider has no own depth."""
        inv = given.inv_depth if given.own_inv_depth is None else given.own_inv_depth
        depth = np.where(inv > 0, 1 / np.maximum(inv, 1e-9), 0.0)
        c = self.config
        anomaly = paper.depth_anomaly(depth, c.window_px, c.tau_variance, c.tau_sigma)
        moving, static = paper.depth_likelihoods(depth)
        prior = _sigmoid(self._semantic_log_odds(given.semantic)).astype(np.float64)
        log_odds = paper.posterior_log_odds(prior, moving, static)
        mask = paper.coarse_mask(paper.moving_mask(log_odds, c.tau_bayes), anomaly)
        probability = np.where(mask, _sigmoid(log_odds), np.minimum(_sigmoid(log_odds), 0.5) * anomaly)
        evidence = {
            "depth": np.log(moving / static).astype(np.float32),
            "anomaly": anomaly.astype(np.float32),
        }
        return DynamicMask(probability.astype(np.float32), mask, evidence)

    def _shrink(self, image: Array) -> Array:
        return cv2.resize(image, (self._w, self._h), interpolation=cv2.INTER_AREA)

    def _full(self, image: Array) -> Array:
        return cv2.resize(image, (self.width, self.height), interpolation=cv2.INTER_LINEAR)

    def _check(self, image: Array, name: str) -> None:
        if image.shape != (self.height, self.width):
            raise InputError(f"dynamics: expected {name} of {self.width}x{self.height}, got shape {image.shape}")


def _sigmoid(log_odds: Array) -> Array:
    return (1 / (1 + np.exp(-log_odds))).astype(np.float32)
