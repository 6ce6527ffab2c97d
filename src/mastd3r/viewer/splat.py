"""Gaussians as viser takes them: centres, covariances, colours, opacities."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..geometry.quaternion import rotation_from_quaternion
from ..mapping.gaussian_arrays import GaussianArrays

Array = NDArray[Any]
HALF_FLOAT_USED = 60000.0  # viser sends covariances as half floats, whose largest is 65504


@dataclass(frozen=True)
class SplatBuffers:
    """What ``add_gaussian_splats`` takes. All lengths are multiplied by 1 / ``scale``, which the node takes back."""

    centers: Array  # (n, 3) float32
    covariances: Array  # (n, 3, 3) float32
    colours: Array  # (n, 3) uint8 RGB
    opacities: Array  # (n, 1) uint8
    scale: float
    left_out: int  # Gaussians that are not finite


def splat_buffers(gaussians: GaussianArrays) -> SplatBuffers:
    """The mean colour over all directions: viser knows no spherical harmonics.

    Covariances of lengths below 0.01 would lose their digits in half floats, so the largest is brought to the end of
    their range.
    """
    parts = (gaussians.means, gaussians.scales, gaussians.quats, gaussians.opacities[:, None], gaussians.colors)
    finite = np.isfinite(np.concatenate(parts, 1)).all(1) & (np.linalg.norm(gaussians.quats, axis=1) > 0)
    means, scales, quats, opacities, colors = (part[finite].astype(np.float64) for part in parts)
    largest = float(scales.max()) if len(scales) else 1.0
    factor = float(np.sqrt(HALF_FLOAT_USED)) / largest if largest > 0 else 1.0
    axes = rotation_from_quaternion(quats) * (factor * scales)[:, None, :]
    return SplatBuffers(
        centers=(factor * means).astype(np.float32),
        covariances=(axes @ axes.transpose(0, 2, 1)).astype(np.float32),
        colours=np.rint(255 * colors.clip(0, 1)).astype(np.uint8),
        opacities=np.rint(255 * opacities.clip(0, 1)).astype(np.uint8),
        scale=1 / factor,
        left_out=int((~finite).sum()),
    )
