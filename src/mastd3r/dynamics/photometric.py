"""What grey values of two aligned images may differ by (III-A, our term b)."""

from __future__ import annotations

from typing import Any

from numpy.typing import NDArray

from .config import DynamicsConfig

Array = NDArray[Any]


def photo_variance(information: tuple[Array, Array, Array], config: DynamicsConfig) -> Array:
    """(h, w) variance of a grey difference: sensor noise, and the texture times a small misalignment."""
    c = config.photometric
    per_px = config.motion.texture_noise**2 / 49
    gradient = (information[0] + information[2]) * per_px
    return c.noise**2 + c.shift_px**2 * gradient
