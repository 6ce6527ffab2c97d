"""A source whose photographs are made pinhole images before they are tracked."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator
from typing import Any

from numpy.typing import NDArray

from ..camera.rectification import Rectifier
from ..types import Frame, Source

Array = NDArray[Any]


class RectifiedSource:
    """A source whose frames are seen by the pinhole. Truth stays in the photograph's pixels."""

    def __init__(self, source: Source, rectifier: Rectifier) -> None:
        self._source, self._rectifier = source, rectifier
        self.name, self.kind, self.size, self.length = source.name, source.kind, rectifier.size, source.length
        self.notes = source.notes
        self.has_depth, self.has_semantic = source.has_depth, source.has_semantic
        self.calibration: tuple[float, ...] = ()  # that of the photographs is not that of these
        self.truth = source.truth

    def frames(self) -> Iterator[Frame]:
        """Frame after frame, rectified; errors are those of the source."""
        return (self._rectifier.frame(frame) for frame in self._source.frames())


def tracked_frames(photographs: Iterator[Frame], rectifier: Rectifier | None, untaken: deque[Frame]) -> Iterator[Frame]:
    """What tracking is shown of each photograph. The photographs go to ``untaken``, for the caller to take in order."""
    for photograph in photographs:
        untaken.append(photograph)
        yield photograph if rectifier is None else rectifier.frame(photograph)
