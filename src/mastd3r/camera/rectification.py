"""Photographs of a calibrated lens made into pinhole images before tracking, and pictures put back."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from ..errors import ConfigError
from .opencv_lens import OpenCvLens, lens_from_intrinsics
from .pinhole import Camera

Array = NDArray[Any]
SAME_FOCAL_RATIO = 1e-6  # fx and fy that differ by less are one focal length
MAX_GROWTH_RATIO = 1.5  # of the pinhole image over the photograph, each way; beyond it wide corners are cut
MIN_SIDE_PX = 16


def rectifier_for(given: Sequence[float], size: tuple[int, int]) -> Rectifier | None:
    """What makes photographs of ``size`` (width, height) pinhole images; None where nothing is given or they are.

    Raises ConfigError as ``lens_from_intrinsics`` does.
    """
    if not given:
        return None
    lens = lens_from_intrinsics(given, size)
    if not lens.distorted and abs(lens.fx_px - lens.fy_px) <= SAME_FOCAL_RATIO * lens.fx_px:
        return None
    return Rectifier(lens)


class Rectifier:
    """Photographs of one lens to images of one pinhole camera with one focal length, and pictures back.

    The pinhole image keeps the photograph's axes, its centre and the geometric mean of its focal lengths. It is
    the largest upright rectangle in which every pixel has data, so that no border stands still in all frames:
    smaller than the photograph for a pincushion, larger (by ``MAX_GROWTH_RATIO`` at most) for a barrel.
    Depth along the axis is the same in both.
    """

    def __init__(self, lens: OpenCvLens) -> None:
        """Raises ConfigError where no rectangle of ``MIN_SIDE_PX`` is left."""
        self.lens = lens
        self.pinhole = _inner_pinhole(lens)
        self.size = (self.pinhole.width, self.pinhole.height)
        self._maps: dict[tuple[str, int, int], Array] = {}

    @property
    def note(self) -> str:
        """What was done, in one line for the log and run.json."""
        grid = self.lens.pixel_grid()
        grid = grid[:: max(1, self.lens.height // 60), :: max(1, self.lens.width // 80)]
        at = self.pinhole.project(self.lens.rays(grid))
        outside = 1 - float(((at >= -0.5) & (at <= np.array(self.size) - 0.5)).all(-1).mean())
        line = f"lens: photographs rectified to a pinhole of {self.lens.focal_px:.1f} px, {self.size[0]}x{self.size[1]}"
        cut = f"; {outside:.1%} of the photograph is outside, where masks repeat the nearest pixel"
        return line + (cut if outside > 0.0005 else "")

    def image(self, image: Array) -> Array:
        """(h, w, 3) uint8 photograph to the pinhole's. Linear: OpenCV's cubic moves things by up to 0.05 px."""
        return self._warped(image, "photograph", cv2.INTER_LINEAR)

    def depth(self, depth_m: Array) -> Array:
        """(h, w) float32 metres, nearest: depths of two surfaces are never mixed."""
        return self._warped(depth_m, "photograph", cv2.INTER_NEAREST)

    def semantic(self, probability: Array) -> Array:
        """(h', w') float32 over the photograph, any size, to the pinhole at the same scale."""
        return self._warped(probability, "photograph", cv2.INTER_LINEAR)

    def as_photograph(self, picture: Array) -> Array:
        """A picture of the pinhole, any size, as the lens would have taken it, at the same scale.

        Pixels of the photograph outside the pinhole image repeat the nearest inside.
        """
        return self._warped(picture, "pinhole", cv2.INTER_LINEAR)

    def _warped(self, picture: Array, kind: str, interpolation: int) -> Array:
        height, width = picture.shape[:2]
        key = (kind, width, height)
        if key not in self._maps:
            make = self._from_photograph if kind == "photograph" else self._from_pinhole
            self._maps[key] = make(width, height).astype(np.float32)
        border = cv2.BORDER_REPLICATE
        return np.asarray(cv2.remap(picture, self._maps[key], None, interpolation, borderMode=border))

    def _from_photograph(self, width: int, height: int) -> Array:
        """Where the pinhole's pixels are in a photograph of this size, (h, w, 2)."""
        lens = self.lens.resized(width, height)
        w, h = self.size[0] * width / self.lens.width, self.size[1] * height / self.lens.height
        pinhole = self.pinhole.resized(max(1, round(w)), max(1, round(h)))
        return lens.project(pinhole.rays(pinhole.pixel_grid()))

    def _from_pinhole(self, width: int, height: int) -> Array:
        """Where the photograph's pixels are in a pinhole picture of this size, (h, w, 2)."""
        pinhole = self.pinhole.resized(width, height)
        w, h = self.lens.width * width / self.size[0], self.lens.height * height / self.size[1]
        lens = self.lens.resized(max(1, round(w)), max(1, round(h)))
        return pinhole.project(lens.rays(lens.pixel_grid()))


def _inner_pinhole(lens: OpenCvLens) -> Camera:
    """The pinhole whose every pixel lies within the photograph: bounds from the rays of the photograph's edges."""
    w, h, focal = lens.width, lens.height, lens.focal_px
    along_x, along_y = np.linspace(0, w - 1, 257), np.linspace(0, h - 1, 257)

    def edge(x: Array | float, y: Array | float) -> Array:
        px = np.stack(np.broadcast_arrays(x, y), -1)
        return lens.rays(px)[..., :2] * focal + np.array([lens.cx_px, lens.cy_px])

    low = np.array([edge(0.0, along_y)[:, 0].max(), edge(along_x, 0.0)[:, 1].max()])
    high = np.array([edge(w - 1.0, along_y)[:, 0].min(), edge(along_x, h - 1.0)[:, 1].min()])
    spare = 0.5 * (MAX_GROWTH_RATIO - 1) * np.array([w, h])
    low = np.ceil(np.maximum(low - 1e-6, -spare)).astype(int)
    high = np.floor(np.minimum(high + 1e-6, np.array([w - 1, h - 1]) + spare)).astype(int)
    width, height = (int(v) for v in high - low + 1)
    if min(width, height) < MIN_SIDE_PX:
        raise ConfigError(
            f"--intrinsics: expected a lens that leaves a straight image of {MIN_SIDE_PX} px a side or more, got "
            f"{max(0, width)}x{max(0, height)} of {w}x{h}"
        )
    return Camera(focal, focal, float(lens.cx_px - low[0]), float(lens.cy_px - low[1]), width, height)
