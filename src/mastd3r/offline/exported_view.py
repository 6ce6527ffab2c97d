"""The images, masks and pixels of an export: as the camera took them, or as a pinhole would have."""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from ..camera.opencv_lens import OpenCvLens
from ..camera.pinhole import Camera
from ..camera.rectification import Rectifier
from ..errors import ConfigError, InputError
from ..export.lens_models import distortion_of

Array = NDArray[Any]
MARGIN = np.ones((5, 5), np.uint8)  # masks grow by two of their pixels: the edge of a moving thing is not static
STATIC, IGNORED = 255, 0
MOVES_LEVEL = 255 / 4  # P(moving) from which a pixel is left out: what moves costs a map more than a static rim missing
KEEP = "use --no-undistort"


class ExportedView:
    """Photographs of one lens, undistorted where that is asked for, or where nothing is said and the lens is bent."""

    def __init__(self, lens: Camera | OpenCvLens, undistort: bool | None) -> None:
        """Raises InputError for a lens that leaves no upright pinhole image."""
        self._lens, self._rectifier = lens, None
        if lens.distorted and undistort is not False:
            self._rectifier = _rectifier_of(lens)

    @property
    def undistorts(self) -> bool:
        """False where images are the photographs themselves."""
        return self._rectifier is not None

    @property
    def lens(self) -> Camera | OpenCvLens:
        """The lens of the exported images."""
        return self._lens if self._rectifier is None else self._rectifier.pinhole

    def image(self, photograph: Array) -> Array:
        """(h, w, 3) uint8."""
        return photograph if self._rectifier is None else self._rectifier.image(photograph)

    def mask(self, levels: Array) -> Array:
        """(h, w) uint8, 255 = stands still, of P(moving) over the photograph (h', w'), 255 = certain.

        What moves with a probability above 1/4 is 0, with a margin of two pixels of ``levels``.
        """
        grown = over_photograph(cv2.dilate(levels, MARGIN), (self._lens.width, self._lens.height))
        seen = grown if self._rectifier is None else self._rectifier.semantic(grown)
        return np.where(seen > MOVES_LEVEL, IGNORED, STATIC).astype(np.uint8)

    def px(self, px: Array) -> Array:
        """(m, 2) pixels of the photograph as pixels of the image; an integer is a pixel centre in both."""
        if self._rectifier is None:
            return np.asarray(px, float)
        return self._rectifier.pinhole.project(self._rectifier.lens.rays(px))


def over_photograph(levels: Array, size: tuple[int, int]) -> Array:
    """(h, w) float32 of a mask's levels (h', w'), for a photograph of ``size`` (width, height)."""
    return np.asarray(cv2.resize(levels.astype(np.float32), size, interpolation=cv2.INTER_LINEAR))


def _rectifier_of(lens: Camera | OpenCvLens) -> Rectifier:
    c = lens
    bent = OpenCvLens(c.fx_px, c.fy_px, c.cx_px, c.cy_px, c.width, c.height, distortion_of(lens))
    if not bent.one_to_one():
        raise InputError(f"undistort: expected a lens that is one-to-one over the image, got one that folds; {KEEP}")
    try:
        return Rectifier(bent)
    except ConfigError as e:
        raise InputError(f"undistort: expected a lens that leaves an upright pinhole image, got none; {KEEP}") from e
