"""What the training views can tell of a Gaussian: how finely they sample it, and whether it stands in their way."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ..camera.pinhole import Camera
from .gaussians import Array

AROUND = 0.5  # pictures' widths


@dataclass(frozen=True)
class Sampling:
    """Of each Gaussian, over all views."""

    pixel: Array  # (n,) float32, the smallest size of a pixel there, in map units; 0 where no view is turned to it
    blocks: Array  # (n,) bool: its centre is in a picture, nearer to the camera than ``near``
    distance: Array  # (n,) float32, to the nearest camera, wherever that looks


def sampled(means: Array, cameras: list[Camera], cam_from_world: list[Array], near: float) -> Sampling:
    """``means`` (n, 3) float32 in the pictures of some views, and as much beside them as may reach in (``AROUND``)."""
    pixel, blocks = np.full(len(means), np.inf, np.float32), np.zeros(len(means), bool)
    squared = np.full(len(means), np.inf, np.float32)
    for camera, pose in zip(cameras, cam_from_world, strict=True):
        view = np.asarray(pose, np.float32)
        x, y, z = view[:3, :3] @ means.T + view[:3, 3:]
        np.minimum(squared, x * x + y * y + z * z, out=squared)
        u, v = camera.fx_px * x + camera.cx_px * z, camera.fy_px * y + camera.cy_px * z
        right, down = u / (camera.width * np.maximum(z, 1e-9)) - 0.5, v / (camera.height * np.maximum(z, 1e-9)) - 0.5
        off = np.maximum(np.abs(right), np.abs(down))  # 0.5 at the picture's edge
        blocks |= (z > 0) & (z < near) & (off < 0.5)
        np.minimum(pixel, z / np.float32(camera.fx_px), out=pixel, where=(z > 0) & (off < 0.5 + AROUND))
    return Sampling(np.where(np.isfinite(pixel), pixel, 0).astype(np.float32), blocks, np.sqrt(squared))
