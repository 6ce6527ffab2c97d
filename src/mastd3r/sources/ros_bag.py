"""Images of a ROS bag (ROS 2: MCAP or SQLite; ROS 1), played at the pace of the recording; read by rosbags."""

from __future__ import annotations

import sqlite3
import struct
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from ..errors import InputError, MissingPackage
from ..reading.files import check_plain, entries_of, is_dir, is_file, short
from ..reading.pictures import check_pixels, decoded
from .bag_limits import bound_rosbags
from .camera import CameraFrame, CameraOptions
from .lost import changed
from .paced import paced

Array = NDArray[Any]
PACKAGE = "a ROS bag needs the package rosbags, 0.11.7 or newer: pip install 'mastd3r-slam[ros]'"
IMAGE, COMPRESSED = "sensor_msgs/msg/Image", "sensor_msgs/msg/CompressedImage"
MOST_SAID = 200  # characters of what rosbags says
SUFFIXES = (".mcap", ".db3", ".bag")
BAYER = {  # the mosaic by its first two pixels, as ROS names it: OpenCV's name is that of the second row
    "bayer_rggb8": cv2.COLOR_BayerBG2RGB, "bayer_bggr8": cv2.COLOR_BayerRG2RGB,
    "bayer_gbrg8": cv2.COLOR_BayerGR2RGB, "bayer_grbg8": cv2.COLOR_BayerGB2RGB,
}  # fmt: skip
CHANNELS = {"rgb8": 3, "bgr8": 3, "rgba8": 4, "bgra8": 4, "mono8": 1, "8UC1": 1, "8UC3": 3, **dict.fromkeys(BAYER, 1)}
TO_RGB = {
    "bgr8": cv2.COLOR_BGR2RGB, "8UC3": cv2.COLOR_BGR2RGB, "rgba8": cv2.COLOR_RGBA2RGB, "bgra8": cv2.COLOR_BGRA2RGB,
    "mono8": cv2.COLOR_GRAY2RGB, "8UC1": cv2.COLOR_GRAY2RGB, **BAYER,
}  # fmt: skip


def is_bag(path: Path) -> bool:
    """Whether a path is a bag: a file by its name, or a folder with rosbag2's metadata.yaml."""
    return path.suffix in SUFFIXES if is_file(path) else is_file(path / "metadata.yaml")


class RosBag:
    """The images of one topic of a bag, at the times of their headers."""

    kind, state = "bag", "open"
    timeout_s: float | None = None
    calibration: tuple[float, ...] = ()
    focal_hint_px: float | None = None

    def __init__(self, path: Path, options: CameraOptions) -> None:
        """Look for the topic, and read its first image. Raises InputError, MissingPackage."""
        try:
            bound_rosbags()
        except (ImportError, AttributeError) as e:
            raise MissingPackage(PACKAGE) from e
        for part in entries_of(path) if is_dir(path) else [path]:
            check_plain(part, "files of a ROS bag")  # a pipe among them would be waited for
        self.name, self._path, self._fps = path.stem, path, options.pace_fps
        self.said: list[str] = []
        self._topic: str | None = None
        self._topic = self._chosen(options.topic)
        self.notes = [f"topic {self._topic} of {path}"]
        first = next(self._images(), None)
        if first is None:
            raise InputError(f"{path}: expected images on {self._topic}, got none")
        height, width = first[1].shape[:2]
        self.size = (width, height)
        check_pixels(self.size, str(path))

    def frames(self) -> Iterator[CameraFrame]:
        """Frame after frame. Raises InputError for an image that cannot be read; one of another size ends it."""
        for frame in paced(self._images(), self._fps):
            if (frame.image.shape[1], frame.image.shape[0]) != self.size:
                self.said.append(changed(self.name, self.size, frame.image))
                return
            yield frame

    def close(self) -> None:
        """The reader ends with its iterator."""

    def _chosen(self, topic: str | None) -> str:
        with _opened(self._path) as reader:
            images = sorted({c.topic for c in reader.connections if c.msgtype in (IMAGE, COMPRESSED)})
        if topic is not None and topic not in images:
            raise InputError(f"--topic: expected one of the image topics {', '.join(images) or '(none)'}, got {topic}")
        if topic is None and len(images) != 1:
            got = f"{len(images)}: {', '.join(images)}; say which with --topic" if images else "none"
            raise InputError(f"{self._path}: expected one topic of sensor_msgs/Image or CompressedImage, got {got}")
        return topic or images[0]

    def _images(self) -> Iterator[tuple[float, Array]]:
        """(seconds since the first image, the image); messages that do not rise in time are passed over."""
        with _opened(self._path) as reader:
            wanted = [c for c in reader.connections if c.topic == self._topic]
            first_ns, last_ns = None, -1
            for connection, logged_ns, raw in reader.messages(connections=wanted):
                message = reader.deserialize(raw, connection.msgtype)
                stamp = message.header.stamp
                ns = stamp.sec * 10**9 + stamp.nanosec or logged_ns  # drivers without a clock write 0
                first_ns = ns if first_ns is None else first_ns
                if ns - first_ns <= last_ns:
                    continue
                last_ns = ns - first_ns
                yield last_ns * 1e-9, _picture(message, connection.msgtype, self._path)


@contextmanager
def _opened(path: Path) -> Iterator[Any]:
    """An open bag. Raises InputError for what rosbags, or the packages that it reads with, say of a damaged one."""
    from rosbags.highlevel import AnyReader
    from rosbags.typesys import Stores, get_typestore

    try:
        with AnyReader([path], default_typestore=get_typestore(Stores.ROS2_HUMBLE)) as reader:
            yield reader
    except _faults() as e:
        said = " ".join(str(e).split()) or type(e).__name__
        said = "a part that says it is larger than memory" if isinstance(e, MemoryError) else said
        raise InputError(f"{path}: expected a ROS bag, got {short(said, MOST_SAID)}") from e


def _faults() -> tuple[type[Exception], ...]:
    """What reading a damaged bag raises: rosbags' own errors have no common base, nor have those of its readers."""
    from rosbags import highlevel, rosbag1, rosbag2, serde, typesys

    own = (highlevel.AnyReaderError, rosbag1.ReaderError, rosbag2.ReaderError, serde.SerdeError, typesys.TypesysError)
    bases = (OSError, ValueError, LookupError, TypeError, AttributeError, ArithmeticError, AssertionError, RuntimeError)
    others = (("apsw", "Error"), ("backports.zstd", "ZstdError"), ("compression.zstd", "ZstdError"))
    found = [getattr(sys.modules[name], kind) for name, kind in others if name in sys.modules]
    return (*own, *bases, EOFError, MemoryError, struct.error, sqlite3.Error, *found)


def _picture(message: Any, kind: str, path: Path) -> Array:
    """(h, w, 3) uint8 RGB of an image message. Raises InputError."""
    if kind == COMPRESSED:
        image = decoded(np.asarray(message.data, np.uint8).tobytes(), path, cv2.IMREAD_COLOR)
        return np.asarray(cv2.cvtColor(image, cv2.COLOR_BGR2RGB))
    height, width, encoding = message.height, message.width, message.encoding
    channels = CHANNELS.get(encoding)
    held = len(message.data) if width * height else -1
    if channels is None or message.step < width * channels or held < height * message.step:
        raise InputError(
            f"{path}: expected an image of {', '.join(CHANNELS)}, got {encoding} of {width}x{height} in "
            f"{len(message.data)} bytes"
        )
    rows = np.asarray(message.data, np.uint8)[: height * message.step].reshape(height, message.step)
    pixels = np.ascontiguousarray(rows[:, : width * channels]).reshape(height, width, channels)
    if encoding == "rgb8":
        return pixels
    return np.asarray(cv2.cvtColor(pixels if channels > 1 else pixels[..., 0], TO_RGB[encoding]))
