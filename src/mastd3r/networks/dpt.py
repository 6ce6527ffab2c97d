"""The heads: a DPT for points and their confidence, an MLP for descriptors and theirs. All in float32.

DPT: Ranftl et al. 2021. Four token maps of the network become a pyramid at strides 4, 8, 16 and 32 px, fused from
coarse to fine. Attribute names are those of the released checkpoint, its unused and doubled entries included.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from .layers import Mlp


@dataclass(frozen=True)
class HeadOutput:
    """What the network says of one view, float32; h, w are pixels of the network's image."""

    points: Tensor  # (b, h, w, 3) in the FIRST view's camera, metres for the metric checkpoint
    confidence: Tensor  # (b, h, w) of the points, > 1
    descriptors: Tensor  # (b, h, w, c) unit length
    descriptor_confidence: Tensor  # (b, h, w) > 0


class ResidualUnit(nn.Module):
    """x + two 3 x 3 convolutions of it, each behind a ReLU."""

    def __init__(self, channels: int) -> None:
        super().__init__()
        self.conv1 = nn.Conv2d(channels, channels, 3, padding=1)
        self.conv2 = nn.Conv2d(channels, channels, 3, padding=1)

    def forward(self, x: Tensor) -> Tensor:
        return self.conv2(F.relu(self.conv1(F.relu(x)))) + x


class Fusion(nn.Module):
    """Adds a finer level to the coarser result and doubles the size."""

    def __init__(self, channels: int) -> None:
        super().__init__()
        self.out_conv = nn.Conv2d(channels, channels, 1)
        self.resConfUnit1 = ResidualUnit(channels)
        self.resConfUnit2 = ResidualUnit(channels)

    def forward(self, x: Tensor, finer: Tensor | None = None) -> Tensor:
        if finer is not None:
            x = x + self.resConfUnit1(finer)
        # A 1 x 1 convolution and an interpolation whose weights sum to 1 commute: the convolution goes first,
        # on a quarter of the pixels.
        x = self.out_conv(self.resConfUnit2(x))
        return F.interpolate(x, scale_factor=2, mode="bilinear", align_corners=True)


class Scratch(nn.Module):
    """The pyramid's projections and fusions."""

    def __init__(self, layer_dims: Sequence[int], channels: int) -> None:
        super().__init__()
        d1, d2, d3, d4 = layer_dims
        self.layer1_rn = nn.Conv2d(d1, channels, 3, padding=1, bias=False)
        self.layer2_rn = nn.Conv2d(d2, channels, 3, padding=1, bias=False)
        self.layer3_rn = nn.Conv2d(d3, channels, 3, padding=1, bias=False)
        self.layer4_rn = nn.Conv2d(d4, channels, 3, padding=1, bias=False)
        self.layer_rn = nn.ModuleList([self.layer1_rn, self.layer2_rn, self.layer3_rn, self.layer4_rn])
        self.refinenet1 = Fusion(channels)
        self.refinenet2 = Fusion(channels)
        self.refinenet3 = Fusion(channels)
        self.refinenet4 = Fusion(channels)  # its resConfUnit1 has weights and no use


class Dpt(nn.Module):
    """Four token maps -> (b, 4, h, w): x y z and the confidence, before their activations."""

    def __init__(self, token_dims: Sequence[int], layer_dims: Sequence[int], channels: int, last: int) -> None:
        super().__init__()
        t, d = token_dims, layer_dims
        self.scratch = Scratch(d, channels)
        self.act_postprocess = nn.ModuleList(
            [
                nn.Sequential(nn.Conv2d(t[0], d[0], 1), nn.ConvTranspose2d(d[0], d[0], 4, stride=4)),
                nn.Sequential(nn.Conv2d(t[1], d[1], 1), nn.ConvTranspose2d(d[1], d[1], 2, stride=2)),
                nn.Sequential(nn.Conv2d(t[2], d[2], 1)),
                nn.Sequential(nn.Conv2d(t[3], d[3], 1), nn.Conv2d(d[3], d[3], 3, stride=2, padding=1)),
            ]
        )
        self.head = nn.Sequential(
            nn.Conv2d(channels, channels // 2, 3, padding=1),
            nn.UpsamplingBilinear2d(scale_factor=2),  # align_corners=True
            nn.Conv2d(channels // 2, last, 3, padding=1),
            nn.ReLU(),
            nn.Conv2d(last, 4, 1),
        )

    def forward(self, tokens: Sequence[Tensor], rows: int, cols: int) -> Tensor:
        maps = [t.transpose(1, 2).unflatten(2, (rows, cols)) for t in tokens]
        maps = [stage(m) for stage, m in zip(self.act_postprocess, maps, strict=True)]
        s = self.scratch
        level1, level2, level3, level4 = (conv(m) for conv, m in zip(s.layer_rn, maps, strict=True))
        path = s.refinenet4(level4)[:, :, : level3.shape[2], : level3.shape[3]]  # odd grids: one row too many
        path = s.refinenet3(path, level3)
        path = s.refinenet2(path, level2)
        return self.head(s.refinenet1(path, level1))


class Head(nn.Module):
    """Points and descriptors of one view from its tokens."""

    def __init__(
        self,
        token_dims: Sequence[int],
        layer_dims: Sequence[int],
        channels: int,
        last: int,
        descriptor_dim: int,
        patch_px: int,
    ) -> None:
        super().__init__()
        self.patch_px, self.descriptor_dim = patch_px, descriptor_dim
        self.dpt = Dpt(token_dims, layer_dims, channels, last)
        dim = token_dims[0] + token_dims[-1]
        self.head_local_features = Mlp(dim, 4 * dim, (descriptor_dim + 1) * patch_px**2)

    def forward(self, tokens: Sequence[Tensor], rows: int, cols: int) -> HeadOutput:
        """tokens: four (b, rows * cols, c) maps, the encoder's first and the last decoder layer's last."""
        tokens = [t.float() for t in tokens]
        raw = self.dpt(tokens, rows, cols).permute(0, 2, 3, 1)
        local = self._per_pixel(self.head_local_features(torch.cat([tokens[0], tokens[-1]], -1)), rows, cols)
        return HeadOutput(
            points_from_raw(raw[..., :3]),
            1 + raw[..., 3].exp(),
            F.normalize(local[..., : self.descriptor_dim], dim=-1),
            local[..., self.descriptor_dim].exp(),
        )

    def _per_pixel(self, x: Tensor, rows: int, cols: int) -> Tensor:
        """(b, n, c * patch²), channel first within a token -> (b, h, w, c)."""
        p = self.patch_px
        x = x.unflatten(2, (-1, p, p)).unflatten(1, (rows, cols))  # b rows cols c py px
        return x.permute(0, 1, 4, 2, 5, 3).reshape(x.shape[0], rows * p, cols * p, x.shape[3])


def points_from_raw(raw: Tensor) -> Tensor:
    """Distance is expm1 of the raw length, direction is kept: (..., 3) -> (..., 3). The origin stays the origin."""
    length = raw.norm(dim=-1, keepdim=True).clamp_min(1e-8)
    return (raw * (torch.expm1(length) / length)).contiguous()
