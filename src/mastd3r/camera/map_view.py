"""Between the camera's own image and the pinhole image that the map works with."""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from .opencv_lens import OpenCvLens
from .pinhole import Camera

Array = NDArray[Any]


class MapView:
    """Maps photographs to pinhole images of map size (grown so that nothing is cut) and renders back."""

    def __init__(self, full: Camera | OpenCvLens, width_px: int, tau_px: float) -> None:
        """``full`` is the lens over the full-size image; ``width_px`` the width of training images and renders."""
        width = min(width_px, full.width)
        height = max(8, round(full.height * width / full.width))
        self.tau_px = tau_px
        self.camera = full.resized(width, height)  # with its distortion, as photographs are
        self.pad_px = _padding(self.camera)
        self.pinhole = self.camera.pinhole.padded(self.pad_px)
        grid = self.pinhole.pixel_grid()
        rays = self.pinhole.rays(grid)
        self._from_photo = self.camera.project(rays).astype(np.float32)
        inside = (self._from_photo >= -0.5) & (self._from_photo <= np.array([width - 0.5, height - 0.5]))
        self._inside: Array = np.asarray(inside.all(-1), np.float32)
        self._from_pinhole = self.pinhole.project(self.camera.rays(self.camera.pixel_grid())).astype(np.float32)

    def pinhole_image(self, image: Array) -> tuple[Array, Array]:
        """(h, w, 3) uint8 pinhole image of a full-size uint8 photograph, and (h, w) 1 where it has data."""
        size = (self.camera.width, self.camera.height)
        small = cv2.resize(image, size, interpolation=cv2.INTER_AREA)
        return self._warped(small, self._from_photo, cv2.INTER_CUBIC), self._inside

    def pinhole_map(self, values: Array) -> Array:
        """(h, w) float32 pinhole view of a map over the photograph at any size."""
        small = cv2.resize(values, (self.camera.width, self.camera.height), interpolation=cv2.INTER_LINEAR)
        return self._warped(small, self._from_photo, cv2.INTER_LINEAR)

    def as_photograph(self, rendered: Array) -> Array:
        """A pinhole render as the camera's own lens would have taken it, at map size."""
        return self._warped(rendered, self._from_pinhole, cv2.INTER_CUBIC)

    def depth_as_photograph(self, depth: Array) -> Array:
        """A pinhole depth image under the camera's own lens; never a mean of two depths."""
        return self._warped(depth, self._from_pinhole, cv2.INTER_NEAREST)

    def _warped(self, image: Array, at: Array, interpolation: int) -> Array:
        """Colours are cubic: linear ones are so soft after the way there and back that it shows in PSNR."""
        if not self.camera.distorted and self.pad_px == 0:
            return image
        return cv2.remap(image, at, None, interpolation, borderMode=cv2.BORDER_REPLICATE)


def _padding(camera: Camera | OpenCvLens) -> int:
    """Pixels by which the pinhole image must grow to hold every pixel of the photograph."""
    if not camera.distorted:
        return 0
    w, h = camera.width - 1.0, camera.height - 1.0
    edge = np.array([[0, 0], [w, 0], [0, h], [w, h], [w / 2, 0], [w / 2, h], [0, h / 2], [w, h / 2]])
    seen = camera.pinhole.project(camera.rays(edge))
    over = np.maximum(-seen.min(0), seen.max(0) - np.array([w, h])).max()
    return int(np.clip(np.ceil(over), 0, camera.width // 4))
