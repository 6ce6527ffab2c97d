"""The Gaussian map in plain numbers, as files hold it; needs no torch, which takes seconds to load."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

Array = NDArray[Any]


@dataclass(frozen=True)
class GaussianArrays:
    """The map for export, in plain numbers."""

    means: Array  # (n, 3) float32, world
    scales: Array  # (n, 3) float32, standard deviations, in the unit of means
    quats: Array  # (n, 4) float32 wxyz, unit length
    opacities: Array  # (n,) float32 0..1
    colors: Array  # (n, 3) float32 RGB, 0..1
    kf_id: Array  # (n,) int32
    sh_rest: Array  # (n, K - 1, 3) float32, spherical harmonics above the constant one; K = 1, 4, 9 or 16

    def in_lengths(self, factor: float) -> GaussianArrays:
        """The same with lengths times ``factor``; what is seen from cameras that are moved alike stays as it is."""
        means, scales = self.means * np.float32(factor), self.scales * np.float32(factor)
        return replace(self, means=means, scales=scales)


def of_degree(gaussians: GaussianArrays, degree: int) -> GaussianArrays:
    """The same with harmonics up to ``degree``, those that are new at zero."""
    new = (degree + 1) ** 2 - 1 - gaussians.sh_rest.shape[1]
    return replace(gaussians, sh_rest=np.pad(gaussians.sh_rest, ((0, 0), (0, max(0, new)), (0, 0))))
