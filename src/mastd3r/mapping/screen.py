"""What a rasteriser tells about each Gaussian on the screen, for densification."""

from __future__ import annotations

from dataclasses import dataclass

import torch


@dataclass
class ScreenStats:
    """Filled by ``rasterise.rasterization``: radii at once, gradients when backward has run."""

    radii_px: torch.Tensor | None = None  # (N, 2) int, half width and height of the drawn box; 0 = not seen
    mean_grad_px: torch.Tensor | None = None  # (N, 2) d loss / d projected mean, per pixel
