"""Dense optical flow at half the working size."""

from __future__ import annotations

from threading import local
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

Array = NDArray[Any]


class HalfFlow:
    """DIS flow between two small grey images of one size."""

    def __init__(self, width: int, height: int) -> None:
        self._of_thread = local()
        x, y = np.meshgrid(np.arange(width, dtype=np.float32), np.arange(height, dtype=np.float32))
        self.grid = np.stack([x, y], -1)

    def _engines(self) -> tuple[Any, Any]:
        """Fine and quick, the calling thread's own: an engine has memory of its own and serves one call at a time."""
        if not hasattr(self._of_thread, "engines"):
            fine, quick = (cv2.DISOpticalFlow.create(cv2.DISOPTICAL_FLOW_PRESET_FAST) for _ in range(2))
            fine.setFinestScale(1)
            fine.setPatchSize(6)  # small patches: a moving thing's flow bleeds less over its edge
            fine.setPatchStride(4)
            fine.setGradientDescentIterations(10)
            fine.setVariationalRefinementIterations(3)
            quick.setFinestScale(2)
            self._of_thread.engines = fine, quick
        engines: tuple[Any, Any] = self._of_thread.engines
        return engines

    def between(self, a: Array, b: Array) -> Array:
        """(h, w, 2) float32 flow a -> b."""
        flow: Array = self._engines()[0].calc(a, b, None)
        return flow

    def quick(self, a: Array, b: Array) -> Array:
        """The same, coarser, at a quarter of the time: good for carrying and checking, not for evidence."""
        flow: Array = self._engines()[1].calc(a, b, None)
        return flow

    def warp(self, image: Array, target: Array) -> Array:
        """``image`` read at ``target`` (h, w, 2) pixels; the border is repeated."""
        return cv2.remap(image, target, None, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
