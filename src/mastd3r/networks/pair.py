"""MASt3R for callers that know numpy only: prepare a photograph, encode it once, decode it with any other.

Nothing here asks the caller for a tensor; ``EncodedFrame`` is opaque and may be kept as long as the frame is.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from ..errors import ConfigError
from .dpt import HeadOutput
from .mast3r import Encoded, Mast3r, stacked
from .preprocess import LONG_SIDE_PX, PixelMapping, prepare_image

Array = NDArray[Any]

PRECISIONS = {"float32": torch.float32, "bfloat16": torch.bfloat16, "float16": torch.float16}


@dataclass(frozen=True)
class Prepared:
    """A photograph as the network takes it."""

    image: Array  # (3, h, w) float32 in -1 … 1
    mapping: PixelMapping  # between its pixels and the photograph's
    height: int
    width: int


@dataclass(frozen=True)
class EncodedFrame:
    """What the encoder says of one frame, on the device. Reused for every pair that the frame is in."""

    encoded: Encoded  # batch of one
    pooled: Array  # (c,) float32, unit length: the mean token, for place recognition
    mapping: PixelMapping
    height: int
    width: int


@dataclass(frozen=True)
class NetworkView:
    """One view of a pair, float32: tensors on the device, or arrays after ``numpy()``."""

    points: Any  # (h, w, 3) in the pair's first camera
    confidence: Any  # (h, w) > 1
    descriptors: Any  # (h, w, c) unit length
    descriptor_confidence: Any  # (h, w) > 0

    def numpy(self) -> NetworkView:
        """The same as numpy arrays."""
        return NetworkView(**{f.name: _array(getattr(self, f.name)) for f in fields(self)})


@dataclass(frozen=True)
class NetworkPair:
    """Two views seen together, both in the first one's camera; and the other order where it was asked for."""

    first: NetworkView
    second: NetworkView
    reverse: NetworkPair | None = None  # second as first, and the other way round

    def numpy(self) -> NetworkPair:
        """The same as numpy arrays."""
        reverse = self.reverse.numpy() if self.reverse else None
        return NetworkPair(self.first.numpy(), self.second.numpy(), reverse)


class PairNetwork:
    """MASt3R on a device, in a precision.

    ``compile`` fuses encoder, decoders and heads with ``torch.compile``: the first frames of every image size take
    minutes, later ones are faster. Heads run in float32 whatever ``dtype`` says.
    Raises ConfigError for an unknown precision and for a device that torch does not know or does not have.
    """

    def __init__(
        self,
        model: Mast3r,
        device: str = "cpu",
        dtype: str = "float32",
        compile: bool = False,
        long_side_px: int = LONG_SIDE_PX,
    ) -> None:
        if dtype not in PRECISIONS:
            raise ConfigError(f"network precision: expected one of {', '.join(PRECISIONS)}, got {dtype!r}")
        try:
            self.device = torch.device(device)
            self.model = model.to(self.device).in_precision(PRECISIONS[dtype]).requires_grad_(False).eval()
        except (RuntimeError, AssertionError) as e:  # torch built without the device raises AssertionError
            raise ConfigError(f"network device: expected one that torch has, got {device!r}: {_first_line(e)}") from e
        self.long_side_px = long_side_px
        if compile:
            for name in ("encode_tokens", "decode_tokens"):
                setattr(self.model, name, torch.compile(getattr(self.model, name), dynamic=False))
            for head in (self.model.downstream_head1, self.model.downstream_head2):
                head.compile(dynamic=False)

    def prepare(self, image: Array) -> Prepared:
        """(H, W, 3) uint8 RGB -> network image and pixel mapping. Raises InputError."""
        values, mapping = prepare_image(image, self.long_side_px)
        return Prepared(values, mapping, values.shape[1], values.shape[2])

    def encode(self, prepared: Prepared) -> EncodedFrame:
        """The encoder's tokens of one frame."""
        return self.encode_batch([prepared])[0]

    @torch.inference_mode()
    def encode_batch(self, prepared: Sequence[Prepared]) -> list[EncodedFrame]:
        """The same of several frames of one size, in one pass. Raises ValueError where sizes differ."""
        images = torch.from_numpy(np.stack([p.image for p in prepared])).to(self.device)
        encoded = self.model.encode(images)
        pooled = torch.nn.functional.normalize(encoded.tokens.float().mean(1), dim=-1).cpu().numpy()
        return [
            EncodedFrame(Encoded(encoded.tokens[n : n + 1], encoded.grid), pooled[n], p.mapping, p.height, p.width)
            for n, p in enumerate(prepared)
        ]

    def pair(self, a: EncodedFrame, b: EncodedFrame, symmetric: bool = False) -> NetworkPair:
        """Both views in a's camera; ``symmetric``: also both in b's."""
        return self.pairs([(a, b)], symmetric)[0]

    @torch.inference_mode()
    def pairs(self, pairs: Sequence[tuple[EncodedFrame, EncodedFrame]], symmetric: bool = False) -> list[NetworkPair]:
        """Several pairs in one pass; all firsts have one size, and all seconds. Raises ValueError otherwise."""
        if not pairs:
            return []
        a, b = stacked([a.encoded for a, _ in pairs]), stacked([b.encoded for _, b in pairs])
        if not symmetric:
            first, second = self.model.decode(a, b)
            return [NetworkPair(_view(first, n), _view(second, n)) for n in range(len(pairs))]
        (a_in_a, b_in_a), (b_in_b, a_in_b) = self.model.decode_symmetric(a, b)
        return [
            NetworkPair(_view(a_in_a, n), _view(b_in_a, n), NetworkPair(_view(b_in_b, n), _view(a_in_b, n)))
            for n in range(len(pairs))
        ]


def _view(out: HeadOutput, n: int) -> NetworkView:
    return NetworkView(out.points[n], out.confidence[n], out.descriptors[n], out.descriptor_confidence[n])


def _array(value: Tensor | Array) -> Array:
    return value.cpu().numpy() if isinstance(value, Tensor) else value


def _first_line(error: Exception) -> str:
    return (str(error).splitlines() or [type(error).__name__])[0]
