"""One frame against its past: which pixels move against the rigid scene (III-A, our term b, put together)."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, TypeVar

import cv2
import numpy as np
from numpy.typing import NDArray

from ..camera.pinhole import Camera
from ..concurrency import Worker
from ..geometry.se3 import inverse
from .comparison_kernels import (
    add_grey_evidence,
    confident_share,
    flow_log_ratio,
    grey_differences,
    mean_ratio,
    round_trip_confidence,
    unexplained_every,
)
from .config import DynamicsConfig
from .data import DynamicsInput
from .flow import HalfFlow
from .motion import (
    Information,
    RigidFlow,
    flow_covariance,
    noise_inflation,
    pose_jacobian,
    residual_twist,
    rigid_flow,
)
from .photometric import photo_variance

Array = NDArray[Any]
S = TypeVar("S")
T = TypeVar("T")
EVERY_PX = 4  # pixels that tell how wrong the majority is are so far apart


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


@dataclass(frozen=True)
class Aligned:
    """A frame and another one as a rigid scene would show it from the frame's pose."""

    rigid: RigidFlow
    stable: Array  # (h, w) uint8 the other image so drawn
    left: Array  # (h, w, 2) float32 flow that is left, frame -> stable
    flow: Array  # (h, w, 2) float32 frame -> other


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
        """Log ratios of each (frame, its prior P(static) (h, w), other frame), in order, on two threads."""

        def one(pair: tuple[Present, Array, Past]) -> Comparison:
            frame, static, past = pair
            aligned = self._aligned(frame, past)
            back = self._flow.quick(aligned.stable, frame.gray)
            inside = aligned.rigid.inside
            confidence = round_trip_confidence(aligned.left, back, inside, self.config.motion.round_trip_px)
            return Comparison(self._evidence(frame, static, past, aligned, confidence), aligned.flow)

        return self._beside(one, pairs)

    def aligned(self, pairs: Sequence[tuple[Present, Past, Present, Past]]) -> list[tuple[Aligned, Aligned]]:
        """Each pair of frames, both ways: the one checks the other. What ``evidence`` is to be made of."""
        ways = [way for a, a_past, b, b_past in pairs for way in ((a, b_past), (b, a_past))]
        found = self._beside(lambda way: self._aligned(*way), ways)
        return list(zip(found[::2], found[1::2], strict=True))

    def evidence(self, views: Sequence[tuple[Present, Array, Past, Aligned, Aligned]]) -> list[Array]:
        """(h, w) log ratios of each (frame, its prior P(static), other frame, the two aligned, and the way back)."""

        def one(view: tuple[Present, Array, Past, Aligned, Aligned]) -> Array:
            frame, static, past, there, back = view
            sigma_px = self.config.motion.round_trip_px
            confidence = round_trip_confidence(there.flow, back.flow, there.rigid.inside, sigma_px)
            return self._evidence(frame, static, past, there, confidence)

        return self._beside(one, views)

    def _beside(self, make: Callable[[S], T], items: Sequence[S]) -> list[T]:
        """``make`` of each, in order. Every other one beside, always the same ones: what a flow engine finds may hang
        on what it was shown before."""
        beside = self._worker.submit(lambda: [make(item) for item in items[1::2]])
        found = [make(item) for item in items[::2]]
        for n, other in enumerate(beside.get()):
            found.insert(2 * n + 1, other)
        return found

    def _aligned(self, frame: Present, past: Past) -> Aligned:
        """The past image is first drawn as a rigid scene would show it now; only what is left is flow."""
        assert self._camera is not None
        past_from_cur = inverse(past.world_from_cam) @ frame.world_from_cam
        rigid = rigid_flow(self._camera, self._rays, past_from_cur, frame.inv_depth)
        stable = self._flow.warp(past.gray, rigid.target)
        left = self._flow.between(frame.gray, stable)
        return Aligned(rigid, stable, left, rigid.target - self._flow.grid + left)

    def _evidence(self, frame: Present, static: Array, past: Past, aligned: Aligned, confidence: Array) -> Array:
        """(h, w) log ratio of two aligned frames."""
        c, rigid, left = self.config.motion, aligned.rigid, aligned.left
        twist = self._pose_error(rigid, left, confidence, static)
        covered = self._flow.warp(past.moving, rigid.target)
        failed = 1 - confident_share(confidence, rigid.inside, static, covered) if c.doubts_unmatched else 0.0
        geometry, sigma, cov = (left, rigid.xy, rigid.inv_depth, rigid.slope), frame.inv_depth_sigma, frame.flow_cov
        inflation = 1.0
        if c.noise_inflation:
            residual, wide = unexplained_every(*geometry[:3], twist, rigid.slope, sigma, cov, EVERY_PX)
            inside = rigid.inside[EVERY_PX // 2 :: EVERY_PX, EVERY_PX // 2 :: EVERY_PX].ravel()
            inflation = max(1.0, noise_inflation(residual, wide, inside) / c.noise_tolerance)
        shares = c.spread_px**2, self.config.still_share, self._wrong_share(failed)
        gains = self.config.photometric.gain, self._unexplained_gain(failed)
        ratio = flow_log_ratio(geometry, twist, (sigma, cov, inflation), shares)
        grey = self._grey_values(frame.gray, aligned.stable, left, rigid.inside, frame.photo_var)
        add_grey_evidence(ratio, (confidence, rigid.inside, covered), grey, gains)
        return ratio

    def _grey_values(
        self, small: Array, stable: Array, left: Array, inside: Array, noise: Array
    ) -> tuple[Array, Array, Array]:
        """Squared grey differences of 3x3 windows under the rigid warp and under the flow, and their variance.

        What fits the rigid warp better than the flow is static; what neither explains moves. What a moving thing
        covered in the past frame cannot match, and says nothing.
        """
        as_static, as_flow = np.empty(small.shape, np.float32), np.empty(small.shape, np.float32)
        grey_differences(small, stable, mean_ratio(small, stable, inside), left, as_static, as_flow)
        as_static, as_flow = cv2.blur(as_static, (3, 3)), cv2.blur(as_flow, (3, 3))
        if self.config.motion.noise_inflation:
            seen = inside[::2, ::2] > 0
            typical = float(np.median((as_static[::2, ::2] / noise[::2, ::2])[seen])) if seen.any() else 1.0
            noise = noise * np.float32(max(1.0, typical / self.config.motion.noise_tolerance))
        return as_static, as_flow, noise

    def _unexplained_gain(self, failed: float) -> float:
        """What grey values that nothing explains may say: at most -log of the share of the static scene that cannot
        be matched, as between views far apart."""
        return min(self.config.photometric.unexplained_gain, -float(np.log(max(failed, 1e-6))))

    def _wrong_share(self, failed: float) -> float:
        """Where flow fails for a share of the static scene, more of what it does find is wrong as well."""
        return max(self.config.outlier_share, self.config.motion.wrong_where_failed * failed**2)

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

    def _pose_error(self, rigid: RigidFlow, left: Array, confidence: Array, static: Array) -> Array:
        """(6,) float32: the small error of the relative pose that explains most of the flow left over, in pixels of
        this image a unit (times the focal length)."""
        assert self._camera is not None
        focal = self._camera.fx_px
        rows = (slice(3, None, 6), slice(3, None, 6))
        near = max(float(np.median(rigid.inv_depth[rows])), 1e-9)
        limit = np.deg2rad(self.config.motion.pose_sigma_deg)
        twist = residual_twist(
            pose_jacobian(rigid.xy[rows].reshape(-1, 2), rigid.inv_depth[rows].ravel(), focal),
            left[rows].reshape(-1, 2),
            (confidence[rows] * static[rows]).ravel(),
            self.config.motion.flow_noise_px,
            np.array([limit / near] * 3 + [limit] * 3),
        )
        return (focal * twist).astype(np.float32)
