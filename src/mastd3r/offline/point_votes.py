"""Whether each keyframe point stands still, by all frames that saw it: pruned and restored by later evidence."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

Array = NDArray[Any]
OWN_WEIGHT = 2.0  # the keyframe's own mask counts as so many later frames
GREY_SIGMA = 12.0  # grey levels by which a point may differ between frames and still be the same point


class PointVotes:
    """P(moving) of keyframe points, a mean over the frames that see the point itself and nothing before it."""

    def __init__(self) -> None:
        self._sum: dict[int, Array] = {}
        self._weight: dict[int, Array] = {}
        self._grey: dict[int, Array] = {}

    def start(self, kf_id: int, moving: Array, colors: Array) -> None:
        """The first look: P(moving) (p,) and colours (p, 3) of a keyframe's points."""
        self._sum[kf_id] = OWN_WEIGHT * moving.astype(float)
        self._weight[kf_id] = np.full(len(moving), OWN_WEIGHT)
        self._grey[kf_id] = colors.astype(float).mean(1)

    def add(self, kf_id: int, moving: Array, colors: Array, inside: Array) -> None:
        """A later look. Where the colour is another one, something stands before the point: it has no say."""
        apart = (colors.astype(float).mean(1) - self._grey[kf_id]) / GREY_SIGMA
        weight = inside * np.exp(-0.5 * apart**2)
        self._sum[kf_id] += weight * moving
        self._weight[kf_id] += weight

    def moving(self) -> dict[int, Array]:
        """kf id -> (p,) P(moving)."""
        return {k: total / self._weight[k] for k, total in self._sum.items()}
