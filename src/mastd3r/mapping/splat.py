"""A finished map that only draws: what run folders are shown from."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch

from ..camera.pinhole import Camera
from .gaussians import Array, GaussianArrays, GaussianMap

NEAR_RATIO = 1e-3  # of the median depth: nearer than that no viewer draws
OPAQUE = 0.5  # alpha above which a pixel has a depth


class Splat:
    """Gaussians of a file, what is nearer than ``near`` left out, ``background`` (RGB, 0..1) behind everything."""

    def __init__(
        self,
        gaussians: GaussianArrays,
        near: float,
        background: Sequence[float] = (0.0, 0.0, 0.0),
        device: str = "cpu",
    ) -> None:
        self._map, self._near = GaussianMap.from_arrays(gaussians, device), near
        self._background = torch.tensor(list(background), dtype=torch.float32, device=device)

    @property
    def count(self) -> int:
        """Gaussians."""
        return len(self._map)

    def render(self, world_from_cam: Array, camera: Camera) -> tuple[Array, Array, Array]:
        """Colour (h,w,3) float32 0..1, depth (h,w) in map units (0 where nothing is), alpha (h,w)."""
        view = torch.from_numpy(np.linalg.inv(np.asarray(world_from_cam, float)))
        K = torch.from_numpy(camera.matrix).to(self._background.device)
        with torch.no_grad():
            drawn = self._map.draw(view, K, camera.width, camera.height, self._near, self._background)
        return as_pictures(*drawn)


def as_pictures(color: torch.Tensor, depth: torch.Tensor, alpha: torch.Tensor) -> tuple[Array, Array, Array]:
    """What a rasteriser gives, as arrays: colour in 0..1, depth divided by alpha (0 where nothing is), alpha."""
    depth = torch.where(alpha > OPAQUE, depth / alpha.clamp_min(1e-6), torch.zeros_like(depth))
    return color.clamp(0, 1).cpu().numpy(), depth.cpu().numpy(), alpha.cpu().numpy()
