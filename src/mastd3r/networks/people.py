"""P(person) of every pixel, by a small network whose weights come with the package.

The network is MediaPipe's selfie segmentation (general model, Apache-2.0), a MobileNetV3 with a light decoder, made for
phones: people within a few metres of the camera. ``weights/README.md`` says where its numbers are from.
"""

from __future__ import annotations

import hashlib
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from ..errors import InputError
from .people_kernels import (
    HARD_SWISH,
    LINEAR,
    RELU,
    Kept,
    add_gated,
    channel_means,
    depthwise,
    patches,
    pointwise,
    shuffled,
    twice,
)

Array = NDArray[Any]
WEIGHTS = Path(__file__).resolve().parent / "weights" / "people.npy"
DIGEST = "4f42e574948c69510e6ff9b21da63842acd92b16bd37b3ad4048b24b53b48234"  # sha256 of that file
SIZE_PX = 256  # the network's input, a square
MOST_STEP = 0.5  # of a square's side, between two squares that lie side by side over an image
MOST_LONG = 8.0  # times as long as wide: a longer strip shows nobody
OVERFLOW = 80.0  # exp of more is no float32
_F = np.float32


class PeopleNetwork:
    """The forward pass. Deterministic; asked from one thread at a time."""

    def __init__(self, path: Path = WEIGHTS) -> None:
        """Raises InputError where the weights are missing or not the ones that were shipped."""
        w, self._kept = _Weights(path), Kept()
        self._stem = w.dense(27, 16)
        self._blocks = (
            _Block(w, 16, 16, 16, size=3, stride=2, gate=8, activation=RELU),
            _Block(w, 16, 72, 24, size=3, stride=2, gate=0, activation=RELU),
            _Block(w, 24, 88, 24, size=3, stride=1, gate=0, activation=RELU),
            _Block(w, 24, 96, 32, size=5, stride=2, gate=24, activation=HARD_SWISH),
            _Block(w, 32, 128, 32, size=5, stride=1, gate=32, activation=HARD_SWISH),
            _Block(w, 32, 128, 32, size=5, stride=1, gate=32, activation=HARD_SWISH),
            _Block(w, 32, 96, 32, size=5, stride=1, gate=24, activation=HARD_SWISH),
            _Block(w, 32, 96, 32, size=5, stride=1, gate=24, activation=HARD_SWISH),
        )
        self._head, self._whole = w.dense(32, 128), w.dense(32, 128)
        self._decoders = (_Decoder(w, 128, 24), _Decoder(w, 24, 16), _Decoder(w, 16, 16))
        self._last = np.ascontiguousarray(w.take(4, 16).T), w.take(1)

    def __call__(self, image: Array) -> Array:
        """P(person) of an RGB image (h, w, 3) uint8: float32, the shorter side ``SIZE_PX``, of the same proportions.

        Squares that lie side by side over the image are asked, each half over the next, and their answers averaged:
        a picture that is pressed into one square, which shows people thinner, is answered worse. Strips longer than
        ``MOST_LONG`` times their width are not looked at: all 0, of one pixel.
        """
        tall = image.shape[0] > image.shape[1]
        if tall:
            image = image.transpose(1, 0, 2)
        short, long = image.shape[:2]
        if long > MOST_LONG * short:
            return np.zeros((1, 1), _F)
        width = round(SIZE_PX * long / short)
        squares = 1 + int(np.ceil((long / short - 1) / MOST_STEP))
        total, times = np.zeros((SIZE_PX, width), _F), np.zeros(width, _F)
        for n in range(squares):
            share = n / max(squares - 1, 1)
            left, at = round((long - short) * share), round((width - SIZE_PX) * share)
            square = image[:, left : left + short]
            found = self.square(square.transpose(1, 0, 2) if tall else square)
            total[:, at : at + SIZE_PX] += found.T if tall else found
            times[at : at + SIZE_PX] += 1
        total /= times
        return np.ascontiguousarray(total.T) if tall else total

    def square(self, image: Array) -> Array:
        """The same of one square image, (256, 256)."""
        small = cv2.resize(np.ascontiguousarray(image), (SIZE_PX, SIZE_PX), interpolation=cv2.INTER_AREA)
        return self.forward(small.astype(_F) / _F(255))

    def forward(self, x: Array) -> Array:
        """Of an input (h, w, 3) float32 in 0..1 of sides that 16 divides, (h, w) float32."""
        kept = self._kept
        kept.again()
        x = pointwise(kept, patches(kept, x), *self._stem, HARD_SWISH)
        skips: list[Array] = []
        for block in self._blocks:
            if block.stride == 2:
                skips.append(x)
            x = block(kept, x)
        weight, bias = self._whole
        whole = _sigmoid(x.mean((0, 1)) @ weight + bias)
        x = pointwise(kept, x, *self._head, RELU)
        x *= whole
        for decoder in self._decoders:
            x = decoder(kept, x, skips.pop())
        return _sigmoid(shuffled(x, *self._last))


class _Weights:
    """The file's numbers, taken one after the other in the order of the network's operators."""

    def __init__(self, path: Path) -> None:
        try:
            data = path.read_bytes()
        except OSError as e:
            raise InputError(f"{path}: expected the weights that come with the package, got {e.strerror}") from e
        if hashlib.sha256(data).hexdigest() != DIGEST:
            raise InputError(f"{path}: expected the weights that come with the package, got a file of other content")
        self._flat, self._at = np.load(path, allow_pickle=False), 0

    def take(self, *shape: int) -> Array:
        first, self._at = self._at, self._at + int(np.prod(shape))
        found: Array = self._flat[first : self._at].astype(_F).reshape(shape)
        return found

    def dense(self, c: int, d: int) -> tuple[Array, Array]:
        """(c, d) and (d,) of a 1 x 1 convolution."""
        return np.ascontiguousarray(self.take(d, c).T), self.take(d)

    def each(self, c: int, size: int) -> tuple[Array, Array]:
        """(size, size, c) and (c,) of one kernel a channel."""
        return self.take(size, size, c), self.take(c)


class _Gate:
    """Squeeze and excitation (Hu, Shen, Sun 2018): a factor (c,) a channel, from the means (c,) of all channels."""

    def __init__(self, w: _Weights, c: int, inside: int) -> None:
        self._narrow, self._wide = w.dense(c, inside), w.dense(inside, c)

    def __call__(self, means: Array) -> Array:
        inside = np.maximum(means @ self._narrow[0] + self._narrow[1], 0)
        return _sigmoid(inside @ self._wide[0] + self._wide[1])


class _Block:
    """Inverted residual block of MobileNetV3 (Howard et al. 2019)."""

    def __init__(
        self, w: _Weights, c: int, wide: int, d: int, *, size: int, stride: int, gate: int, activation: int
    ) -> None:
        self._expand, self._spread = w.dense(c, wide), w.each(wide, size)
        self._gate = _Gate(w, wide, gate) if gate else None
        self._project = w.dense(wide, d)
        self.stride, self._activation, self._residual = stride, activation, stride == 1 and c == d

    def __call__(self, kept: Kept, x: Array) -> Array:
        y = pointwise(kept, x, *self._expand, self._activation)
        y = depthwise(kept, y, *self._spread, self.stride, self._activation)
        if self._gate is not None:
            y *= self._gate(y.mean((0, 1)))
        y = pointwise(kept, y, *self._project, LINEAR)
        if self._residual:
            y += x
        return y


class _Decoder:
    """What is deeper at twice the size, joined with what was there at that size."""

    def __init__(self, w: _Weights, c: int, d: int) -> None:
        self._narrow, self._gate, self._mix, self._spread = w.dense(c, d), _Gate(w, d, d), w.dense(d, d), w.each(d, 3)

    def __call__(self, kept: Kept, x: Array, skip: Array) -> Array:
        up = twice(kept, pointwise(kept, x, *self._narrow, LINEAR))  # each is linear: the smaller image is convolved
        add_gated(up, skip, self._gate(channel_means(skip, up)))
        y = pointwise(kept, up, *self._mix, RELU)
        y += depthwise(kept, y, *self._spread, 1, RELU)
        return y


def _sigmoid(x: Array) -> Array:
    found: Array = 1 / (1 + np.exp(-np.clip(x, -OVERFLOW, OVERFLOW)))
    return found
