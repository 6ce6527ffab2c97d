"""What the map is trained on: photographs and pixel weights at a few sizes, kept in as few bytes as they need."""

from __future__ import annotations

import cv2
import numpy as np
import torch

from ..camera.pinhole import Camera
from ..config import MappingConfig
from ..types import View
from .gaussians import Array
from .losses import pixel_weight

_ALL_DATA = 0.999  # of a small pixel's area must have data


class Targets:
    """Photograph and weight of eq. (17) of every view, made when they are first asked for.

    A photograph stays as bytes; a small one and every weight (half precision) are kept once made.
    """

    def __init__(self, config: MappingConfig, device: str) -> None:
        self._config, self._device = config, device
        self._images: dict[tuple[int, int], Array] = {}
        self._weights: dict[tuple[int, int], torch.Tensor] = {}

    def get(self, number: int, view: View, shrink: int) -> tuple[torch.Tensor, torch.Tensor]:
        """(h, w, 3) float32 0..1 and (h, w) float32 of view ``number`` at a ``shrink``-th of its size."""
        camera = shrunk(view.camera, shrink)
        if (number, shrink) not in self._weights:
            self._images[number, shrink] = _smaller(view.image, camera)
            self._weights[number, shrink] = self._weight(view, camera).half()
        image = torch.from_numpy(self._images[number, shrink]).to(self._device)
        return image.float().mul_(1 / 255), self._weights[number, shrink].to(self._device).float()

    def _weight(self, view: View, camera: Camera) -> torch.Tensor:
        c = self._config
        static = torch.from_numpy(smaller_static(view.static, camera))
        u = None
        if view.uncertainty is not None:
            u = torch.from_numpy(_smaller(np.asarray(view.uncertainty, np.float32), camera))
        return pixel_weight(c.loss, static, u, c.dynamic_weight, c.hard_weight, c.lambda_uncertainty, c.paper_loss)


def shrunk(camera: Camera, shrink: int) -> Camera:
    """The same lens over an image a ``shrink``-th as wide and high."""
    if shrink == 1:
        return camera
    return camera.resized(max(8, round(camera.width / shrink)), max(8, round(camera.height / shrink)))


def smaller_static(static: Array, camera: Camera) -> Array:
    """(h, w) float32 of 1 - P(moving) at the camera's size; a pixel that is partly without data has none."""
    full = np.asarray(static, np.float32)
    if full.shape == (camera.height, camera.width):
        return full
    data = _smaller((full > 0).astype(np.float32), camera) > _ALL_DATA
    return np.asarray(np.maximum(_smaller(full, camera), 0.01) * data, np.float32)


def _smaller(image: Array, camera: Camera) -> Array:
    if image.shape[:2] == (camera.height, camera.width):
        return np.ascontiguousarray(image)
    return np.asarray(cv2.resize(image, (camera.width, camera.height), interpolation=cv2.INTER_AREA))
