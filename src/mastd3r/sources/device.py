"""A camera of this machine, read by OpenCV (Video4Linux, AVFoundation, DirectShow): PyAV's wheels have no devices."""

from __future__ import annotations

import time
from collections.abc import Iterator
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from ..errors import InputError
from .camera import CameraOptions
from .lost import Connection, Lost, Reconnecting

Array = NDArray[Any]


class DeviceCamera(Reconnecting):
    """A camera by its number, or by the path of its device."""

    kind = "device"

    def __init__(self, device: str, options: CameraOptions) -> None:
        """Open it, and take a picture. Raises InputError."""
        self._device = device
        super().__init__(f"camera {device}", options)

    def connect(self) -> Connection:
        """Open it anew."""
        return _Device(self._device)


class _Device:
    """The camera, opened."""

    def __init__(self, device: str) -> None:
        said = cv2.utils.logging  # type: ignore[attr-defined]
        before = said.setLogLevel(said.LOG_LEVEL_SILENT)  # what is wrong is said by us, in one line
        try:
            self._capture = cv2.VideoCapture(int(device) if device.isdecimal() else device)
            there, image = self._capture.read() if self._capture.isOpened() else (False, None)
        except cv2.error as e:
            raise InputError(f"camera {device}: expected a camera, got what OpenCV does not open") from e
        finally:
            said.setLogLevel(before)
        if not there or image is None:
            self._capture.release()
            raise InputError(f"camera {device}: expected a camera that gives pictures, got none; is it there and free?")
        self._capture.set(cv2.CAP_PROP_BUFFERSIZE, 1)  # the newest picture, not the oldest that waits
        self.size = (image.shape[1], image.shape[0])

    def pictures(self) -> Iterator[tuple[float | None, float, Array]]:
        """Picture after picture, timed as they come."""
        while True:
            there, image = self._capture.read()
            if not there:
                raise Lost("it gives no more pictures")
            yield None, time.perf_counter(), np.asarray(cv2.cvtColor(image, cv2.COLOR_BGR2RGB))

    def close(self) -> None:
        """Give it back."""
        self._capture.release()
