"""Dense optical flow at half the working size, and its forward-backward check."""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

Array = NDArray[Any]


class HalfFlow:
    """DIS flow between two small grey images of one size; optionally started from a prediction."""

    def __init__(self, width: int, height: int) -> None:
        self._dis = cv2.DISOpticalFlow.create(cv2.DISOPTICAL_FLOW_PRESET_FAST)
        self._dis.setFinestScale(1)
        x, y = np.meshgrid(np.arange(width, dtype=np.float32), np.arange(height, dtype=np.float32))
        self.grid = np.stack([x, y], -1)

    def between(self, a: Array, b: Array, start: Array | None = None) -> Array:
        """(h, w, 2) float32 flow a -> b."""
        flow: Array = self._dis.calc(a, b, None if start is None else np.ascontiguousarray(start.astype(np.float32)))
        return flow

    def pull(self, value: Array, flow: Array, outside: float = 0.0) -> Array:
        """``value`` of the flow's target image seen from its origin; ``outside`` where the flow leaves it."""
        return cv2.remap(
            value,
            self.grid + flow,
            None,
            cv2.INTER_LINEAR,
            borderMode=cv2.BORDER_CONSTANT,
            borderValue=outside,
        )

    def warp(self, image: Array, target: Array) -> Array:
        """``image`` read at ``target`` (h, w, 2) pixels; the border is repeated."""
        return cv2.remap(image, target, None, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)

    def chain(self, ab: Array, bc: Array) -> Array:
        """Flow a -> c."""
        return ab + cv2.remap(bc, self.grid + ab, None, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)

    def round_trip_px(self, forward: Array, backward: Array) -> Array:
        """(h, w) length of forward + backward; large where either leaves the image or is occluded."""
        back = cv2.remap(
            backward,
            self.grid + forward,
            None,
            cv2.INTER_LINEAR,
            borderMode=cv2.BORDER_CONSTANT,
            borderValue=(1e3, 1e3),
        )
        return np.linalg.norm(forward + back, axis=-1)
