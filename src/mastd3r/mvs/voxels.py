"""One point a voxel."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

Array = NDArray[Any]


def surest_of_voxels(points: Array, confidence: Array, spacing: float) -> Array:
    """Ascending rows of the surest of the points (n, 3) in every voxel ``spacing`` wide, the first of equals."""
    cell = np.floor(points / spacing).astype(np.int64)
    order = np.lexsort((-confidence, *cell.T))
    fresh = np.ones(len(order), bool)
    fresh[1:] = (np.diff(cell[order], axis=0) != 0).any(1)
    return np.sort(order[fresh])
