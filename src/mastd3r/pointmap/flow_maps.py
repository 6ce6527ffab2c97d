"""Dense flow put together: turned round, and chained."""

from __future__ import annotations

from typing import Any

import cv2
from numpy.typing import NDArray

Array = NDArray[Any]


def invert_flow(flow: Array, grid_px: Array) -> Array:
    """Approximate flow new -> ref from flow ref -> new: one fixed-point step."""
    return -cv2.remap(flow, grid_px - flow, None, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)


def chained_flow(first: Array, second: Array, grid_px: Array) -> Array:
    """Flow a -> c from a -> b and b -> c."""
    return first + cv2.remap(second, grid_px + first, None, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
