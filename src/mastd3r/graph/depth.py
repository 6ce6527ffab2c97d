"""A keyframe's sparse depths made dense, and carried into another view."""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from ..camera.pinhole import Camera
from ..geometry.inpainting import inpainted_grid
from ..geometry.nearest_kernels import three_nearest
from ..geometry.se3 import transform

Array = NDArray[Any]
BUCKET_PX = 12.0  # about the distance of neighbouring points
LEAST_CONFIDENCE = 0.05  # a depth that is known less well is not carried on


def depth_confidence(inv_depth: Array, info: Array) -> Array:
    """0..1, how well an inverse depth is known: 1/(1 + (relative 1-sigma / 0.1)²)."""
    return 1 / (1 + 100.0 / np.maximum(info * inv_depth**2, 1e-12))


def inpainted(inv_depth: Array, info: Array, grid: tuple[int, int]) -> Array:
    """(p,) inverse depths, those of low confidence inpainted from their neighbours (normalised convolution)."""
    confidence = depth_confidence(inv_depth, info).reshape(grid).astype(np.float32)
    depth = inv_depth.reshape(grid).astype(np.float32)
    everywhere = float(np.average(depth, weights=confidence + 1e-6))
    return inpainted_grid(depth, confidence, everywhere).astype(float).reshape(-1)


def upsampled(values: Array, grid: tuple[int, int], width: int, height: int) -> Array:
    """(h, w) float32 from one value a cell, bilinear between cell centres."""
    rows, cols = grid
    cell_px = min(width // cols, height // rows)
    dense = cv2.resize(values.reshape(grid).astype(np.float32), (cols * cell_px, rows * cell_px))
    pad = (0, height - rows * cell_px, 0, width - cols * cell_px)
    return cv2.copyMakeBorder(dense, *pad, cv2.BORDER_REPLICATE)


def carried(
    px: Array, inv_depth: Array, info: Array, new_from_ref: Array, camera: Camera, at_px: Array
) -> tuple[Array, Array]:
    """Inverse depth (q,) and confidence (q,) at ``at_px`` of a new view, from ref's points: the 3 nearest, by distance.

    A point behind the camera, or seen edge-on from far away in the image, has no say (confidence 0).
    """
    points = transform(new_from_ref, camera.unproject(px, np.maximum(inv_depth, 1e-9)))
    confidence = depth_confidence(inv_depth, info)
    ok = (points[:, 2] > 1e-3 / np.maximum(inv_depth.max(), 1e-9)) & (confidence > LEAST_CONFIDENCE)
    if ok.sum() < 8:
        return np.full(len(at_px), float(np.median(inv_depth))), np.zeros(len(at_px))
    landed, new_inv = camera.project(points[ok]), 1 / points[ok][:, 2]
    distance, nearest = three_nearest(landed, at_px, BUCKET_PX)
    weight = confidence[ok][nearest] / (distance + 1.0)
    value = (new_inv[nearest] * weight).sum(1) / weight.sum(1)
    near = np.exp(-((distance[:, 0] / 24.0) ** 2))
    return value, near * confidence[ok][nearest[:, 0]]
