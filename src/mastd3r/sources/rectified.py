"""Photographs of a calibrated lens as pinhole images, before they are tracked; each keeps the one it was made of."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

from ..camera.rectification import Rectifier
from ..types import Frame, Source


def rectified(photograph: Frame, rectifier: Rectifier) -> Frame:
    """A photograph with all it carries, seen by the pinhole; it stands in ``Frame.photograph``."""
    depth_m, semantic = photograph.depth_m, photograph.semantic
    return replace(
        photograph,
        image=rectifier.image(photograph.image),
        depth_m=None if depth_m is None else rectifier.depth(depth_m),
        semantic=None if semantic is None else rectifier.semantic(semantic),
        photograph=photograph,
    )


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
        return (rectified(frame, self._rectifier) for frame in self._source.frames())
