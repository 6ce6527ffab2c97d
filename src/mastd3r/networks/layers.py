"""Transformer blocks of MASt3R: pre-norm, self-attention with 2-D rotary positions, cross-attention to the other view.

The residual stream and the norms stay in float32; matrix products run in the type of their own weights. So a model
whose linear layers were cast to half precision does not lose the small terms of 24 additions, and float32 is exact.
Attribute names are those of the released checkpoint.
"""

from __future__ import annotations

import torch.nn.functional as F
from torch import Tensor, nn

from .rope import RopeTable, rotate

NORM_EPSILON = 1e-6


def layer_norm(dim: int) -> nn.LayerNorm:
    """LayerNorm with the epsilon of the released network."""
    return nn.LayerNorm(dim, eps=NORM_EPSILON)


def project(linear: nn.Linear, x: Tensor) -> Tensor:
    """``linear(x)`` in the type of the layer's weights."""
    return linear(x.to(linear.weight.dtype))


def _attend(q: Tensor, k: Tensor, v: Tensor) -> Tensor:
    """q (b, n, heads, d) over k, v (b, m, heads, d) -> (b, n, heads * d)."""
    out = F.scaled_dot_product_attention(q.transpose(1, 2), k.transpose(1, 2), v.transpose(1, 2))
    return out.transpose(1, 2).flatten(2)


class Mlp(nn.Module):
    """Two linear layers with GELU between."""

    def __init__(self, dim_in: int, dim_hidden: int, dim_out: int) -> None:
        super().__init__()
        self.fc1 = nn.Linear(dim_in, dim_hidden)
        self.fc2 = nn.Linear(dim_hidden, dim_out)

    def forward(self, x: Tensor) -> Tensor:
        return self.fc2(F.gelu(project(self.fc1, x)))


class SelfAttention(nn.Module):
    """Tokens of one view look at one another."""

    def __init__(self, dim: int, heads: int) -> None:
        super().__init__()
        self.heads = heads
        self.qkv = nn.Linear(dim, 3 * dim)
        self.proj = nn.Linear(dim, dim)

    def forward(self, x: Tensor, rope: RopeTable) -> Tensor:
        qkv = project(self.qkv, x).unflatten(-1, (3, self.heads, -1))  # (b, n, 3, heads, d)
        q, k = rotate(qkv[:, :, :2], rope).unbind(2)
        return self.proj(_attend(q, k, qkv[:, :, 2]))


class CrossAttention(nn.Module):
    """Tokens of one view look at the other's; each side turns by its own positions."""

    def __init__(self, dim: int, heads: int) -> None:
        super().__init__()
        self.heads = heads
        self.projq = nn.Linear(dim, dim)
        self.projk = nn.Linear(dim, dim)
        self.projv = nn.Linear(dim, dim)
        self.proj = nn.Linear(dim, dim)

    def forward(self, x: Tensor, memory: Tensor, rope: RopeTable, memory_rope: RopeTable) -> Tensor:
        split = (self.heads, -1)
        q = rotate(project(self.projq, x).unflatten(-1, split), rope)
        k = rotate(project(self.projk, memory).unflatten(-1, split), memory_rope)
        v = project(self.projv, memory).unflatten(-1, split)
        return self.proj(_attend(q, k, v))


class EncoderBlock(nn.Module):
    """Self-attention and MLP."""

    def __init__(self, dim: int, heads: int, mlp_ratio: int) -> None:
        super().__init__()
        self.norm1 = layer_norm(dim)
        self.attn = SelfAttention(dim, heads)
        self.norm2 = layer_norm(dim)
        self.mlp = Mlp(dim, mlp_ratio * dim, dim)

    def forward(self, x: Tensor, rope: RopeTable) -> Tensor:
        x = x + self.attn(self.norm1(x), rope)
        return x + self.mlp(self.norm2(x))


class DecoderBlock(nn.Module):
    """Self-attention, cross-attention to the other view's tokens of the layer before, and MLP."""

    def __init__(self, dim: int, heads: int, mlp_ratio: int) -> None:
        super().__init__()
        self.norm1 = layer_norm(dim)
        self.attn = SelfAttention(dim, heads)
        self.cross_attn = CrossAttention(dim, heads)
        self.norm2 = layer_norm(dim)
        self.norm3 = layer_norm(dim)
        self.mlp = Mlp(dim, mlp_ratio * dim, dim)
        self.norm_y = layer_norm(dim)

    def forward(self, x: Tensor, other: Tensor, rope: RopeTable, other_rope: RopeTable) -> Tensor:
        x = x + self.attn(self.norm1(x), rope)
        x = x + self.cross_attn(self.norm2(x), self.norm_y(other), rope, other_rope)
        return x + self.mlp(self.norm3(x))
