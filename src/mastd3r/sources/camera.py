"""What is read while it happens: a camera, a stream, a pipe, or a recording that is played at its own pace."""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

from numpy.typing import NDArray

from ..config import SourceConfig
from ..errors import ConfigError, InputError
from ..reading.files import exists, user_path
from ..registry import LARGEST, Range

Array = NDArray[Any]
URL = re.compile(r"[a-z][a-z0-9+.-]*://", re.IGNORECASE)
DEVICE = re.compile(r"[0-9]{1,4}|/dev/.+")
TIMEOUT_S = 10.0
WORDS = {"pace_fps": "pace", "reconnect_s": "reconnect", "timeout_s": "timeout", "pixel_format": "pixel-format"}
RANGES = {  # of the numbers below; what the default is may be said too
    "fps": Range(1e-3, 1e6),
    "pace_fps": Range(1e-3, 1e6),
    "timeout_s": Range(0, LARGEST, above=True),
    "reconnect_s": Range(0, LARGEST),
}
EXPECTED = "a camera's number, a device, a URL (rtsp, http, udp, ...), - for frames on standard input, a ROS bag"


@dataclass(frozen=True)
class CameraFrame:
    """An image that has just come."""

    timestamp_s: float  # ascending, microseconds at most: a recording of it says the same time
    image: Array  # (h, w, 3) uint8 RGB
    arrived_s: float  # on the clock of time.perf_counter


@dataclass(frozen=True)
class CameraOptions:
    """How a camera is read; what a kind of camera has no use for is refused where it is opened."""

    size: tuple[int, int] | None = None  # (width, height) of raw frames
    pixel_format: str | None = None  # of raw frames: bgr24, rgb24, gray8
    fps: float | None = None  # of raw frames: their times; None: when they come
    topic: str | None = None  # of a bag
    pace_fps: float | None = None  # of what is played: so many frames a second instead of its own times
    timeout_s: float = TIMEOUT_S  # without a frame, after which the camera is lost
    reconnect_s: float = 0.0  # for so long a lost stream or device is looked for again

    def __post_init__(self) -> None:
        """Raises ConfigError for a number out of its range."""
        for name, allowed in RANGES.items():
            if (value := getattr(self, name)) is not None:
                allowed.check(value, f"--{WORDS.get(name, name)}")


class Camera(Protocol):
    """Frames while they happen. ``frames`` is read once, in a thread of its own."""

    name: str
    kind: str  # device, stream, pipe, bag, or that of the source that is played
    size: tuple[int, int]  # (width, height) of every frame
    state: str  # "open", or "reconnecting" while a lost one is looked for
    said: list[str]  # what happened to it, a line each, in order; for people and for run.json
    notes: list[str]  # choices, for run.json
    timeout_s: float | None  # without a frame, after which it is lost; None: its pauses are its own
    calibration: tuple[float, ...]  # what it says of its lens, as --intrinsics; empty: nothing
    focal_hint_px: float | None  # the focal length that something (EXIF) speaks of

    def frames(self) -> Iterator[CameraFrame]:
        """Frame after frame. A camera that is lost ends it, and says so; other errors are InputErrors."""
        ...

    def close(self) -> None:
        """Give it back, from another thread than the one that reads."""
        ...


def open_camera(what: str | Path, options: CameraOptions, source: SourceConfig | None = None) -> Camera:
    """The camera that ``what`` names: see ``EXPECTED``; a video, folder or dataset is played at its own pace.

    ``source``: which frames of what is played. Raises InputError for one that is not there or gives nothing that can
    be read, ConfigError for an option that it has no use for, MissingPackage for a bag without rosbags.
    """
    words = str(what)
    if words == "-":
        from .raw_frames import standard_input

        _refuse(options, "frames on standard input", "topic", "pace_fps", "reconnect_s")
        return standard_input(options)
    _refuse(options, words, "size", "pixel_format", "fps")
    if DEVICE.fullmatch(words):
        from .device import DeviceCamera

        _refuse(options, words, "topic", "pace_fps")
        return DeviceCamera(words, options)
    if URL.match(words):
        from .stream import StreamCamera

        _refuse(options, words, "topic", "pace_fps")
        return StreamCamera(words, options)
    _refuse(options, words, "reconnect_s")
    path = user_path(words)
    if not exists(path):
        raise InputError(f"{words}: expected {EXPECTED}, or a video or folder to play, got no such path")
    from .ros_bag import RosBag, is_bag

    if is_bag(path):
        return RosBag(path, options)
    _refuse(options, words, "topic")
    from .open import open_source
    from .paced import PacedSource

    return PacedSource(open_source(path, source or SourceConfig(), want_semantic=False), options.pace_fps)


def _refuse(options: CameraOptions, what: str, *names: str) -> None:
    """Raise ConfigError for an option that this camera has no use for."""
    for name in names:
        if getattr(options, name) not in (None, 0.0):
            raise ConfigError(f"--{WORDS.get(name, name)}: expected a camera that it says something of, got {what}")


def microseconds(timestamp_s: float) -> float:
    """A time as files of a run write it, to be the same time when it is read again."""
    return round(timestamp_s, 6)
