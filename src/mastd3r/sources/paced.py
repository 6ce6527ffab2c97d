"""A recording played as if it were a camera: each frame comes when its time has come."""

from __future__ import annotations

import time
from collections.abc import Iterator
from typing import Any

from numpy.typing import NDArray

from ..types import Source
from .camera import CameraFrame, microseconds

Array = NDArray[Any]
LONGEST_PAUSE_S = 5.0  # a recording that was paused, or whose clock jumped by years, does not hold up whoever plays it


def paced(items: Iterator[tuple[float, Array]], fps: float | None = None) -> Iterator[CameraFrame]:
    """(seconds, image) at the pace of their times, or ``fps`` a second; the next is made meanwhile.

    The clock starts with the first; where the next is due later than in ``LONGEST_PAUSE_S``, it comes then. A frame
    that is made too late comes late: it has arrived when it is there.
    """
    began = first_s = 0.0
    for n, (time_s, image) in enumerate(items):
        now = time.perf_counter()
        if n == 0:
            began, first_s = now, time_s
        due = began + (time_s - first_s if fps is None else n / fps)
        if due > now:
            began -= max(0.0, due - now - LONGEST_PAUSE_S)
            time.sleep(min(due - now, LONGEST_PAUSE_S))
        yield CameraFrame(microseconds(time_s), image, time.perf_counter())


class PacedSource:
    """A source of files as a camera."""

    timeout_s: float | None = None

    def __init__(self, source: Source, fps: float | None = None) -> None:
        """``fps``: so many frames a second, instead of at their own times, which stay what they are."""
        self._source, self._fps = source, fps
        self.name, self.kind, self.size = source.name, source.kind, source.size
        self.state, self.said, self.notes = "open", list[str](), source.notes
        self.calibration = source.calibration
        self.focal_hint_px: float | None = getattr(source, "focal_hint_px", None)

    def frames(self) -> Iterator[CameraFrame]:
        """Frame after frame. Raises InputError as the source does."""
        return paced(((f.timestamp_s, f.image) for f in self._source.frames()), self._fps)

    def close(self) -> None:
        """Nothing is held."""
