"""MASt3R for callers that know numpy only: prepare a photograph, encode it once, decode it with any other.

Nothing here asks the caller for a tensor; ``EncodedFrame`` is opaque and may be kept as long as the frame is.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from functools import cached_property
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from ..errors import ConfigError
from .dpt import HeadOutput
from .mast3r import Encoded, Mast3r, in_both_orders, stacked
from .preprocess import LONG_SIDE_PX, PixelMapping, prepare_image
from .products import products
from .record import Recorder, can_record

Array = NDArray[Any]

PRECISIONS = {"float32": torch.float32, "bfloat16": torch.bfloat16, "float16": torch.float16}
EXECUTIONS = ("eager", "graph", "compile")


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
    mapping: PixelMapping
    height: int
    width: int

    @cached_property
    def pooled(self) -> Array:
        """(c,) float32, unit length: the mean token, for place recognition."""
        mean = self.encoded.tokens[0].float().mean(0)
        return np.asarray(torch.nn.functional.normalize(mean, dim=0).cpu().numpy())


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

    ``dtype`` is that of the matrix products of encoder and decoders. Heads and norms are float32 whatever it says; but
    on an accelerator the heads' products may round to TF32 unless ``dtype`` is float32, which is exact.
    ``execution``: "eager" launches layer by layer. "graph" records the layers of every image size at its first frame
    and plays them back, on a CUDA device. "compile" fuses them with ``torch.compile``: the first frames of every image
    size take minutes. Raises ConfigError for an unknown precision or execution, for a device that torch does not know
    or does not have, and for "graph" on a device that records nothing.
    """

    def __init__(
        self,
        model: Mast3r,
        device: str = "cpu",
        dtype: str = "float32",
        execution: str = "eager",
        long_side_px: int = LONG_SIDE_PX,
    ) -> None:
        if dtype not in PRECISIONS:
            raise ConfigError(f"network precision: expected one of {', '.join(PRECISIONS)}, got {dtype!r}")
        if execution not in EXECUTIONS:
            raise ConfigError(f"network execution: expected one of {', '.join(EXECUTIONS)}, got {execution!r}")
        try:
            self.device = torch.device(device)
            self.model = model.to(self.device).in_precision(PRECISIONS[dtype]).requires_grad_(False).eval()
        except (RuntimeError, AssertionError) as e:  # torch built without the device raises AssertionError
            raise ConfigError(f"network device: expected one that torch has, got {device!r}: {_first_line(e)}") from e
        if self.device.type != "cpu":
            for conv in (m for m in self.model.modules() if isinstance(m, nn.Conv2d | nn.ConvTranspose2d)):
                # the order that tokens come in, and fast kernels want
                conv.weight.data = conv.weight.data.to(memory_format=torch.channels_last)
        self.long_side_px, self.dtype = long_side_px, PRECISIONS[dtype]
        self.encode_images, self.decode_views = self.model.encode, self.model.decode  # on tensors
        if execution == "graph" and not can_record(self.device):
            raise ConfigError(f"network execution 'graph': expected a CUDA device, got {device!r}")
        self.recorder = Recorder(self.device) if execution == "graph" else None
        if self.recorder is not None:
            self._record(self.recorder)
        if execution == "compile":
            for name in ("encode_tokens", "decode_tokens"):
                setattr(self.model, name, torch.compile(getattr(self.model, name), dynamic=False))
            for head in (self.model.downstream_head1, self.model.downstream_head2):
                head.compile(dynamic=False)

    def _record(self, recorder: Recorder) -> None:
        """The layers as recordings of plain tensors, one a shape."""
        patch = self.model.config.patch_px
        encode = recorder.recorded(lambda images: self.model.encode(images).tokens)

        def encoded(images: Tensor) -> Encoded:
            return Encoded(encode(images), (images.shape[2] // patch, images.shape[3] // patch))

        decoders: dict[Any, Any] = {}  # by the grids: one number of tokens has several

        def decoded(first: Encoded, second: Encoded) -> tuple[HeadOutput, HeadOutput]:
            grids = first.grid, second.grid
            if grids not in decoders:

                def layers(a: Tensor, b: Tensor) -> list[tuple[Tensor, ...]]:
                    views = self.model.decode(Encoded(a, grids[0]), Encoded(b, grids[1]))
                    return [tuple(getattr(view, f.name) for f in fields(HeadOutput)) for view in views]

                decoders[grids] = recorder.recorded(layers)
            one, two = decoders[grids](first.tokens, second.tokens)
            return HeadOutput(*one), HeadOutput(*two)

        self.encode_images, self.decode_views = encoded, decoded

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
        images = torch.from_numpy(np.stack([p.image for p in prepared]))
        if self.device.type != "cpu":  # from locked memory, so that this thread need not wait for the device's queue
            images = images.pin_memory().to(self.device, non_blocking=True)
        with products(self.dtype):
            encoded = self.encode_images(images)
        return [
            EncodedFrame(Encoded(encoded.tokens[n : n + 1], encoded.grid), p.mapping, p.height, p.width)
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
        with products(self.dtype):
            orders = in_both_orders(self.decode_views, a, b) if symmetric else (self.decode_views(a, b),)
        found = [[NetworkPair(_view(one, n), _view(two, n)) for n in range(len(pairs))] for one, two in orders]
        return [replace(there, reverse=back) for there, back in zip(*found, strict=True)] if symmetric else found[0]


def _view(out: HeadOutput, n: int) -> NetworkView:
    return NetworkView(out.points[n], out.confidence[n], out.descriptors[n], out.descriptor_confidence[n])


def _array(value: Tensor | Array) -> Array:
    return value.cpu().numpy() if isinstance(value, Tensor) else value


def _first_line(error: Exception) -> str:
    return (str(error).splitlines() or [type(error).__name__])[0]
