"""masks.mp4: P(moving) over the frames, as a video."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from fractions import Fraction
from pathlib import Path
from typing import Any

import av
import av.error
import numpy as np
from numpy.typing import NDArray

from ..errors import OutputError
from .files import writing
from .pictures import mask_overlay

Array = NDArray[Any]
TICKS_PER_S = 90_000
CODECS = ("libx264", "mpeg4")  # the second is in every build of FFmpeg


class MaskVideo:
    """Written frame by frame, at the frames' own times. Raises OutputError where the file cannot be written."""

    def __init__(self, path: Path, width: int, height: int) -> None:
        self.path = path
        self._size = (width - width % 2, height - height % 2)  # H.264 wants even sides
        self.codec = next(c for c in CODECS if c in av.codecs_available)
        self._first_s: float | None = None
        self._last_tick = -1
        with self._writing():
            self._container = av.open(str(path), "w")
            self._stream: Any = self._container.add_stream(self.codec, rate=30)
            self._stream.width, self._stream.height = self._size
            self._stream.pix_fmt = "yuv420p"
            self._stream.time_base = self._stream.codec_context.time_base = Fraction(1, TICKS_PER_S)
            if self.codec == "libx264":
                self._stream.options = {"crf": "24", "preset": "veryfast"}
            else:
                self._stream.bit_rate = 4_000_000

    def add(self, timestamp_s: float, image: Array, probability: Array) -> None:
        """One frame: (h, w, 3) uint8 RGB, and P(moving) (h, w) in 0..1."""
        width, height = self._size
        levels = np.rint(np.clip(probability, 0, 1) * 255).astype(np.uint8)
        picture = mask_overlay(image, levels)[:height, :width]
        self._first_s = timestamp_s if self._first_s is None else self._first_s
        tick = max(round((timestamp_s - self._first_s) * TICKS_PER_S), self._last_tick + 1)
        self._last_tick = tick
        frame = av.VideoFrame.from_ndarray(np.ascontiguousarray(picture), format="rgb24")
        frame.pts, frame.time_base = tick, Fraction(1, TICKS_PER_S)
        with self._writing():
            self._container.mux(self._stream.encode(frame))

    def close(self) -> None:
        """Write what is left. A video without frames is removed."""
        with self._writing():
            if self._first_s is not None:
                self._container.mux(self._stream.encode(None))
            self._container.close()
            if self._first_s is None:
                self.path.unlink(missing_ok=True)

    @contextmanager
    def _writing(self) -> Iterator[None]:
        try:
            with writing(self.path):
                yield
        except av.error.FFmpegError as e:  # those of the system are OSErrors too
            raise OutputError(f"{self.path}: expected to write a video, got {' '.join(str(e).split())}") from e
