"""Depth of every static pixel of every keyframe: swept, kept where views agree, bare surfaces filled, agreed again."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from ..camera.pinhole import Camera
from ..concurrency import on_two_threads
from ..geometry.se3 import inverse
from .fill import filled
from .fusion_kernels import agreement
from .sweep import sweep_image, swept_inv_depth
from .views import Neighbourhood, StereoView, neighbourhoods

Array = NDArray[Any]
SOURCES = 6  # views that a view is compared with
SWEPT_WIDTH_PX = 320  # about the width of the images that are swept: smaller by a whole number
TOLERANCE = 0.015  # relative difference of depth up to which two views agree
REACH_PX = 1.5  # and so near to where it came from a pixel must come back
AGREEING_SWEPT, AGREEING = 2, 3  # other views that must agree, of swept depth and of the final one
CONTRAST_PX, CONTRAST_LEVELS = 5, 6.0  # a window with this 1-sigma of grey levels counts half
SURE_COST = 0.5  # matching cost above which swept depth says nothing


@dataclass(frozen=True)
class DepthMaps:
    """Depth of all views, as one world."""

    inv_depth: Array  # (V, h, w) float32, 0 where nothing is known or something moves
    agreeing: Array  # (V, h, w) uint8, other views that see the point there
    merged: Array  # (V, h, w) float32 mean of those and the view's own
    camera: Camera
    world_from_cam: Array  # (V, 4, 4)
    near: tuple[Neighbourhood, ...]

    @property
    def trusted(self) -> Array:
        """(V, h, w) bool: seen alike by enough views."""
        return self.agreeing >= AGREEING

    @property
    def median_depth(self) -> float:
        """Of all trusted pixels, in map units; 0 where there is none."""
        found = self.merged[self.trusted]
        return float(1 / np.median(found)) if len(found) else 0.0


def dense_depth(views: list[StereoView], points_world: Array, advance: Callable[[], None]) -> DepthMaps:
    """Depth maps of views of one camera, whose common points (n, 3) are known; ``advance`` is called for every view."""
    near = neighbourhoods(views, points_world, SOURCES)
    shrink = max(1, round(views[0].camera.width / SWEPT_WIDTH_PX))
    images = [sweep_image(view, shrink) for view in views]

    def swept(i: int) -> tuple[Array, Array]:
        advance()
        if not near[i].sources:
            nothing = np.zeros(images[i].gray.shape, np.float32)
            return nothing, nothing
        return swept_inv_depth(images[i], [images[j] for j in near[i].sources], near[i])

    found = on_two_threads(swept, range(len(views)))
    small = views[0].camera.resized(*images[0].gray.shape[::-1])
    poses = np.stack([view.world_from_cam for view in views])
    rough = np.stack([inv_depth * (image.static > 0) for (inv_depth, _), image in zip(found, images, strict=True)])
    count, merged = agreed(rough, small, poses, near, REACH_PX / shrink)

    def whole(i: int) -> Array:
        view = views[i]
        known = contrast(images[i].gray) * ((count[i] >= AGREEING_SWEPT) & (found[i][1] < SURE_COST))
        size = (view.camera.width, view.camera.height)
        large, weight = (cv2.resize(a, size, interpolation=cv2.INTER_NEAREST) for a in (merged[i], known))
        return np.where(view.static, filled(large, weight, view.color), 0)

    inv_depth = np.stack(on_two_threads(whole, range(len(views))))
    camera = views[0].camera
    return DepthMaps(inv_depth, *agreed(inv_depth, camera, poses, near, REACH_PX), camera, poses, tuple(near))


def contrast(gray: Array) -> Array:
    """(h, w) float32 0..1: how much of a window of the image (h, w) float32 is more than noise."""
    window = (CONTRAST_PX, CONTRAST_PX)
    mean = cv2.blur(gray, window)
    variance = np.maximum(cv2.blur(gray * gray, window) - mean * mean, 0)
    return np.asarray(variance / (variance + CONTRAST_LEVELS**2))


def agreed(
    maps: Array, camera: Camera, world_from_cam: Array, near: list[Neighbourhood], reach_px: float
) -> tuple[Array, Array]:
    """(V, h, w) uint8 agreeing other views of every pixel, and (V, h, w) float32 mean inverse depth with them."""
    count, merged = np.zeros(maps.shape, np.uint8), np.zeros(maps.shape, np.float32)

    def one(i: int) -> None:
        others, from_ref, ref_from = relative(world_from_cam, i, near[i])
        agreement(maps, i, others, pinhole(camera), from_ref, ref_from, TOLERANCE, reach_px, count[i], merged[i])

    on_two_threads(one, range(len(maps)))
    return count, merged


def relative(world_from_cam: Array, i: int, near: Neighbourhood) -> tuple[Array, Array, Array]:
    """(S,) the view's sources; (S, 3, 4) source from view, and view from source."""
    others = np.array(near.sources, np.int64)
    from_ref = [(inverse(world_from_cam[j]) @ world_from_cam[i])[:3] for j in others]
    ref_from = [(inverse(world_from_cam[i]) @ world_from_cam[j])[:3] for j in others]
    return others, np.array(from_ref).reshape(-1, 3, 4), np.array(ref_from).reshape(-1, 3, 4)


def pinhole(camera: Camera) -> Array:
    """(4,) fx fy cx cy."""
    return np.array([camera.fx_px, camera.fy_px, camera.cx_px, camera.cy_px])
