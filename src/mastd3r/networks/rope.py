"""2-D rotary positions: the first half of each attention head turns by the row, the second by the column.

Rotary embedding: Su et al. 2021. Two dimensions, base 100 and integer (y, x) positions: CroCo v2, as MASt3R has them.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache

import torch
from torch import Tensor

BASE = 100.0


@dataclass(frozen=True)
class RopeTable:
    """cos and signed sin of every token's angles, both (n, d) float32; the sign is that of the rotated partner."""

    cos: Tensor
    sin: Tensor


@cache  # small; and recorded layers read them for ever
def rope_table(rows: int, cols: int, head_dim: int, device: torch.device) -> RopeTable:
    """Angles of a grid of rows x cols tokens, row by row. Raises ValueError where head_dim is no multiple of 4."""
    if head_dim % 4:
        raise ValueError(f"2-D rotary positions: expected a head size that is a multiple of 4, got {head_dim}")
    half = head_dim // 2
    with torch.inference_mode(False), torch.no_grad():
        step = BASE ** (-torch.arange(0, half, 2, dtype=torch.float32, device=device) / half)  # (d/4,)
        y, x = torch.meshgrid(
            torch.arange(rows, dtype=torch.float32, device=device),
            torch.arange(cols, dtype=torch.float32, device=device),
            indexing="ij",
        )
        angle_y, angle_x = y.reshape(-1, 1) * step, x.reshape(-1, 1) * step
        cos = torch.cat([angle_y.cos()] * 2 + [angle_x.cos()] * 2, 1)
        sin = torch.cat([-angle_y.sin(), angle_y.sin(), -angle_x.sin(), angle_x.sin()], 1)
    return RopeTable(cos, sin)


def rotate(x: Tensor, table: RopeTable) -> Tensor:
    """Turn the heads of x (b, n, ..., d) by their token's angles, in float32; the result has x's type."""
    shape = (x.shape[1], *[1] * (x.dim() - 3), x.shape[-1])
    cos, sin = table.cos.view(shape), table.sin.view(shape)
    partner = x.unflatten(-1, (2, 2, -1)).flip(-2).flatten(-3)
    return torch.addcmul(x * cos, partner.to(cos.dtype), sin).to(x.dtype)
