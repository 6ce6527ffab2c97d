"""What the stages of a run hand on to one another."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..camera.map_view import MapView
from ..camera.opencv_lens import OpenCvLens
from ..camera.pinhole import Camera
from ..camera.rectification import Rectifier
from ..config import Config
from ..graph.keyframe_graph import KeyframeGraph
from ..metric.measure import Measure
from ..parts import Parts
from ..types import Source, StaticCloud
from .smoothing import SmoothedMasks

Array = NDArray[Any]


@dataclass(frozen=True)
class MapMaterial:
    """What a map is made from."""

    cloud: StaticCloud
    seen: SmoothedMasks
    map_view: MapView


@dataclass(frozen=True)
class Tracked:
    """What tracking shares with what comes after it."""

    source: Source  # of photographs, as the camera took them
    config: Config
    graph: KeyframeGraph
    parts: Parts
    rectifier: Rectifier | None
    map_device: str
    scale: Measure | None = None  # what the metres are taken from

    def lens(self) -> Camera | OpenCvLens:
        """The lens over the photograph: the calibrated one where photographs are rectified."""
        if self.rectifier is not None:
            return self.rectifier.lens
        return self.graph.camera().resized(*self.source.size)

    def photograph_px(self, px: Array) -> Array:
        """(m, 2) pixels at working size as pixels of the photograph."""
        if self.rectifier is not None:
            return self.rectifier.lens.project(self.graph.camera().rays(px))
        return (px + 0.5) * np.array(self.source.size) / np.array(self.graph.size) - 0.5
