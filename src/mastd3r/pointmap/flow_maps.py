"""Dense flow: read at another size, turned round, and chained. A flow is in pixels of its own size."""

from __future__ import annotations

from functools import lru_cache
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

Array = NDArray[Any]


@lru_cache(maxsize=8)
def pixel_grid(width: int, height: int) -> Array:
    """(h, w, 2) float32 places of the pixels; shared, not to be written to."""
    x, y = np.meshgrid(np.arange(width, dtype=np.float32), np.arange(height, dtype=np.float32))
    grid = np.stack([x, y], -1)
    grid.flags.writeable = False
    return grid


def pulled(image: Array, flow: Array) -> Array:
    """``image`` (h, w) or (h, w, 2) read where ``flow`` (h, w, 2) leads; the border is repeated."""
    grid = pixel_grid(flow.shape[1], flow.shape[0])
    return cv2.remap(image, grid + flow, None, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)


def resized_flow(flow: Array, width: int, height: int) -> Array:
    """(height, width, 2) the same flow between images of another size."""
    if flow.shape[:2] == (height, width):
        return flow
    ratio = width / flow.shape[1], height / flow.shape[0]
    resized = cv2.resize(flow, (width, height), interpolation=cv2.INTER_AREA if ratio[0] < 1 else cv2.INTER_LINEAR)
    resized *= np.array(ratio, np.float32)
    return resized


def invert_flow(flow: Array) -> Array:
    """Approximate flow new -> ref from flow ref -> new: one fixed-point step."""
    return -pulled(flow, -flow)


def chained_flow(first: Array, second: Array) -> Array:
    """Flow a -> c from a -> b and b -> c, at the size of the first."""
    return first + pulled(resized_flow(second, first.shape[1], first.shape[0]), first)
