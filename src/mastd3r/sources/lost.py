"""Cameras that can be lost and found again: one loop for devices and streams."""

from __future__ import annotations

import threading
import time
from collections.abc import Iterator
from typing import Any, Protocol

from numpy.typing import NDArray

from ..errors import InputError
from ..reading.pictures import check_pixels
from .camera import CameraFrame, CameraOptions, microseconds

Array = NDArray[Any]
RETRY_S = 0.5
STALE_S = 1.0  # a connection that nobody has read for so long holds old pictures


class Connection(Protocol):
    """One connection to a camera, from its opening to its loss."""

    size: tuple[int, int]  # (width, height) as it says

    def pictures(self) -> Iterator[tuple[float | None, float, Array]]:
        """(its own seconds or None, when it came on perf_counter, (h, w, 3) uint8 RGB); raises Lost when it ends."""
        ...

    def close(self) -> None: ...


class Lost(Exception):
    """The camera gives no more; the text says why."""


class Ended(Lost):
    """It has given all that it had: nothing is looked for again."""


class Reconnecting:
    """A camera that is looked for again, for some seconds, when it is lost; ``connect`` is what a kind adds.

    Its times are those of its own clock since the first frame of a connection, which comes as late after the first
    frame of all as it did here. A frame of another size ends it: a new lens, which one map cannot have.
    """

    calibration: tuple[float, ...] = ()
    focal_hint_px: float | None = None
    kind = ""

    def __init__(self, name: str, options: CameraOptions) -> None:
        """Connect. Raises InputError where nothing is there."""
        self.name, self.said, self.notes, self.state = name, list[str](), list[str](), "open"
        self.timeout_s: float | None = options.timeout_s
        self._reconnect_s = options.reconnect_s
        self._closed = threading.Event()
        self._connection: Connection | None = self.connect()
        self.size = self._connection.size
        check_pixels(self.size, self.name)
        self._opened = time.monotonic()

    def connect(self) -> Connection:
        """A new connection. Raises InputError."""
        raise NotImplementedError

    def frames(self) -> Iterator[CameraFrame]:
        """Frame after frame, over all connections."""
        self._renew_if_stale()
        first: float | None = None
        last_s = -1.0
        while self._connection is not None:
            own_first_s: float | None = None
            since_s = 0.0
            try:
                for own_s, arrived, image in self._connection.pictures():
                    if self._closed.is_set():
                        return
                    if (image.shape[1], image.shape[0]) != self.size:
                        self.said.append(changed(self.name, self.size, image))
                        return
                    first = arrived if first is None else first
                    if own_s is not None and own_first_s is None:
                        own_first_s, since_s = own_s, arrived - first
                    time_s = arrived - first
                    if own_s is not None and own_first_s is not None:
                        time_s = since_s + own_s - own_first_s
                    time_s = microseconds(time_s)
                    if time_s <= last_s:  # a clock that jumps back: that of this machine goes on
                        time_s = microseconds(max(arrived - first, last_s + 1e-6))
                        own_first_s, since_s = own_s, time_s
                    last_s = time_s
                    yield CameraFrame(time_s, image, arrived)
                why = "it ended"
            except Ended as e:
                self.said.append(f"{self.name}: {e}")
                return
            except Lost as e:
                why = str(e)
            finally:
                if self._connection is not None:
                    self._connection.close()
            self._connection = self._found_again(why)

    def close(self) -> None:
        """End it at its next frame, or at once where it is looked for."""
        self._closed.set()

    def _renew_if_stale(self) -> None:
        """Another connection where this one has waited; a device, which gives no second one, has short buffers."""
        if self._connection is None or time.monotonic() - self._opened < STALE_S:
            return
        try:
            newer = self.connect()
        except InputError:
            return
        self._connection.close()
        self._connection = newer

    def _found_again(self, why: str) -> Connection | None:
        """A new connection, if there is one within the time for it."""
        if self._closed.is_set():
            return None
        began = time.monotonic()
        if self._reconnect_s <= 0:
            self.said.append(f"{self.name}: {why}")
            return None
        self.state = "reconnecting"
        self.said.append(f"{self.name}: {why}; looked for again for {self._reconnect_s:g} s")
        while time.monotonic() - began < self._reconnect_s and not self._closed.wait(RETRY_S):
            try:
                found = self.connect()
            except InputError:
                continue
            self.said.append(f"{self.name}: found again after {time.monotonic() - began:.1f} s")
            self.state = "open"
            return found
        self.state = "open"
        if not self._closed.is_set():
            self.said.append(f"{self.name}: not found again within {self._reconnect_s:g} s")
        return None


def changed(name: str, size: tuple[int, int], image: Array) -> str:
    """What is said of a camera of ``size`` (width, height) that gives ``image`` (h, w, 3)."""
    height, width = image.shape[:2]
    return f"{name}: frames changed from {size[0]}x{size[1]} to {width}x{height}: another lens needs another run"
