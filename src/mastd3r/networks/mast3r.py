"""MASt3R (Leroy et al. 2024): two images in, both pointmaps in the first one's camera and descriptors out.

One encoder sees each image alone; two decoders look at one another; two heads read both. What the encoder says of a
frame does not depend on its partner, so callers keep ``Encoded`` and decode it with as many frames as they like.
The sizes are those of the released checkpoint; names of parameters are its names. Portrait images need nothing special:
positions are those of the grid as it is.
"""

from __future__ import annotations

import zlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from .dpt import Head, HeadOutput
from .layers import DecoderBlock, EncoderBlock, layer_norm, project
from .rope import RopeTable, rope_table

Array = NDArray[Any]


@dataclass(frozen=True)
class Mast3rConfig:
    """Sizes of the network."""

    enc_dim: int
    enc_depth: int
    enc_heads: int
    dec_dim: int
    dec_depth: int
    dec_heads: int
    dpt_layer_dims: tuple[int, int, int, int]
    dpt_channels: int
    dpt_last: int  # channels before the last 1 x 1 convolution
    descriptor_dim: int = 24
    patch_px: int = 16
    mlp_ratio: int = 4

    @classmethod
    def released(cls) -> Mast3rConfig:
        """ViT-L encoder, base decoders, DPT and MLP heads: the metric checkpoint, 688,638,856 parameters."""
        return cls(1024, 24, 16, 768, 12, 12, (96, 192, 384, 768), 256, 128)

    @classmethod
    def tiny(cls) -> Mast3rConfig:
        """The same network a thousand times smaller, for tests without weights."""
        return cls(48, 2, 3, 32, 4, 2, (8, 12, 16, 24), 16, 8)

    @property
    def hooks(self) -> tuple[int, int, int, int]:
        """Layers that the DPT reads: 0 is the encoder, i the i-th pair of decoder blocks."""
        return 0, self.dec_depth // 2, 3 * self.dec_depth // 4, self.dec_depth


@dataclass(frozen=True)
class Encoded:
    """What the encoder says of images of one size."""

    tokens: Tensor  # (b, rows * cols, c) after the encoder's norm, in the type of the matrix products
    grid: tuple[int, int]  # (rows, cols)

    def __len__(self) -> int:
        return self.tokens.shape[0]


def stacked(parts: Sequence[Encoded]) -> Encoded:
    """One batch of several. Raises ValueError where the grids differ."""
    grids = {p.grid for p in parts}
    if len(grids) != 1:
        raise ValueError(f"stacked: expected encodings of one grid, got {sorted(grids)}")
    return Encoded(torch.cat([p.tokens for p in parts]), parts[0].grid)


class PatchEmbed(nn.Module):
    """Patches of the image to tokens, row by row."""

    def __init__(self, dim: int, patch_px: int) -> None:
        super().__init__()
        self.proj = nn.Conv2d(3, dim, patch_px, stride=patch_px)

    def forward(self, images: Tensor) -> Tensor:
        return self.proj(images.to(self.proj.weight.dtype)).flatten(2).transpose(1, 2)


class Mast3r(nn.Module):
    """The network. Weights come from ``checkpoint.load_mast3r`` or ``random_mast3r``."""

    def __init__(self, config: Mast3rConfig) -> None:
        super().__init__()
        c = self.config = config
        self.mask_token = nn.Parameter(torch.zeros(1, 1, c.dec_dim))  # of the pre-training; no use here
        self.patch_embed = PatchEmbed(c.enc_dim, c.patch_px)
        self.enc_blocks = nn.ModuleList(EncoderBlock(c.enc_dim, c.enc_heads, c.mlp_ratio) for _ in range(c.enc_depth))
        self.enc_norm = layer_norm(c.enc_dim)
        self.decoder_embed = nn.Linear(c.enc_dim, c.dec_dim)
        self.dec_blocks = _decoder(c)
        self.dec_blocks2 = _decoder(c)
        self.dec_norm = layer_norm(c.dec_dim)
        self.downstream_head1 = _head(c)
        self.downstream_head2 = _head(c)

    def in_precision(self, dtype: torch.dtype) -> Mast3r:
        """Cast the matrix products of encoder and decoders; norms, residual stream and heads stay in float32."""
        for name, module in self.named_modules():
            if isinstance(module, nn.Linear | nn.Conv2d) and not name.startswith("downstream_head"):
                module.to(dtype)
        return self

    def encode(self, images: Tensor) -> Encoded:
        """Images (b, 3, h, w), values of ``preprocess.prepare_image``. Raises ValueError for a wrong shape."""
        patch = self.config.patch_px
        if images.dim() != 4 or images.shape[1] != 3 or images.shape[2] % patch or images.shape[3] % patch:
            raise ValueError(f"encode: expected (b, 3, h, w) with h, w multiples of {patch}, got {tuple(images.shape)}")
        grid = (images.shape[2] // patch, images.shape[3] // patch)
        return Encoded(self.encode_tokens(images, self._rope(grid, images.device, True)), grid)

    def decode(self, first: Encoded, second: Encoded) -> tuple[HeadOutput, HeadOutput]:
        """Row n of ``first`` with row n of ``second``; all points are in the first view's camera.

        The grids may differ. Raises ValueError where the batches do.
        """
        if len(first) != len(second):
            raise ValueError(f"decode: expected batches of one size, got {len(first)} and {len(second)}")
        device = first.tokens.device
        ropes = self._rope(first.grid, device, False), self._rope(second.grid, device, False)
        maps1, maps2 = self.decode_tokens(first.tokens, second.tokens, *ropes)
        return self.downstream_head1(maps1, *first.grid), self.downstream_head2(maps2, *second.grid)

    def encode_tokens(self, images: Tensor, rope: RopeTable) -> Tensor:
        """The encoder on tensors alone: (b, 3, h, w) -> (b, n, c)."""
        x = self.patch_embed(images).float()
        for block in self.enc_blocks:
            x = block(x, rope)
        return self.enc_norm(x).to(self.decoder_embed.weight.dtype)

    def decode_tokens(
        self, first: Tensor, second: Tensor, rope1: RopeTable, rope2: RopeTable
    ) -> tuple[list[Tensor], list[Tensor]]:
        """The decoders on tensors alone: four token maps a view, at ``config.hooks``."""
        maps1, maps2 = [first], [second]
        x1, x2 = project(self.decoder_embed, first).float(), project(self.decoder_embed, second).float()
        for layer, (block1, block2) in enumerate(zip(self.dec_blocks, self.dec_blocks2, strict=True), 1):
            x1, x2 = block1(x1, x2, rope1, rope2), block2(x2, x1, rope2, rope1)
            if layer in self.config.hooks[:3]:
                maps1.append(x1)
                maps2.append(x2)
        return [*maps1, self.dec_norm(x1)], [*maps2, self.dec_norm(x2)]

    def _rope(self, grid: tuple[int, int], device: torch.device, encoder: bool) -> RopeTable:
        c = self.config
        head_dim = c.enc_dim // c.enc_heads if encoder else c.dec_dim // c.dec_heads
        return rope_table(*grid, head_dim, device)


def _decoder(c: Mast3rConfig) -> nn.ModuleList:
    return nn.ModuleList(DecoderBlock(c.dec_dim, c.dec_heads, c.mlp_ratio) for _ in range(c.dec_depth))


def _head(c: Mast3rConfig) -> Head:
    token_dims = (c.enc_dim, c.dec_dim, c.dec_dim, c.dec_dim)
    return Head(token_dims, c.dpt_layer_dims, c.dpt_channels, c.dpt_last, c.descriptor_dim, c.patch_px)


Views = tuple[HeadOutput, HeadOutput]


def in_both_orders(decode: Callable[[Encoded, Encoded], Views], a: Encoded, b: Encoded) -> tuple[Views, Views]:
    """((a, b in a's camera), (b, a in b's camera)), as one batch where the grids are equal."""
    if a.grid != b.grid:
        return decode(a, b), decode(b, a)
    first, second = decode(stacked([a, b]), stacked([b, a]))
    n = len(a)
    return (_rows(first, 0, n), _rows(second, 0, n)), (_rows(first, n, 2 * n), _rows(second, n, 2 * n))


def _rows(out: HeadOutput, start: int, end: int) -> HeadOutput:
    return HeadOutput(
        out.points[start:end],
        out.confidence[start:end],
        out.descriptors[start:end],
        out.descriptor_confidence[start:end],
    )


def random_mast3r(config: Mast3rConfig, seed: int = 0) -> Mast3r:
    """A network with random weights that are the same everywhere, ready for inference."""
    with torch.device("meta"):
        model = Mast3r(config)
    shapes = {name: tuple(value.shape) for name, value in model.state_dict().items()}
    state = {name: torch.from_numpy(value) for name, value in seeded_weights(shapes, seed).items()}
    model.load_state_dict(state, assign=True)
    return model.requires_grad_(False).eval()


def seeded_weights(shapes: dict[str, tuple[int, ...]], seed: int) -> dict[str, Array]:
    """Random float32 arrays that depend on a name, its shape and the seed only; doubled names get equal values."""
    made: dict[str, Array] = {}
    for name, shape in sorted(shapes.items()):
        source = name
        for level in range(4):
            source = source.replace(f"scratch.layer_rn.{level}.", f"scratch.layer{level + 1}_rn.")
        if source in made:
            made[name] = made[source]
            continue
        mean, deviation = weight_law(source, shape)
        values = np.random.RandomState(zlib.crc32(source.encode()) ^ seed).standard_normal(shape).astype(np.float32)
        made[name] = (mean + np.float32(deviation) * values).astype(np.float32)
    return made


def weight_law(name: str, shape: tuple[int, ...]) -> tuple[Array, float]:
    """Mean, to be broadcast, and deviation of a parameter's random values.

    Weights have variance 1 / fan-in, so that signals keep their size through the layers; scales of norms are near 1.
    """
    if len(shape) > 1:
        transposed = ".act_postprocess.0.1." in name or ".act_postprocess.1.1." in name
        fan_in = shape[0] if transposed else int(np.prod(shape[1:]))
        last = name.endswith(".dpt.head.4.weight")  # its outputs stand in an exponent
        return np.zeros(1, np.float32), fan_in**-0.5 * (0.2 if last else 1)
    if "norm" in name.split(".")[-2] and name.endswith(".weight"):
        return np.ones(1, np.float32), 0.1
    before = name.endswith(".dpt.head.4.bias")  # points lie before the camera, not around its centre
    return np.array([0, 0, 2.5, 0] if before else [0], np.float32), 0.1
