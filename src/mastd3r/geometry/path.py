"""A camera path that is smooth in time."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from .se3 import nearest_rotation

Array = NDArray[Any]


def smoothed_path(times_s: Array, world_from_cam: Array, at_s: Array, sigma_s: float) -> Array:
    """Poses (m, 4, 4) at ``at_s``: means of the given ones under a Gaussian window in time.

    Positions are averaged as they are, rotations by their chordal mean (the rotation nearest to the mean matrix).
    times_s (n,) ascending; world_from_cam (n, 4, 4), finite. Where no pose is within reach the nearest counts alone.
    """
    out = np.tile(np.eye(4), (len(at_s), 1, 1))
    for m, t in enumerate(at_s):
        apart = np.abs(times_s - t)
        weight = np.exp(-0.5 * ((apart**2 - apart.min() ** 2) / sigma_s**2))
        weight /= weight.sum()
        mean = np.einsum("n,nij->ij", weight, world_from_cam)
        out[m, :3, :3], out[m, :3, 3] = nearest_rotation(mean[:3, :3]), mean[:3, 3]
    return out
