"""Frames without a container on standard input: raw pixels, or y4m, which says itself what it is."""

from __future__ import annotations

import io
import sys
import time
from collections.abc import Callable, Iterator
from fractions import Fraction
from typing import Any, BinaryIO

import cv2
import numpy as np
from numpy.typing import NDArray

from ..errors import ConfigError, InputError
from ..reading.pictures import check_pixels
from .camera import CameraFrame, CameraOptions, microseconds

Array = NDArray[Any]
FORMATS = {"bgr24": 3, "rgb24": 3, "gray8": 1}  # bytes a pixel
Y4M, LONGEST_HEAD = b"YUV4MPEG2 ", 512
PLANAR = ("420", "420jpeg", "420mpeg2", "420paldv", "mono")
LARGEST_SIDE_PX = 16384
Pipe = BinaryIO | io.RawIOBase


class RawFrames:
    """A pipe that gives frame after frame of one size."""

    kind, state = "pipe", "open"
    calibration: tuple[float, ...] = ()
    focal_hint_px: float | None = None

    def __init__(
        self,
        pipe: Pipe,
        size: tuple[int, int],
        frame_bytes: int,
        picture: Callable[[Array], Array],
        options: CameraOptions,
        *,
        fps: float | None = None,
        marked: bool = False,
        name: str = "-",
    ) -> None:
        """``picture`` makes (h, w, 3) uint8 RGB of (frame_bytes,) uint8; ``fps``: frames have times of their own.

        ``marked``: a line goes before each frame. Raises InputError for more pixels than are ever read.
        """
        check_pixels(size, name)
        self.name, self.size, self.said, self.notes = name, size, list[str](), list[str]()
        self.timeout_s: float | None = options.timeout_s
        self._pipe, self._bytes, self._picture, self._fps, self._marked = pipe, frame_bytes, picture, fps, marked

    def frames(self) -> Iterator[CameraFrame]:
        """Frame after frame; a last one that is not whole is left out, and said. Raises InputError for a lost mark."""
        began, n = time.perf_counter(), 0
        while True:
            if self._marked and not self._mark(n):
                return
            data = _exactly(self._pipe, self._bytes)
            if len(data) < self._bytes:
                if data:
                    self.said.append(f"the pipe ended within frame {n}: {len(data)} of {self._bytes} bytes, left out")
                return
            now = time.perf_counter()
            time_s = now - began if self._fps is None else n / self._fps
            yield CameraFrame(microseconds(time_s), self._picture(np.frombuffer(data, np.uint8)), now)
            n += 1

    def close(self) -> None:
        """Whoever writes sees a closed pipe when this process ends."""

    def _mark(self, n: int) -> bool:
        line = _line(self._pipe)
        if line and not line.startswith(b"FRAME"):
            raise InputError(f"{self.name}: expected FRAME before frame {n} of a y4m stream, got {line[:16]!r}")
        return bool(line)


def standard_input(options: CameraOptions, pipe: Pipe | None = None) -> RawFrames:
    """Frames of ``--size`` and ``--pixel-format`` on standard input; without a size a y4m stream.

    Raises ConfigError for a size or format that is none, InputError for a stream that is no y4m.
    """
    if pipe is None:  # without Python's buffer, whose lock a thread that waits would hold when the process ends
        pipe = io.FileIO(sys.stdin.fileno(), closefd=False)
    if options.size is None:
        if options.pixel_format or options.fps:
            raise ConfigError("-: expected --size WxH of raw frames with --pixel-format or --fps, got none")
        return _y4m(pipe, options)
    kind = options.pixel_format or "bgr24"
    if kind not in FORMATS:
        raise ConfigError(f"--pixel-format: expected one of {', '.join(FORMATS)}, got {kind!r}")
    width, height = options.size
    if not (1 <= width <= LARGEST_SIDE_PX and 1 <= height <= LARGEST_SIDE_PX):
        raise ConfigError(f"--size: expected sides of 1 to {LARGEST_SIDE_PX} pixels, got {width}x{height}")

    def picture(data: Array) -> Array:
        if kind == "gray8":
            return np.asarray(cv2.cvtColor(data.reshape(height, width), cv2.COLOR_GRAY2RGB))
        image = data.reshape(height, width, 3)
        return image.copy() if kind == "rgb24" else np.asarray(cv2.cvtColor(image, cv2.COLOR_BGR2RGB))

    return RawFrames(pipe, options.size, width * height * FORMATS[kind], picture, options, fps=options.fps)


def _y4m(pipe: Pipe, options: CameraOptions) -> RawFrames:
    head = _line(pipe)
    if not head.startswith(Y4M):
        got = f"a stream beginning {head[:16]!r}" if head else "an empty one"
        raise InputError(f"-: expected raw frames with --size WxH, or a y4m stream, got {got}")
    said = {word[0]: word[1:] for word in head.decode("ascii", "replace").split()[1:]}
    try:
        width, height = int(said["W"]), int(said["H"])
        fps = float(Fraction(said.get("F", "30:1").replace(":", "/")))
    except (KeyError, ValueError, ZeroDivisionError) as e:
        raise InputError(f"-: expected W, H and F in the head of a y4m stream, got {head[:80]!r}") from e
    colours = said.get("C", "420")
    if colours not in PLANAR or not (1 < width <= LARGEST_SIDE_PX and 1 < height <= LARGEST_SIDE_PX) or not fps > 0:
        raise InputError(f"-: expected y4m of C420 or Cmono (ffmpeg -pix_fmt yuv420p) and a rate, got {head[:80]!r}")
    if colours != "mono" and (width % 2 or height % 2):
        raise InputError(f"-: expected even sides of y4m in C420, got {width}x{height}")
    rows = height if colours == "mono" else height * 3 // 2
    code = cv2.COLOR_GRAY2RGB if colours == "mono" else cv2.COLOR_YUV2RGB_I420

    def picture(data: Array) -> Array:
        return np.asarray(cv2.cvtColor(data.reshape(rows, width), code))

    return RawFrames(pipe, (width, height), rows * width, picture, options, fps=fps, marked=True)


def _exactly(pipe: Pipe, count: int) -> bytearray:
    """So many bytes; fewer where the pipe ends."""
    data = bytearray()
    while len(data) < count:
        more = pipe.read(count - len(data))
        if not more:
            break
        data += more
    return data


def _line(pipe: Pipe) -> bytes:
    """Up to the next end of line, which is included, or ``LONGEST_HEAD`` bytes."""
    line = bytearray()
    while len(line) < LONGEST_HEAD and not line.endswith(b"\n"):
        byte = pipe.read(1)
        if not byte:
            break
        line += byte
    return bytes(line)
