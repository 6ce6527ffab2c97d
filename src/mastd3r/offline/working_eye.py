"""How a saved map sees photographs, its own and those that are looked for in it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from ..camera.opencv_lens import OpenCvLens
from ..camera.pinhole import Camera
from ..camera.rectification import Rectifier
from ..config import Config
from ..pointmap.geometric import GeometricPointmaps, working_size
from ..types import Frame, WorkFrame

Array = NDArray[Any]


@dataclass(frozen=True)
class Look:
    """A photograph at working size, as it is matched and in colour."""

    work: WorkFrame
    small: Array  # (h, w, 3) uint8 RGB


class WorkingEye:
    """How a map sees photographs of its lens: at working size, rectified where the lens is more than radial.

    Always as the geometric provider does, whichever pointmaps the run had.
    """

    def __init__(self, lens: Camera | OpenCvLens, config: Config) -> None:
        """``lens`` over the photographs."""
        self.lens = lens
        self.rectifier = Rectifier(lens) if isinstance(lens, OpenCvLens) else None
        seen = (lens.width, lens.height) if self.rectifier is None else self.rectifier.size
        size = working_size(*seen, config.tracking.area_px)
        self.provider = GeometricPointmaps(*size, config.tracking.cell_px)
        pinhole = lens if self.rectifier is None else self.rectifier.pinhole
        assert isinstance(pinhole, Camera)
        self.camera = pinhole.resized(*size)  # of working images

    @property
    def grid(self) -> tuple[int, int]:
        """(rows, cols) of cells of a working image."""
        return grid_of(self.provider)

    def look(self, index: int, timestamp_s: float, image: Array) -> Look:
        """A photograph (h, w, 3) uint8 RGB of the lens's size."""
        seen = image if self.rectifier is None else self.rectifier.image(image)
        small = cv2.resize(seen, self.provider.size, interpolation=cv2.INTER_AREA)
        return Look(self.provider.look(Frame(index, timestamp_s, seen)), small)

    def moving(self, mask: Array) -> Array:
        """(h, w) uint8 at working size of a mask over the photograph, of any size."""
        seen = mask if self.rectifier is None else self.rectifier.semantic(mask.astype(np.float32))
        return np.rint(cv2.resize(seen.astype(np.float32), self.provider.size)).astype(np.uint8)

    def working_px(self, px: Array) -> Array:
        """(m, 2) pixels of the photograph at working size."""
        if self.rectifier is not None:
            return self.camera.project(self.rectifier.lens.rays(px))
        scale = np.array(self.provider.size) / np.array([self.lens.width, self.lens.height])
        return (px + 0.5) * scale - 0.5


def grid_of(provider: GeometricPointmaps) -> tuple[int, int]:
    """(rows, cols) of cells of a provider's working images."""
    width, height = provider.size
    return height // provider.cell_px, width // provider.cell_px


def one_a_cell(px: Array, work: WorkFrame, cell_px: int) -> tuple[Array, Array]:
    """Cells of an image in which there are pixels of ``px`` (m, 2), and the row of the one nearest to its own pixel."""
    rows, cols = work.grid
    at = np.floor((np.clip(px, -1e6, 1e6) + 0.5) / cell_px).astype(int)
    inside = np.flatnonzero((at >= 0).all(1) & (at < [cols, rows]).all(1))
    cell = at[inside, 1] * cols + at[inside, 0]
    order = np.argsort(np.linalg.norm(px[inside] - work.px[cell], axis=1), kind="stable")
    cells, first = np.unique(cell[order], return_index=True)
    return cells, inside[order[first]]
