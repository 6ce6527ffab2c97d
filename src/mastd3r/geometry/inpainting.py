"""Values on a grid where some are known and others are not: the one way in which gaps are filled."""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

Array = NDArray[Any]
SIGMAS = (8.0, 4.0, 2.0, 1.0)  # cells, widest first
ENOUGH = 0.15  # mean confidence around a cell from which a finer scale replaces the wider one


def inpainted_grid(values: Array, confidence: Array, everywhere: Array | float) -> Array:
    """``values`` (h, w) or (h, w, c) float32 by their ``confidence`` (h, w) float32 in 0…1, the rest from neighbours.

    Normalised convolution (Knutsson, Westin 1993), wide scales first; ``everywhere`` is what stands where no
    neighbour is known.
    """
    deep = values.ndim == 3
    own = confidence[..., None] if deep else confidence
    smooth = np.broadcast_to(np.asarray(everywhere, np.float32), values.shape)
    for sigma in SIGMAS:
        weight = cv2.GaussianBlur(confidence, (0, 0), sigma)
        weight = weight[..., None] if deep else weight
        value = cv2.GaussianBlur(own * values, (0, 0), sigma) / np.maximum(weight, 1e-9)
        share = np.minimum(weight / ENOUGH, 1.0)
        smooth = share * value + (1 - share) * smooth
    return np.asarray(own * values + (1 - own) * smooth)
