"""Clean plates: each photograph with what moves replaced by the splat, as it stands behind."""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from ..camera.map_view import MapView
from ..export.read_run import Run
from .exported_view import MOVES_LEVEL, over_photograph
from .renders import gaussians_of, lens_of, median_depth_of

Array = NDArray[Any]
MARGIN_RATIO = 0.01  # of the image's width: what moves is replaced with so much around it
FEATHER_RATIO = 0.004  # of the image's width: sigma over which photograph and splat blend


class Plates:
    """Photographs of a run without what moves."""

    def __init__(self, run: Run) -> None:
        """Raises InputError for a run without a map."""
        from ..mapping.splat import NEAR_RATIO, Splat  # loads torch

        self._splat = Splat(gaussians_of(run), NEAR_RATIO * median_depth_of(run))
        lens = lens_of(run)
        self._view = MapView(lens, lens.width, 1.0)

    def plate(self, photograph: Array, levels: Array, world_from_cam: Array) -> Array:
        """(h, w, 3) uint8: the photograph where it stands still, the splat where ``levels`` (h', w') say it moves."""
        share = feathered(levels, (photograph.shape[1], photograph.shape[0]))
        if not share.any():
            return photograph
        color = self._splat.render(world_from_cam, self._view.pinhole)[0]
        splat = 255 * np.clip(self._view.as_photograph(color), 0, 1)
        return np.rint(photograph + share[..., None] * (splat - photograph)).astype(np.uint8)


def feathered(levels: Array, size: tuple[int, int]) -> Array:
    """(h, w) float32 share of the splat over an image of ``size`` (width, height); levels: P(moving), 255 = certain.

    1 wherever something moves with a probability above 1/4, falling to 0 around it.
    """
    width = size[0]
    moving = (over_photograph(levels, size) > MOVES_LEVEL).astype(np.float32)
    margin, sigma = max(1, round(MARGIN_RATIO * width)), max(0.5, FEATHER_RATIO * width)
    grown = cv2.dilate(moving, np.ones((2 * margin + 1, 2 * margin + 1), np.uint8))
    return np.maximum(moving, cv2.GaussianBlur(grown, (0, 0), sigma))
