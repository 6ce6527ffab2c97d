"""Depth of every static pixel of every keyframe: swept, kept where views agree, bare surfaces filled, agreed again.

Bare surfaces are given to planes of the scene; what lies on none is filled from around.
"""

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
from .plane_labels import Swept, plane_inv_depth, plane_labels
from .planes import Planes, found_planes
from .sweep import SweepImage, sweep_image, swept_inv_depth
from .views import Neighbourhood, StereoView, neighbourhoods

Array = NDArray[Any]
SOURCES = 6  # views that a view is compared with
SWEPT_WIDTH_PX = 320  # about the width of the images that are swept: smaller by a whole number
TOLERANCE = 0.015  # relative difference of depth up to which two views agree
REACH_PX = 1.5  # and so near to where it came from a pixel must come back
AGREEING_SWEPT, AGREEING = 2, 3  # other views that must agree, of swept depth and of what was filled
CONTRAST_PX, CONTRAST_LEVELS = 5, 6.0  # a window with this 1-sigma of grey levels counts half
SURE_COST, LOW_COST = 0.5, 0.35  # matching cost above which swept depth says nothing; is not sure
SURE_CONTRAST, LEAST_CONTRAST = 0.5, 0.1  # of depth that refutes planes; of points that planes are found in
CLEAR_WEIGHT, PLANE_WEIGHT = 0.5, 0.3  # of swept depth that no plane replaces; of a plane
ON_PLANE_RATIO = 0.01  # relative difference up to which swept depth lies on the plane


@dataclass(frozen=True)
class DepthMaps:
    """Depth of all views, as one world."""

    inv_depth: Array  # (V, h, w) float32, 0 where nothing is known or something moves
    agreeing: Array  # (V, h, w) uint8, other views that see the point there
    merged: Array  # (V, h, w) float32 mean of those and the view's own
    measured: Array  # (V, h, w) bool: matched there, not filled from a plane or from around
    camera: Camera
    world_from_cam: Array  # (V, 4, 4)
    near: tuple[Neighbourhood, ...]

    @property
    def trusted(self) -> Array:
        """(V, h, w) bool: seen alike by enough views, one more where it was filled."""
        return (self.agreeing >= AGREEING) | (self.measured & (self.agreeing >= AGREEING_SWEPT))

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

    return completed(views, images, on_two_threads(swept, range(len(views))), near)


def completed(
    views: list[StereoView], images: list[SweepImage], found: list[tuple[Array, Array]], near: list[Neighbourhood]
) -> DepthMaps:
    """Depth maps of swept depth and its cost, each (h, w) of the images: bare surfaces filled, all made to agree."""
    camera = views[0].camera
    small = camera.resized(*images[0].gray.shape[::-1])
    shrink = round(camera.width / small.width)
    poses = np.stack([view.world_from_cam for view in views])
    rough = np.stack([inv_depth * (image.static > 0) for (inv_depth, _), image in zip(found, images, strict=True)])
    count, merged = agreed(rough, small, poses, near, REACH_PX / shrink)
    cost = np.stack([c for _, c in found])
    clear = np.stack([contrast(image.gray) for image in images])
    weight = clear * ((count >= AGREEING_SWEPT) & (cost < SURE_COST))
    rays = small.rays(small.pixel_grid())
    planes = scene_planes(sure_inv_depth(merged, count, cost, clear, LEAST_CONTRAST), rays, poses)
    sure = sure_inv_depth(merged, count, cost, clear, SURE_CONTRAST)
    half = Swept([sweep_image(view, 2 * shrink) for view in views], *halved(weight, merged, weight, clear, sure))
    coarse = camera.resized(*half.images[0].gray.shape[::-1])
    half_rays, full_rays = (c.rays(c.pixel_grid()) for c in (coarse, camera))

    def whole(i: int) -> tuple[Array, Array]:
        view = views[i]
        others, from_ref, _ = relative(poses, i, near[i])
        labels = plane_labels(half, i, others, planes, half_rays, pinhole(coarse), from_ref, TOLERANCE)
        on_plane = plane_inv_depth(labels, planes.slopes(poses[i]), full_rays)
        size = (camera.width, camera.height)
        data, by = (cv2.resize(a[i], size, interpolation=cv2.INTER_NEAREST) for a in (merged, weight))
        data, by, measured = with_plane(data, by, on_plane)
        return np.where(view.static, filled(data, by, view.color), 0), measured & view.static

    inv_depth, measured = (np.stack(maps) for maps in zip(*on_two_threads(whole, range(len(views))), strict=True))
    count, merged = agreed(inv_depth, camera, poses, near, REACH_PX)
    return DepthMaps(inv_depth, count, merged, measured, camera, poses, tuple(near))


def halved(by: Array, *maps: Array) -> list[Array]:
    """Maps (V, h, w) at half the size: of four pixels the one where ``by`` (V, h, w) is largest."""
    v, h, w = by.shape
    blocks = [a[:, : h // 2 * 2, : w // 2 * 2].reshape(v, h // 2, 2, w // 2, 2).swapaxes(2, 3) for a in (by, *maps)]
    flat = [a.reshape(v, h // 2, w // 2, 4) for a in blocks]
    at = flat[0].argmax(-1)[..., None]
    return [np.take_along_axis(a, at, -1)[..., 0] for a in flat[1:]]


def sure_inv_depth(merged: Array, count: Array, cost: Array, clear: Array, least: float) -> Array:
    """``merged`` where views agree, match well and have the ``least`` contrast; 0 elsewhere; all (V, h, w)."""
    return np.where((count >= AGREEING) & (cost < LOW_COST) & (clear > least), merged, 0).astype(np.float32)


def scene_planes(sure: Array, rays: Array, poses: Array) -> Planes:
    """Planes of the scene, from every other row and column of sure inverse depth (V, h, w)."""
    points, depths = [], []
    for rho, pose in zip(sure[:, ::2, ::2], poses, strict=True):
        there = rho > 0
        depths.append(1 / rho[there])
        points.append((rays[::2, ::2][there] * depths[-1][:, None]) @ pose[:3, :3].T + pose[:3, 3])
    depth = np.concatenate(depths)
    return found_planes(np.concatenate(points), depth, float(np.median(depth)) if len(depth) else 1.0)


def with_plane(swept: Array, weight: Array, plane: Array) -> tuple[Array, Array, Array]:
    """(h, w) inverse depth and its weight, of the plane (0 = none) where swept depth is neither clear nor on it; and
    (h, w) bool where it is swept depth."""
    on = np.abs(swept - plane) < ON_PLANE_RATIO * plane
    use = (plane > 0) & (weight < CLEAR_WEIGHT) & ~(on & (weight > PLANE_WEIGHT))
    data, by = np.where(use, plane, swept), np.where(use, PLANE_WEIGHT, weight)
    return data.astype(np.float32), by.astype(np.float32), ~use & (weight > 0)


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
