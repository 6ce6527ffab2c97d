"""Frames of a camera as a source: passing by, or kept."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import cv2
import numpy as np

from ..concurrency import Future, Worker
from ..config import SourceConfig
from ..errors import OutputError
from ..types import Frame, Truth
from .camera import Camera, CameraFrame
from .open import open_source

LIST, HELD = "rgb.txt", 30  # frames that may wait to be written


class MadeSource:
    """Frames of a size that nobody reads twice."""

    name = kind = "live"
    has_depth = has_semantic = False
    calibration: tuple[float, ...] = ()

    def __init__(self, size: tuple[int, int]) -> None:
        """``size`` (width, height)."""
        self.size, self.notes = size, list[str]()
        self.length: int | None = None

    def frames(self) -> Iterator[Frame]:
        """None: they have passed."""
        return iter(())

    def truth(self) -> Truth | None:
        """A camera knows nothing about itself."""
        return None


class PassingSource(MadeSource):
    """What a camera tells of itself, and no frame again: who needs them twice keeps them (``KeptSource``)."""

    def __init__(self, camera: Camera) -> None:
        super().__init__(camera.size)
        self.name, self.calibration, self.notes = camera.name, camera.calibration, camera.notes
        self.focal_hint_px, self.focal_source = camera.focal_hint_px, "what the camera says"


class KeptSource(PassingSource):
    """Every frame that comes kept as a PNG file with its time in rgb.txt: a TUM-layout folder that anybody can read.

    Written by a thread of its own. A disk that is slower than the camera holds the camera up, not this memory.
    """

    def __init__(self, camera: Camera) -> None:
        super().__init__(camera)
        self.folder: Path | None = None
        self._worker, self._late = Worker("recording"), deque[Future[None]]()
        self._closed = False

    def begin(self, folder: Path) -> None:
        """Keep them in a new folder. Raises OutputError."""
        self.folder = folder
        with _keeping(folder):
            folder.mkdir()
            (folder / LIST).write_text("# timestamp_s filename\n", encoding="utf-8")

    def keep(self, frame: CameraFrame) -> None:
        """Have one frame written, until ``close``. Raises OutputError where an earlier one could not be."""
        if self._closed:
            return
        self._late.append(self._worker.submit(lambda: self._write(frame)))
        while len(self._late) > HELD:
            self._late.popleft().get()

    def settle(self) -> None:
        """Wait for all of them; no more are kept. Raises OutputError."""
        self.close()
        while self._late:
            self._late.popleft().get()

    def close(self) -> None:
        """``settle``, whatever came of them."""
        self._closed = True
        self._worker.close()

    def frames(self) -> Iterator[Frame]:
        """All frames that were kept. Raises InputError where there are none."""
        assert self.folder is not None
        yield from open_source(self.folder, SourceConfig(), want_semantic=False).frames()

    def _write(self, frame: CameraFrame) -> None:
        assert self.folder is not None
        name = f"{frame.timestamp_s:.6f}.png"
        _, data = cv2.imencode(".png", np.ascontiguousarray(frame.image[..., ::-1]))
        with _keeping(self.folder):
            (self.folder / name).write_bytes(data.tobytes())
            with open(self.folder / LIST, "a", encoding="utf-8") as file:
                file.write(f"{frame.timestamp_s:.6f} {name}\n")


@contextmanager
def _keeping(folder: Path) -> Iterator[None]:
    try:
        yield
    except OSError as e:
        raise OutputError(f"{folder}: expected to keep frames there, got {e.strerror or e}") from e
