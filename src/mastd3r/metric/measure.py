"""``--scale`` from its words to the factor: files are read at once, the map is measured when there is one."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from .depth import SensorDepth, scale_from_depth, sensor_depth
from .estimate import Scale
from .ground import scale_from_height
from .material import Material
from .picked import scale_from_points
from .positions import Positions, read_positions, scale_from_positions
from .spec import Asked, parsed


@dataclass(frozen=True)
class Measure:
    """What the metres are taken from, read and checked."""

    asked: Asked
    read: SensorDepth | Positions | None = None

    @property
    def inputs(self) -> list[Path]:
        """The paths that are read."""
        return [] if self.asked.path is None else [self.asked.path]

    def of(self, map_: Material) -> Scale:
        """Metres a unit of this map. Raises InputError where what was asked for cannot be measured."""
        if isinstance(self.read, SensorDepth):
            return scale_from_depth(self.read, map_)
        if isinstance(self.read, Positions):
            return scale_from_positions(self.read, map_)
        if self.asked.kind == "points":
            return scale_from_points(self.asked, map_)
        assert self.asked.number is not None
        if self.asked.kind == "camera-height":
            return scale_from_height(self.asked.number, map_)
        return Scale(self.asked.number, None, 1, "factor that was given")


def measure(text: str) -> Measure | None:
    """What ``--scale`` asks for; None for no words. Raises ConfigError, and InputError for files that are wrong."""
    if not text:
        return None
    asked = parsed(text)
    if asked.kind == "depth" and asked.path is not None:
        return Measure(asked, sensor_depth(asked.path, asked.number))
    if asked.kind == "positions" and asked.path is not None:
        return Measure(asked, read_positions(asked.path))
    return Measure(asked)
