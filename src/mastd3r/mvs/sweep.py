"""Plane sweep: inverse depth of every pixel of a view from sources of known pose, smoothed by semi-global matching.

Collins, "A space-sweep approach to true multi-image matching", CVPR 1996; Hirschmueller, "Stereo processing by
semiglobal matching and mutual information", PAMI 2008.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from ..geometry.se3 import inverse
from .sweep_kernels import aggregate, best_plane, plane_cost
from .views import Neighbourhood, StereoView

Array = NDArray[Any]
PLANES = (32, 128)  # least and most
STEP_PX = 1.0  # how far the source pixel moves from one plane to the next
WINDOW_PX = 7
NOISE_LEVELS = 1.0  # 1-sigma of grey levels that is noise
P1, P2 = 0.1, 1.0  # cost of a step of one plane, of a jump
EDGE_LEVELS = 12.0  # a step of the grey level by so much halves the cost of a jump


@dataclass(frozen=True)
class SweepImage:
    """A view at the size that is swept."""

    gray: Array  # (h, w) float32
    static: Array  # (h, w) uint8, 1 = may be compared
    matrix: Array  # (3, 3) K
    world_from_cam: Array  # (4, 4)


def sweep_image(view: StereoView, shrink: int) -> SweepImage:
    """The view ``shrink`` times smaller."""
    w, h = view.camera.width // shrink, view.camera.height // shrink
    gray = cv2.cvtColor(view.color, cv2.COLOR_RGB2GRAY)
    small = cv2.resize(gray, (w, h), interpolation=cv2.INTER_AREA)
    static = cv2.resize(view.static.astype(np.uint8), (w, h), interpolation=cv2.INTER_NEAREST)
    return SweepImage(np.asarray(small, np.float32), static, view.camera.resized(w, h).matrix, view.world_from_cam)


def plane_inv_depths(ref: SweepImage, sources: list[SweepImage], inv_depth_range: tuple[float, float]) -> Array:
    """(D,) ascending inverse depths, evenly spaced, a pixel apart in the middle of the median source."""
    far, near = inv_depth_range
    h, w = ref.gray.shape
    ray = np.linalg.inv(ref.matrix) @ np.array([w / 2, h / 2, 1.0])
    moved = []
    for source in sources:
        from_ref = inverse(source.world_from_cam) @ ref.world_from_cam
        ends = np.stack([from_ref[:3, :3] @ ray + rho * from_ref[:3, 3] for rho in (far, near)])
        px = (ends / np.maximum(ends[:, 2:], 1e-6)) @ source.matrix.T
        moved.append(np.linalg.norm(px[1, :2] - px[0, :2]))
    count = int(np.clip(np.ceil(np.median(moved) / STEP_PX) + 1, *PLANES))
    return np.linspace(far, near, count)


def cost_volume(ref: SweepImage, sources: list[SweepImage], slopes: Array) -> Array:
    """(h, w, D) float32 matching cost in 0..1 of every pixel on planes whose inverse depth is slope (D, 3) . ray."""
    h, w = ref.gray.shape
    window = (WINDOW_PX, WINDOW_PX)
    ref_mean = cv2.blur(ref.gray, window)
    ref_var = np.maximum(cv2.blur(ref.gray * ref.gray, window) - ref_mean**2, 0)
    sums = np.empty((len(sources), 3, h, w), np.float32)
    valid = np.empty((len(sources), h, w), np.uint8)
    out = np.empty((h, w, len(slopes)), np.float32)
    plane = np.empty((h, w), np.float32)
    ref_from_px = np.linalg.inv(ref.matrix)
    relative = [inverse(s.world_from_cam) @ ref.world_from_cam for s in sources]
    flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
    for d, slope in enumerate(slopes):
        for s, (source, from_ref) in enumerate(zip(sources, relative, strict=True)):
            px_from_px = source.matrix @ (from_ref[:3, :3] + np.outer(from_ref[:3, 3], slope)) @ ref_from_px
            warped = cv2.warpPerspective(source.gray, px_from_px, (w, h), flags=flags)
            valid[s] = cv2.warpPerspective(
                source.static, px_from_px, (w, h), flags=cv2.INTER_NEAREST | cv2.WARP_INVERSE_MAP
            )
            cv2.blur(warped, window, dst=sums[s, 0])
            cv2.blur(warped * warped, window, dst=sums[s, 1])
            cv2.blur(warped * ref.gray, window, dst=sums[s, 2])
        plane_cost(ref_mean, ref_var, sums, valid, NOISE_LEVELS**2, plane)
        out[..., d] = plane
    return out


def swept_inv_depth(ref: SweepImage, sources: list[SweepImage], near: Neighbourhood) -> tuple[Array, Array]:
    """(h, w) float32 inverse depth of every pixel, and (h, w) float32 matching cost there, 0..1."""
    inv_depths = plane_inv_depths(ref, sources, near.inv_depth_range)
    cost = cost_volume(ref, sources, inv_depths[:, None] * np.array([0, 0, 1.0]))
    total = np.zeros_like(cost)
    for backward in (False, True):
        aggregate(cost, ref.gray, P1, P2, P1, EDGE_LEVELS, backward, total)
    place = np.empty(ref.gray.shape, np.float32)
    best_plane(total, place)
    step = (inv_depths[-1] - inv_depths[0]) / (len(inv_depths) - 1)
    at = np.rint(place).astype(int)[..., None]
    return np.asarray(inv_depths[0] + place * step, np.float32), np.take_along_axis(cost, at, 2)[..., 0]
