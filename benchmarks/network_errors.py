"""What a two-view network gets wrong, on depths that a sensor measured: for trying alignment without weights.

Each frame's depth is taken as if a network had said it: at a scale of its own, bent by a smooth field, and bleeding
over the edges of things. All is drawn from a seed and the frame's number, so a run can be repeated.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from mastd3r.pointmap.geometric import SensorDepthPointmaps
from mastd3r.types import Frame

Array = NDArray[Any]


@dataclass(frozen=True)
class NetworkErrors:
    """1 sigma of each; ``bleed_px`` at working size."""

    scale: float = 0.02  # of the log of a frame's scale
    bend: float = 0.01  # of the log of depth at the nodes of a 4 x 3 grid, cubic between them
    bleed_px: float = 2.0  # blur of the inverse depth


def disturbed(inv_depth: Array, errors: NetworkErrors, seed: int, index: int) -> Array:
    """(h, w) inverse depth as a network might have said it; 0 stays 0."""
    rng = np.random.default_rng([seed, index])
    log_scale = rng.normal(0, errors.scale) if errors.scale else 0.0
    nodes = rng.normal(0, 1, (3, 4)).astype(np.float32) * np.float32(errors.bend)
    h, w = inv_depth.shape
    field = cv2.resize(nodes, (w, h), interpolation=cv2.INTER_CUBIC)
    known = (inv_depth > 0).astype(np.float32)
    out = inv_depth
    if errors.bleed_px:
        share = cv2.GaussianBlur(known, (0, 0), errors.bleed_px)
        out = cv2.GaussianBlur(inv_depth, (0, 0), errors.bleed_px) / np.maximum(share, 1e-6)
    return (known * out * np.exp(field + np.float32(log_scale))).astype(np.float32)


class DisturbedDepthPointmaps(SensorDepthPointmaps):
    """``--pointmaps depth`` with a network's errors."""

    depth_sigma_ratio: float | None = 0.05

    def __init__(self, width: int, height: int, cell_px: int, errors: NetworkErrors, seed: int) -> None:
        super().__init__(width, height, cell_px)
        self.errors, self.seed = errors, seed

    def _own_inv_depth(self, frame: Frame) -> Array | None:
        inv_depth = super()._own_inv_depth(frame)
        return None if inv_depth is None else disturbed(inv_depth, self.errors, self.seed, frame.index)
