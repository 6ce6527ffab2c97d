"""Reading single files: photographs, depth maps and probability maps."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageOps

from ..errors import InputError
from ..reading.arrays import BrokenArray, array_of
from ..reading.pictures import BROKEN, opened
from .grey_levels import TOP, WHOLE, GreyRange

Array = NDArray[Any]
IMAGE_SUFFIXES = (".jpg", ".jpeg", ".png", ".webp")
EXIF_ORIENTATION, UPRIGHT = 0x0112, 1
MAP_SUFFIXES = (".png", ".npy")


class BrokenFile(InputError):
    """A file that is there and cannot be read, or not to its end."""


def read_rgb(path: Path, grey_range: GreyRange = WHOLE) -> Array:
    """An image file as upright (h, w, 3) uint8 RGB. Raises InputError, its child BrokenFile for a broken file.

    EXIF orientation is applied; grey is repeated, alpha dropped, 16-bit grey brought to 8 bits by ``grey_range``.
    """
    image = _opened(path, "a readable image")
    if image.mode.startswith("I"):  # Pillow's modes of 16-bit grey files
        image = Image.fromarray(grey_range.as_8_bit(_grey_levels(image, path)))
    if image.mode != "RGB":
        image = image.convert("RGB")
    return np.array(image)  # a copy of its own, writable


def stored_as_read(path: Path) -> bool:
    """True where ``read_rgb`` changes nothing: 8-bit colour or grey, stored upright. Raises InputError."""
    try:
        with opened(path) as image:
            return image.mode in ("L", "RGB") and image.getexif().get(EXIF_ORIENTATION, UPRIGHT) == UPRIGHT
    except BROKEN as e:
        raise BrokenFile(f"{path}: expected a readable image, got a broken or unknown file ({e})") from e


def read_grey_levels(path: Path) -> Array | None:
    """(h, w) levels of a 16-bit grey file; None for another kind of image, which is not read, or a broken one."""
    try:
        with opened(path) as image:
            if not image.mode.startswith("I"):
                return None
        return _grey_levels(_opened(path, "a readable image"), path)
    except (InputError, *BROKEN):  # who reads it as an image says what is wrong with it
        return None


def read_depth_m(path: Path, units_per_metre: float, none: int | None = None) -> tuple[Array, int]:
    """A depth file as (h, w) float32 metres, 0 = none, and the number of values that were not finite.

    Integer files hold metres times ``units_per_metre``, and ``none``, beside 0, where nothing was measured; float
    files (.npy, 32-bit float images) hold metres.
    Values that are not finite, or negative, become 0. Raises InputError.
    """
    raw = _map_values(path, "a depth map")
    depth = raw.astype(np.float32)
    if raw.dtype.kind in "iu":
        if none is not None:
            depth[raw == none] = 0
        return np.maximum(depth / np.float32(units_per_metre), 0), 0
    finite = np.isfinite(depth)
    return np.where(finite & (depth > 0), depth, np.float32(0)), int(np.count_nonzero(~finite))


def read_probability(path: Path) -> Array:
    """A map of P(movable thing) as (h, w) float32 in 0..1. Raises InputError.

    8-bit files are divided by 255, 16-bit ones by 65535; float .npy files are taken as they are.
    """
    raw = _map_values(path, "a probability map")
    if raw.dtype == np.bool_:
        return raw.astype(np.float32)
    if raw.dtype.kind in "iu":
        top = 255 if raw.dtype.itemsize == 1 else 65535
        raw = raw.astype(np.float32) / np.float32(top)
    values = raw.astype(np.float32)
    if not (np.isfinite(values).all() and values.min() >= 0 and values.max() <= 1):
        raise InputError(f"{path}: expected probabilities in 0..1, got {raw.min():g} .. {raw.max():g}")
    return values


def _opened(path: Path, expected: str) -> Image.Image:
    try:
        with opened(path) as image:
            image.load()
            ImageOps.exif_transpose(image, in_place=True)  # without a copy: of the largest each is a third of a GB
            return image
    except FileNotFoundError as e:
        raise InputError(f"{path}: expected {expected}, got no such file") from e
    except BROKEN as e:
        raise BrokenFile(f"{path}: expected {expected}, got a broken or unknown file ({e})") from e


def _grey_levels(image: Image.Image, path: Path) -> Array:
    """Levels of 16-bit grey (modes I;16, I)."""
    values = np.asarray(image)
    if values.min() < 0 or values.max() > TOP:
        raise InputError(f"{path}: expected grey levels in 0..{TOP}, got {values.min()} .. {values.max()}")
    return values


def _map_values(path: Path, expected: str) -> Array:
    """One number a pixel, as stored, (h, w)."""
    if path.suffix.lower() == ".npy":
        try:
            values: Array = array_of(path, expected)
        except BrokenArray as e:
            raise BrokenFile(str(e)) from e
    else:
        image = _opened(path, expected)
        values = np.asarray(image.convert("L") if image.mode in ("P", "LA", "RGB", "RGBA") else image)
    if values.ndim != 2 or values.size == 0 or values.dtype.kind not in "iufb":
        raise InputError(f"{path}: expected {expected}, one number a pixel, got {values.dtype} {values.shape}")
    return values
