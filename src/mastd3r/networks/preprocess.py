"""Photograph to network image as DUSt3R and MASt3R do it, and the way back for pixels.

Long side to 512 (Lanczos when shrinking, bicubic else), centre crop to multiples of 16, values to -1 … 1.
Rotation by EXIF is the source's work.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from ..errors import InputError

Array = NDArray[Any]

LONG_SIDE_PX = 512
PATCH_PX = 16


@dataclass(frozen=True)
class PixelMapping:
    """Between pixels of the photograph ("full") and of the network's image ("net"); (x, y), integers at centres."""

    full_size: tuple[int, int]  # (width, height)
    resized_size: tuple[int, int]  # before the crop; both axes are rounded, so their scales differ a little
    crop_left_px: int
    crop_top_px: int
    net_size: tuple[int, int]  # (width, height)

    @property
    def net_per_full(self) -> Array:
        """(2,) size of a full pixel in net pixels, x and y."""
        return np.array(self.resized_size) / np.array(self.full_size)

    def net_from_full(self, px: Array) -> Array:
        """(..., 2) full pixels to net pixels; what was cropped lies outside the net image."""
        return (np.asarray(px, float) + 0.5) * self.net_per_full - 0.5 - self._corner

    def full_from_net(self, px: Array) -> Array:
        """(..., 2) net pixels to full pixels."""
        return (np.asarray(px, float) + self._corner + 0.5) / self.net_per_full - 0.5

    @property
    def _corner(self) -> Array:
        return np.array([self.crop_left_px, self.crop_top_px], float)


def prepare_image(
    image: Array, long_side_px: int = LONG_SIDE_PX, square_ok: bool = False
) -> tuple[Array, PixelMapping]:
    """(H, W, 3) uint8 RGB -> ((3, h, w) float32 in -1 … 1, mapping). h and w are multiples of 16.

    A square result is cropped to 4:3 unless ``square_ok``: the network was not trained on squares.
    Raises InputError for another shape or type, and for a strip so thin that no patch is left.
    """
    if image.ndim != 3 or image.shape[2] != 3 or image.dtype != np.uint8:
        raise InputError(f"network image: expected (height, width, 3) uint8, got {image.shape} {image.dtype}")
    full_h, full_w = image.shape[:2]
    if not full_h or not full_w:
        raise InputError(f"network image: expected pixels, got {full_w}x{full_h}")
    longest = max(full_w, full_h)
    resized = round(full_w * long_side_px / longest), round(full_h * long_side_px / longest)
    left, top, width, height = _crop(*resized, square_ok)
    if not width or not height:
        raise InputError(
            f"network image: expected at least {PATCH_PX} px a side once the long side is {long_side_px} px, "
            f"got {resized[0]}x{resized[1]} from {full_w}x{full_h}"
        )
    how = Image.Resampling.LANCZOS if longest > long_side_px else Image.Resampling.BICUBIC
    small = np.asarray(Image.fromarray(image).resize(resized, how))[top : top + height, left : left + width]
    values = (small.astype(np.float32) / 255 - 0.5) / 0.5
    mapping = PixelMapping((full_w, full_h), resized, left, top, (width, height))
    return np.ascontiguousarray(values.transpose(2, 0, 1)), mapping


def _crop(width: int, height: int, square_ok: bool) -> tuple[int, int, int, int]:
    """(left, top, width, height) of the centre crop, which sits at the integer half of each side."""
    half_w = (2 * (width // 2)) // PATCH_PX * (PATCH_PX // 2)
    half_h = (2 * (height // 2)) // PATCH_PX * (PATCH_PX // 2)
    if width == height and not square_ok:
        half_h = 3 * half_w // 4 // (PATCH_PX // 2) * (PATCH_PX // 2)
    return width // 2 - half_w, height // 2 - half_h, 2 * half_w, 2 * half_h
