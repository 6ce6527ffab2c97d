"""The replaceable parts of a run, chosen by name; what was chosen automatically is said in ``notes``."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from .config import Config
from .errors import ConfigError, InputError
from .graph.places import PlaceIndex
from .pointmap.base import PointmapProvider
from .pointmap.features import FeatureStart
from .pointmap.geometric import GeometricPointmaps, SensorDepthPointmaps, working_size
from .types import Source

Array = NDArray[Any]


@dataclass
class Parts:
    """What the loop works with."""

    provider: PointmapProvider
    size: tuple[int, int]  # (width, height) of the working image
    features: FeatureStart = field(default_factory=FeatureStart)
    places: PlaceIndex = field(default_factory=PlaceIndex)
    notes: list[str] = field(default_factory=list)

    def __post_init__(self) -> None:
        width, height = self.size
        x, y = np.meshgrid(np.arange(width, dtype=np.float32), np.arange(height, dtype=np.float32))
        self.grid_px = np.stack([x, y], -1)


def build_parts(config: Config, source: Source) -> Parts:
    """Choose and build the parts. Raises ConfigError for a choice that this machine or source cannot serve."""
    width, height = working_size(*source.size, config.tracking.area_px)
    notes = []
    kind = config.pointmaps
    if kind == "auto":
        kind = "geometric"
        notes.append("pointmaps: geometric, chosen by auto (no MASt3R weights are installed)")
    if kind == "mast3r":
        raise ConfigError(
            "--pointmaps mast3r: expected MASt3R weights, which this version cannot load yet; use geometric or depth"
        )
    if kind == "depth" and not source.has_depth:
        raise InputError(f"--pointmaps depth: expected a TUM-layout folder with depth.txt, {source.name} has no depth")
    provider_class = SensorDepthPointmaps if kind == "depth" else GeometricPointmaps
    provider = provider_class(width, height, config.tracking.cell_px)
    notes.append(_semantics_note(config, source))
    return Parts(provider, (width, height), notes=notes)


def _semantics_note(config: Config, source: Source) -> str:
    if config.semantics == "dinov2":
        raise ConfigError(
            "--semantics dinov2: expected DINOv2 weights, which this version cannot load yet; use maps or none"
        )
    if config.semantics == "maps" and not source.has_semantic:
        raise InputError(f"--semantics maps: expected probability maps beside the frames, {source.name} has none")
    if config.semantics == "auto":
        chosen = "maps, chosen by auto (the source brings them)" if source.has_semantic else "none, chosen by auto"
        return f"semantics: {chosen}"
    return f"semantics: {config.semantics}"
