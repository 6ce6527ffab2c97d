"""Pinhole camera with three radial terms, OpenCV axes, integer pixel = pixel centre."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..geometry.lens_kernels import Lens, pixels_of, rays_of

Array = NDArray[Any]


@dataclass(frozen=True)
class Camera:
    """Focal lengths, principal point and radial terms: x_d = x·(1 + k1·|x|² + k2·|x|⁴ + k3·|x|⁶)."""

    fx_px: float
    fy_px: float
    cx_px: float
    cy_px: float
    width: int
    height: int
    k1: float = 0.0
    k2: float = 0.0
    k3: float = 0.0

    @staticmethod
    def centred(focal_px: float, width: int, height: int, k1: float = 0.0) -> Camera:
        """A camera whose principal point is the image centre."""
        return Camera(focal_px, focal_px, (width - 1) / 2, (height - 1) / 2, width, height, k1)

    @property
    def matrix(self) -> Array:
        """K, (3, 3) float64."""
        return np.array([[self.fx_px, 0, self.cx_px], [0, self.fy_px, self.cy_px], [0, 0, 1.0]])

    @property
    def _lens(self) -> Lens:
        terms = self.fx_px, self.fy_px, self.cx_px, self.cy_px, self.k1, self.k2, self.k3
        return tuple(map(float, terms))  # type: ignore[return-value]

    @property
    def pinhole(self) -> Camera:
        """The same camera without its radial terms."""
        return replace(self, k1=0.0, k2=0.0, k3=0.0)

    @property
    def distorted(self) -> bool:
        """True where straight lines are not imaged straight."""
        return self.k1 != 0.0 or self.k2 != 0.0 or self.k3 != 0.0

    def resized(self, width: int, height: int) -> Camera:
        """The same lens over an image scaled to (width, height); half pixels are honoured."""
        sx, sy = width / self.width, height / self.height
        return Camera(
            self.fx_px * sx,
            self.fy_px * sy,
            (self.cx_px + 0.5) * sx - 0.5,
            (self.cy_px + 0.5) * sy - 0.5,
            width,
            height,
            self.k1,
            self.k2,
            self.k3,
        )

    def padded(self, pad_px: int) -> Camera:
        """The same lens over an image grown by ``pad_px`` on every side."""
        return replace(
            self,
            cx_px=self.cx_px + pad_px,
            cy_px=self.cy_px + pad_px,
            width=self.width + 2 * pad_px,
            height=self.height + 2 * pad_px,
        )

    def project(self, points_cam: Array) -> Array:
        """(..., 3) points with z > 0 to (..., 2) pixels."""
        points = np.ascontiguousarray(points_cam, float)
        found: Array = pixels_of(points.reshape(-1, 3), self._lens)
        return found.reshape(*points.shape[:-1], 2)

    def rays(self, px: Array) -> Array:
        """(..., 2) pixels to (..., 3) rays with z = 1 (fixed-point undistortion, 10 rounds)."""
        pixels = np.ascontiguousarray(px, float)
        found: Array = rays_of(pixels.reshape(-1, 2), self._lens, self.distorted)
        return found.reshape(*pixels.shape[:-1], 3)

    def unproject(self, px: Array, inv_depth: Array) -> Array:
        """(..., 2) pixels and their inverse depths (...), not 0, to (..., 3) points."""
        return self.rays(px) / inv_depth[..., None]

    def pixel_grid(self) -> Array:
        """(h, w, 2) float64 pixel centres."""
        x, y = np.meshgrid(np.arange(self.width, dtype=float), np.arange(self.height, dtype=float))
        return np.stack([x, y], -1)
