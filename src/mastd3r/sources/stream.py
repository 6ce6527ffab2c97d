"""A stream from the net, read by PyAV as it comes: RTSP, HTTP, UDP and whatever else FFmpeg opens by its URL."""

from __future__ import annotations

import time
from collections.abc import Iterator
from itertools import chain
from typing import Any

import av
import av.error
import numpy as np
from numpy.typing import NDArray

from ..errors import InputError
from ..reading.pictures import check_pixels
from .camera import CameraOptions
from .lost import Connection, Ended, Lost, Reconnecting

Array = NDArray[Any]
OPEN = {"flags": "low_delay", "probesize": "500000", "analyzeduration": "1000000"}
RTSP = {"rtsp_transport": "tcp"}  # UDP loses packets, which smears pictures
STATED = {"mp4", "matroska", "avi"}  # files that say how long they are; of others FFmpeg guesses it
TRIES = 100  # packets without a picture before a stream is none


class StreamCamera(Reconnecting):
    """One URL."""

    kind = "stream"

    def __init__(self, url: str, options: CameraOptions) -> None:
        """Open it, and decode a picture. Raises InputError."""
        self._url, self._timeout_s = url, options.timeout_s
        super().__init__(_without_password(url), options)

    def connect(self) -> Connection:
        """Open it anew."""
        return _Stream(self._url, _without_password(self._url), self._timeout_s)


class _Stream:
    """One connection."""

    def __init__(self, url: str, name: str, timeout_s: float) -> None:
        options = OPEN | (RTSP if url.lower().startswith("rtsp") else {})
        self._timeout_s = timeout_s
        try:
            self._container = av.open(url, options=options, timeout=(timeout_s, timeout_s))
        except (av.FFmpegError, OSError, ValueError) as e:
            raise InputError(f"{name}: expected a stream of pictures, got {_said(e, timeout_s)}") from e
        try:
            self._first = self._picture()
        except Lost as e:
            self._container.close()
            raise InputError(f"{name}: expected a stream of pictures, got {e}") from e
        image = self._first[2]
        self.size = (image.shape[1], image.shape[0])

    def pictures(self) -> Iterator[tuple[float | None, float, Array]]:
        """Picture after picture; packets that do not decode are passed over."""
        return chain([self._first], self._rest())

    def close(self) -> None:
        """Hang up."""
        self._container.close()

    def _picture(self) -> tuple[float | None, float, Array]:
        if not self._container.streams.video:
            raise Lost("one without pictures")
        self._stream = self._container.streams.video[0]
        self._stream.thread_type = "NONE"  # threads hold frames back
        return next(self._rest(TRIES))

    def _rest(self, tries: int | None = None) -> Iterator[tuple[float | None, float, Array]]:
        packets = self._container.demux(self._stream)
        broken = 0
        while tries is None or broken < tries:
            try:
                packet = next(packets)
            except StopIteration:
                break
            except (av.FFmpegError, OSError) as e:
                raise Lost(_said(e, self._timeout_s)) from e
            try:
                frames = packet.decode()
            except av.FFmpegError:
                frames = []
            broken = 0 if frames else broken + 1
            for frame in frames:
                if frame.is_corrupt:
                    continue
                now = time.perf_counter()
                own_s = None if frame.pts is None else float(frame.pts * frame.time_base)
                yield own_s, now, _rgb(frame)
        if tries is not None and broken >= tries:
            raise Lost("no picture that can be decoded")
        length = self._container.duration
        if length is not None and set(self._container.format.name.split(",")) & STATED:  # it would only begin anew
            raise Ended(f"the video of {length / av.time_base:.1f} s ended")
        raise Lost("the stream ended")


def _rgb(frame: Any) -> Array:
    """(h, w, 3) uint8. Raises Lost for what FFmpeg decodes, and does not convert, or is larger than is ever read."""
    try:
        check_pixels((frame.width, frame.height), "its pictures")
        return np.asarray(frame.to_ndarray(format="rgb24"))
    except (av.FFmpegError, ValueError) as e:
        raise Lost(f"pictures of {frame.format.name} that cannot be shown as RGB") from e
    except InputError as e:
        raise Lost(str(e)) from e


def _said(error: Exception, timeout_s: float) -> str:
    """What went wrong, in the words of people."""
    if isinstance(error, av.error.ExitError):  # how FFmpeg says that it was interrupted, which only the clock does
        return f"nothing for {timeout_s:g} s"
    said = getattr(error, "strerror", None) or str(error) or type(error).__name__
    return " ".join(str(said).split())


def _without_password(url: str) -> str:
    """The URL as run.json and the terminal may show it."""
    scheme, _, rest = url.partition("://")
    host, slash, path = rest.partition("/")
    return f"{scheme}://{host.rpartition('@')[2]}{slash}{path}"
