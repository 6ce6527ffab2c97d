"""Checks on the choice of frames and on single images."""

from __future__ import annotations

from typing import Any

import cv2
from numpy.typing import NDArray

from ..config import SourceConfig
from ..errors import ConfigError, InputError

BLANK_STD = 2.0  # grey levels; below this an image has nothing that could be matched


def frame_is_blank(image: NDArray[Any]) -> bool:
    """True where an (h, w, 3) uint8 image is of one colour (black, white, lens cap).

    The measure is the standard deviation of the grey image, below 2 of 255 levels.
    """
    _, spread = cv2.meanStdDev(cv2.cvtColor(image, cv2.COLOR_RGB2GRAY))
    return float(spread[0, 0]) < BLANK_STD


def check_window(config: SourceConfig) -> None:
    """Refuse a window that no source can satisfy. Raises ConfigError."""
    if config.stride < 1:
        raise ConfigError(f"source.stride: expected 1 or more, got {config.stride}")
    if config.start < 0:
        raise ConfigError(f"source.start: expected 0 or more, got {config.start}")
    if config.end is not None and config.end <= config.start:
        raise ConfigError(f"source.end: expected more than start ({config.start}), got {config.end}")


def window(config: SourceConfig, count: int, where: str) -> range:
    """Indices that the config leaves of ``count`` frames. Raises InputError, ConfigError."""
    check_window(config)
    if config.start >= count:
        raise InputError(f"{where}: expected a start before its {count} frames end, got start {config.start}")
    return range(config.start, count if config.end is None else min(config.end, count), config.stride)


def check_same_size(image: NDArray[Any], what: str, size: tuple[int, int], first: str) -> None:
    """Refuse an image that is not of the ``size`` (width, height) of the ``first``. Raises InputError."""
    height, width = image.shape[:2]
    if (width, height) != size:
        raise InputError(f"{what}: expected {size[0]}x{size[1]} pixels as in {first}, got {width}x{height}")
