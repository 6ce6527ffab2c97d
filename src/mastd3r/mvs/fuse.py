"""Depth maps to one cloud: a point for what several views see alike, once, with its normal and confidence."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from .depth_maps import TOLERANCE, DepthMaps, pinhole, relative
from .fusion_kernels import mark_shown
from .views import StereoView
from .voxels import surest_of_voxels

Array = NDArray[Any]
SPACING_PX = 2.0  # one point a voxel of so many pixels at the median depth
FILLED_CONFIDENCE = 0.5  # of a point filled from a plane or from around, to one that was matched
NORMAL_SMOOTHING_PX = 5  # window over which inverse depth is smoothed before its slope is taken


@dataclass(frozen=True)
class DenseCloud:
    """Points of the static world, in map units."""

    points_world: Array  # (n, 3) float32
    normals: Array  # (n, 3) float32, unit, towards the camera that saw it
    colors: Array  # (n, 3) uint8 RGB
    confidence: Array  # (n,) float32 0..1: share of the views compared that see the point there, half of it if filled


def fused(views: list[StereoView], maps: DepthMaps) -> DenseCloud:
    """The cloud. Views come in order; what a view shows that an earlier one gave as a point is left out."""
    taken = np.zeros(maps.inv_depth.shape, np.uint8)
    trusted = maps.trusted
    rays = maps.camera.rays(maps.camera.pixel_grid())
    spacing = SPACING_PX * (maps.median_depth or 1.0) / maps.camera.fx_px
    parts: list[tuple[Array, Array, Array, Array]] = []
    for i, view in enumerate(views):
        keep = trusted[i] & (taken[i] == 0)
        others, from_ref, _ = relative(maps.world_from_cam, i, maps.near[i])
        mark_shown(maps.inv_depth, i, others, pinhole(maps.camera), from_ref, TOLERANCE, keep, taken)
        pose = maps.world_from_cam[i]
        points = (rays[keep] / maps.merged[i][keep][:, None]) @ pose[:3, :3].T + pose[:3, 3]
        confidence = (
            maps.agreeing[i][keep] / max(1, len(others)) * np.where(maps.measured[i][keep], 1, FILLED_CONFIDENCE)
        )
        rows = surest_of_voxels(points, confidence, spacing)  # of the view first: sorting all at once takes long
        normals = normals_cam(maps.merged[i], rays)[keep][rows] @ pose[:3, :3].T
        parts.append((points[rows], normals, view.color[keep][rows], confidence[rows]))
    points, normals, colors, confidence = (np.concatenate(p) for p in zip(*parts, strict=True))
    rows = surest_of_voxels(points, confidence, spacing)
    points, normals, colors, confidence = points[rows], normals[rows], colors[rows], confidence[rows]
    return DenseCloud(points.astype(np.float32), normals.astype(np.float32), colors, confidence.astype(np.float32))


def normals_cam(inv_depth: Array, rays: Array) -> Array:
    """(h, w, 3) unit normals, towards the camera, of a map of inverse depth over (h, w, 3) rays with z = 1.

    Inverse depth over the unit plane (x, y) is a plane's own equation: n = (a, b, c) with a x + b y + c = 1 / z, so
    the normal is its slope and what is left of it. Where nothing is known it means nothing.
    """
    smooth = cv2.blur(inv_depth.astype(np.float64), (NORMAL_SMOOTHING_PX, NORMAL_SMOOTHING_PX))
    slope_y, slope_x = np.gradient(smooth)
    slope_x = slope_x / np.gradient(rays[..., 0], axis=1)
    slope_y = slope_y / np.gradient(rays[..., 1], axis=0)
    rest = smooth - slope_x * rays[..., 0] - slope_y * rays[..., 1]
    normals = -np.stack([slope_x, slope_y, rest], -1)
    return np.asarray(normals / np.maximum(np.linalg.norm(normals, axis=-1, keepdims=True), 1e-12))
