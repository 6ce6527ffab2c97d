"""Pictures: their size is read from the header, and bounded, before they are decoded."""

from __future__ import annotations

import io
import struct
import warnings
import zlib
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, BinaryIO

import cv2
import numpy as np
from numpy.typing import NDArray
from PIL import Image

from ..errors import InputError
from .files import check_plain

MOST_PIXELS = 80_000_000  # of a photograph; more than any video or still camera of one lens has
BROKEN = (
    *(OSError, SyntaxError, ValueError, TypeError, LookupError, EOFError, OverflowError, struct.error, zlib.error),
    Image.DecompressionBombError,
)


@contextmanager
def opened(source: Path | BinaryIO) -> Iterator[Image.Image]:
    """An image file of which only the header has been read. Raises InputError and ``BROKEN``."""
    if isinstance(source, Path):
        check_plain(source, "an image")
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # Pillow's bound is above ours
        with Image.open(source) as image:
            check_pixels(image.size, str(source) if isinstance(source, Path) else "image")
            yield image


def check_pixels(size: tuple[int, int], where: str) -> None:
    """Raise InputError for more pixels than are ever read; ``size`` is (width, height)."""
    if size[0] * size[1] > MOST_PIXELS:
        raise InputError(f"{where}: expected at most {MOST_PIXELS} pixels, got {size[0]}x{size[1]}")


def decoded(data: bytes, path: Path, mode: int) -> NDArray[Any]:
    """The image in the bytes of a file, as OpenCV's ``mode`` says. Raises InputError."""
    try:
        with opened(io.BytesIO(data)) as whole:
            whole.load()  # OpenCV would speak to the terminal about what is wrong
        del whole  # it is as large as what comes
        image = cv2.imdecode(np.frombuffer(data, np.uint8), mode)
    except (*BROKEN, cv2.error):
        image = None
    except InputError as e:
        raise InputError(f"{path}: {str(e).removeprefix('image: ')}") from e
    if image is None:
        raise InputError(f"{path}: expected an image, got {len(data)} bytes that are not one")
    return image
