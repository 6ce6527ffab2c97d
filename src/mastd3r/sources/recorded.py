"""Frames that were handed in one by one, kept on disk so that they can be read once more after the last one."""

from __future__ import annotations

import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..errors import InputError, OutputError
from ..types import Frame, Truth

Array = NDArray[Any]


class RecordedSource:
    """A source of frames that are added while it is tracked: exact pixels, in a temporary folder of its own."""

    kind = "live"
    calibration: tuple[float, ...] = ()

    def __init__(self, size: tuple[int, int], *, has_depth: bool = False, has_semantic: bool = False) -> None:
        """``size`` (width, height) of every frame; whether frames may carry depth and semantic maps."""
        self.name, self.size, self.has_depth, self.has_semantic = "live", size, has_depth, has_semantic
        self.notes: list[str] = []
        self.length: int | None = 0
        self._last_s = -np.inf
        self._folder: tempfile.TemporaryDirectory[str] | None = None

    def frame(self, image: Array, timestamp_s: float, depth_m: Array | None, semantic: Array | None) -> Frame:
        """The next frame, checked and kept. Raises InputError for what no camera of this size could give.

        image (h, w, 3) uint8 RGB; depth_m (h, w) metres, 0 = none; semantic (h', w') P(movable) in 0..1.
        """
        index = self.length or 0
        where = f"frame {index}"
        width, height = self.size
        got = f"{getattr(image, 'dtype', type(image).__name__)} {getattr(image, 'shape', '')}".strip()
        if getattr(image, "dtype", None) != np.uint8 or getattr(image, "shape", None) != (height, width, 3):
            raise InputError(f"{where}: expected an image (h, w, 3) = ({height}, {width}, 3) of uint8 RGB, got {got}")
        if not np.isfinite(timestamp_s) or not timestamp_s > self._last_s:
            after = "" if index == 0 else f" after {self._last_s:.6f} s"
            raise InputError(f"{where}: expected a finite time in seconds{after}, got {timestamp_s}")
        if depth_m is not None and (not self.has_depth or np.shape(depth_m) != (height, width)):
            expected = f"depth of ({height}, {width})" if self.has_depth else "no depth without pointmaps=depth"
            raise InputError(f"{where}: expected {expected}, got {np.shape(depth_m)}")
        if semantic is not None and (np.ndim(semantic) != 2 or not self.has_semantic):
            expected = "a map (h, w) of P(movable)" if self.has_semantic else "no map without semantics=maps"
            raise InputError(f"{where}: expected {expected}, got {np.shape(semantic)}")
        frame = Frame(
            index,
            float(timestamp_s),
            image.copy(),
            None if depth_m is None else np.asarray(depth_m, np.float32),
            None if semantic is None else np.asarray(semantic, np.float32),
        )
        self._keep(frame)
        self._last_s, self.length = float(timestamp_s), index + 1
        return frame

    def frames(self) -> Iterator[Frame]:
        """All frames that were added so far."""
        for index in range(self.length or 0):
            with np.load(self._path(index), allow_pickle=False) as kept:
                depth, semantic = (kept.get(k) for k in ("depth_m", "semantic"))
                yield Frame(index, float(kept["timestamp_s"]), kept["image"], depth, semantic)

    def truth(self) -> Truth | None:
        """Nobody knows."""
        return None

    def close(self) -> None:
        """Remove what was kept."""
        if self._folder is not None:
            self._folder.cleanup()
            self._folder = None

    def _path(self, index: int) -> Path:
        if self._folder is None:
            self._folder = tempfile.TemporaryDirectory(prefix="mastd3r-frames-")
        return Path(self._folder.name) / f"{index:06d}.npz"

    def _keep(self, frame: Frame) -> None:
        parts = {"image": frame.image, "depth_m": frame.depth_m, "semantic": frame.semantic}
        known: dict[str, Any] = {k: v for k, v in parts.items() if v is not None}
        try:
            np.savez(self._path(frame.index), timestamp_s=np.float64(frame.timestamp_s), **known)
        except OSError as e:
            raise OutputError(f"frame {frame.index}: expected to keep it for the end, got {e.strerror or e}") from e
