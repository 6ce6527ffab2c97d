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
from ..mapping.gaussian_arrays import GaussianArrays
from ..metric.measure import Measure
from ..parts import Parts
from ..types import Source, StaticCloud
from .extended_map import ExtendedMap, in_view
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
    extends: ExtendedMap | None = None  # the saved map that the video goes on in

    @property
    def lens_is_given(self) -> bool:
        """By the options, or by a saved map."""
        return bool(self.config.camera.intrinsics) or self.extends is not None

    def whole_cloud(self, cloud: StaticCloud) -> StaticCloud:
        """The static cloud with the points of the map that the video goes on in."""
        return cloud if self.extends is None else self.extends.with_points(cloud, self.graph)

    def seeds(self, material: MapMaterial) -> StaticCloud:
        """The points that a splat starts from: what no view shows cannot be trained."""
        return material.cloud if self.extends is None else in_view(material.cloud, material.seen.views)

    def splat_before(self) -> GaussianArrays | None:
        """That of the map that the video goes on in."""
        return None if self.extends is None else self.extends.splat(self.graph)

    def continues(self) -> dict[str, Any] | None:
        """For run.json: that map, and what of the video was found in it."""
        return None if self.extends is None else self.extends.facts(self.graph)

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
