"""Compressed parts of ROS bags, unpacked within bounds: a few bytes may ask for all memory, or all of a disk."""

from __future__ import annotations

import bz2
from collections.abc import Callable
from typing import Any

MOST = 512 * 2**20  # bytes of a chunk or a message; writers make chunks of a few MiB, and images are smaller
MOST_FILE, MOST_RATIO = 2**30, 200  # a file that is larger, and so many times larger than it was, is no recording


def unpacked(data: bytes, make: Callable[[], Any], most: int) -> bytes:
    """All frames of ``data``, one after the other. Raises ValueError for more than ``most`` bytes, or a cut frame."""
    parts, left = list[bytes](), most
    while data:
        one = make()
        part = one.decompress(data, left + 1)
        left -= len(part)
        if left < 0:
            raise ValueError(f"a compressed part of more than {most >> 20} MiB")
        if not one.eof:
            raise ValueError("a compressed part that ends too early")
        parts.append(part)
        data = one.unused_data or b""
    return b"".join(parts)


class _BoundedFile:
    """A compressed file that is read until it is out of all proportion."""

    def __init__(self, file: Any, packed: int) -> None:
        self._file, self._left = file, max(MOST_FILE, MOST_RATIO * packed)

    def __enter__(self) -> _BoundedFile:
        return self

    def __exit__(self, *_: object) -> None:
        self._file.close()

    def read(self, size: int = -1) -> bytes:
        """As a file's; raises ValueError."""
        part: bytes = self._file.read(min(size, self._left + 1) if size >= 0 else self._left + 1)
        self._left -= len(part)
        if self._left < 0:
            raise ValueError("a compressed file that holds far more than a recording")
        return part


class _BoundedZstd:
    """The zstd module, whose ``decompress`` and ``open`` keep to the bounds."""

    def __init__(self, zstd: Any) -> None:
        self._zstd = zstd

    def __getattr__(self, name: str) -> Any:
        return getattr(self._zstd, name)

    def decompress(self, data: bytes) -> bytes:
        """A whole message or chunk."""
        return unpacked(bytes(data), self._zstd.ZstdDecompressor, MOST)

    def open(self, file: Any, mode: str = "rb", **options: Any) -> Any:
        """A file; what is read of it is counted."""
        if mode not in ("r", "rb"):
            return self._zstd.open(file, mode, **options)
        here = file.tell()
        packed = file.seek(0, 2) - here
        file.seek(here)
        return _BoundedFile(self._zstd.open(file, mode, **options), packed)


def bound_rosbags() -> None:
    """rosbags unpacks within these bounds from here on. Raises ImportError, AttributeError where it is not as known."""
    import lz4.frame
    from rosbags.rosbag1 import reader as rosbag1
    from rosbags.rosbag2 import reader as rosbag2
    from rosbags.rosbag2 import storage_mcap as mcap

    if isinstance(rosbag2.zstd, _BoundedZstd):
        return
    zstd = _BoundedZstd(rosbag2.zstd)
    rosbag2.zstd = zstd
    mcap.DECOMPRESSORS |= {
        "lz4": lambda data, _: unpacked(data, lz4.frame.LZ4FrameDecompressor, MOST),
        "zstd": lambda data, _: zstd.decompress(data),
    }
    rosbag1.decompressors |= {
        "bz2": lambda data: unpacked(data, bz2.BZ2Decompressor, MOST),
        "lz4": lambda data: unpacked(data, lz4.frame.LZ4FrameDecompressor, MOST),
    }
