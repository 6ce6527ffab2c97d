"""Frames of a camera as a source: passing by, or kept as they were tracked."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import cv2
import numpy as np

from ..config import SourceConfig
from ..errors import OutputError
from ..types import Frame, Truth
from .camera import Camera
from .open import open_source

LIST = "rgb.txt"


class PassingSource:
    """What a camera tells of itself, and no frame again: who needs them twice keeps them (``KeptSource``)."""

    kind = "live"
    has_depth = has_semantic = False

    def __init__(self, camera: Camera) -> None:
        self.name, self.size, self.calibration = camera.name, camera.size, camera.calibration
        self.length: int | None = None
        self.focal_hint_px, self.focal_source = camera.focal_hint_px, "what the camera says"
        self.notes = camera.notes

    def frames(self) -> Iterator[Frame]:
        """None: they have passed."""
        return iter(())

    def truth(self) -> Truth | None:
        """A camera knows nothing about itself."""
        return None


class KeptSource(PassingSource):
    """Frames kept as PNG files with their times in rgb.txt: exact pixels, a TUM-layout folder that anybody can read.

    ``keep`` may be called from another thread; what it has returned from is whole, whatever happens afterwards.
    """

    def begin(self, folder: Path) -> None:
        """Keep them in a new folder. Raises OutputError."""
        self.folder = folder
        try:
            folder.mkdir()
            (folder / LIST).write_text("# timestamp_s filename\n", encoding="utf-8")
        except OSError as e:
            raise OutputError(f"{folder}: expected to keep frames there, got {e.strerror or e}") from e

    def keep(self, frame: Frame) -> None:
        """Write one frame. Raises OutputError."""
        name = f"{frame.timestamp_s:.6f}.png"
        try:
            done, data = cv2.imencode(".png", np.ascontiguousarray(frame.as_taken.image[..., ::-1]))
            if not done:
                raise OSError("an image that PNG cannot hold")
            (self.folder / name).write_bytes(data.tobytes())
            with open(self.folder / LIST, "a", encoding="utf-8") as file:
                file.write(f"{frame.timestamp_s:.6f} {name}\n")
        except OSError as e:
            raise OutputError(f"{self.folder}: expected to keep frame {frame.index}, got {e.strerror or e}") from e

    def frames(self) -> Iterator[Frame]:
        """All frames that were kept. Raises InputError where there are none."""
        yield from open_source(self.folder, SourceConfig(), want_semantic=False).frames()
