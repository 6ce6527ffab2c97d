"""Calibrated cameras: OpenCV's lens, photographs made into pinhole images before tracking, and results put back.

The model is that of OpenCV's calib3d (``projectPoints``): with x, y on the unit plane and r² = x² + y²,
R = (1 + k1 r² + k2 r⁴ + k3 r⁶) / (1 + k4 r² + k5 r⁴ + k6 r⁶),
x_d = x R + 2 p1 x y + p2 (r² + 2 x²), y_d = y R + p1 (r² + 2 y²) + 2 p2 x y.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from .errors import ConfigError
from .geometry.camera import Camera
from .types import Frame, Source

Array = NDArray[Any]
EXPECTED = "fx,fy,cx,cy[,k1[,k2,p1,p2[,k3[,k4,k5,k6]]]]"
COUNTS = (4, 5, 8, 9, 12)
SAME_FOCAL_RATIO = 1e-6  # fx and fy that differ by less are one focal length
MAX_GROWTH_RATIO = 1.5  # of the pinhole image over the photograph, each way; beyond it wide corners are cut
MIN_SIDE_PX = 16
WIDEST_RAD = 1.52  # 87° off the axis: rays beyond are not looked at
FAR_PX = 1e6  # where rays go that the lens cannot image
NEWTON_ROUNDS = 20
SOLVED = 1e-9  # residual on the unit plane at which a pixel's ray is found


@dataclass(frozen=True)
class OpenCvLens:
    """A calibrated lens with the interface of ``geometry.camera.Camera``; integer pixel = pixel centre."""

    fx_px: float
    fy_px: float
    cx_px: float
    cy_px: float
    width: int
    height: int
    distortion: tuple[float, ...] = ()  # k1 k2 p1 p2 [k3 [k4 k5 k6]], OpenCV's order

    @property
    def pinhole(self) -> Camera:
        """The same camera without distortion."""
        return Camera(self.fx_px, self.fy_px, self.cx_px, self.cy_px, self.width, self.height)

    @property
    def focal_px(self) -> float:
        """One focal length for both axes: their geometric mean."""
        return float(np.sqrt(self.fx_px * self.fy_px))

    @property
    def radial(self) -> Camera:
        """The same camera with the radial terms that ``Camera`` has; p1, p2, k4, k5 and k6 are left out."""
        k1, k2, _, _, k3, *_ = self._coefficients
        return replace(self.pinhole, k1=k1, k2=k2, k3=k3)

    @property
    def bent(self) -> bool:
        """True where straight lines are not imaged straight."""
        return any(self.distortion)

    def resized(self, width: int, height: int) -> OpenCvLens:
        """The same lens over an image scaled to (width, height); half pixels are honoured."""
        c = self.pinhole.resized(width, height)
        return OpenCvLens(c.fx_px, c.fy_px, c.cx_px, c.cy_px, width, height, self.distortion)

    def pixel_grid(self) -> Array:
        """(h, w, 2) float64 pixel centres."""
        return self.pinhole.pixel_grid()

    def project(self, points_cam: Array) -> Array:
        """(..., 3) points with z > 0 to (..., 2) pixels; ``FAR_PX`` away where the lens folds back."""
        xy = points_cam[..., :2] / points_cam[..., 2:]
        radius = np.hypot(xy[..., 0], xy[..., 1])[..., None]
        limit = self._radii[0][-1]
        inside = np.where(radius <= limit, xy, 0.0)
        px = self._distorted(inside) * self._focals + self._centre
        return np.where(radius <= limit, px, FAR_PX)

    def rays(self, px: Array) -> Array:
        """(..., 2) pixels of the image to (..., 3) rays with z = 1; NaN where no ray within reach ends."""
        target = (np.asarray(px, float) - self._centre) / self._focals
        x = self._solved(target) if self.bent else target
        return np.concatenate([x, np.ones_like(x[..., :1])], -1)

    def one_to_one(self) -> bool:
        """True where every pixel of the image has a ray of its own: the lens does not fold inside the image."""
        if not self.bent:
            return True
        x, y = np.linspace(-0.5, self.width - 0.5, 65), np.linspace(-0.5, self.height - 0.5, 49)
        return bool(np.isfinite(self.rays(np.stack(np.meshgrid(x, y), -1))).all())

    @property
    def _focals(self) -> Array:
        return np.array([self.fx_px, self.fy_px])

    @property
    def _centre(self) -> Array:
        return np.array([self.cx_px, self.cy_px])

    @cached_property
    def _coefficients(self) -> tuple[float, ...]:
        return (*self.distortion, *(0.0,) * 8)[:8]

    @cached_property
    def _radii(self) -> tuple[Array, Array]:
        """Undistorted and distorted radii (n,), both ascending, up to where the radial part stops growing."""
        r = np.tan(np.linspace(0.0, WIDEST_RAD, 4096))
        gain, slope, denominator = self._radial(r**2)
        grows = (gain > 0) & (gain + 2 * r**2 * slope > 0) & (denominator > 0)
        count = len(r) if grows.all() else int(np.argmin(grows))
        return r[:count], (r * gain)[:count]

    def _radial(self, r2: Array) -> tuple[Array, Array, Array]:
        """R, dR/dr² and R's denominator."""
        k1, k2, _, _, k3, k4, k5, k6 = self._coefficients
        top, bottom = 1 + r2 * (k1 + r2 * (k2 + r2 * k3)), 1 + r2 * (k4 + r2 * (k5 + r2 * k6))
        d_top, d_bottom = k1 + r2 * (2 * k2 + r2 * 3 * k3), k4 + r2 * (2 * k5 + r2 * 3 * k6)
        safe = np.where(bottom == 0, 1e-12, bottom)
        gain = top / safe
        return gain, (d_top - gain * d_bottom) / safe, bottom

    def _distorted(self, xy: Array) -> Array:
        """(..., 2) on the unit plane to where the lens puts it there."""
        _, _, p1, p2, *_ = self._coefficients
        x, y = xy[..., 0], xy[..., 1]
        r2 = x**2 + y**2
        gain, _, _ = self._radial(r2)
        x_d = x * gain + 2 * p1 * x * y + p2 * (r2 + 2 * x**2)
        y_d = y * gain + p1 * (r2 + 2 * y**2) + 2 * p2 * x * y
        return np.stack([x_d, y_d], -1)

    def _jacobian(self, xy: Array) -> tuple[Array, Array, Array]:
        """d x_d/dx, d x_d/dy (= d y_d/dx) and d y_d/dy, each (...)."""
        _, _, p1, p2, *_ = self._coefficients
        x, y = xy[..., 0], xy[..., 1]
        gain, slope, _ = self._radial(x**2 + y**2)
        across = 2 * x * y * slope + 2 * p1 * x + 2 * p2 * y
        return (
            gain + 2 * x**2 * slope + 2 * p1 * y + 6 * p2 * x,
            across,
            gain + 2 * y**2 * slope + 6 * p1 * y + 2 * p2 * x,
        )

    def _solved(self, target: Array) -> Array:
        """Undistorted (..., 2) of distorted points: the radial part by table, then Newton; NaN where that fails."""
        radii, bent_radii = self._radii
        wanted = np.hypot(target[..., 0], target[..., 1])
        start = np.interp(wanted, bent_radii, radii) / np.maximum(wanted, 1e-12)
        xy = target * np.where(wanted < 1e-9, 1.0, start)[..., None]
        for _ in range(NEWTON_ROUNDS):
            error = self._distorted(xy) - target
            if float(np.abs(error).max(initial=0.0)) < SOLVED:
                break
            a, b, c = self._jacobian(xy)
            det = a * c - b * b
            det = np.where(np.abs(det) < 1e-9, 1e-9, det)
            step = np.stack([c * error[..., 0] - b * error[..., 1], a * error[..., 1] - b * error[..., 0]], -1)
            xy = np.clip(xy - step / det[..., None], -radii[-1], radii[-1])
        a, b, c = self._jacobian(xy)
        missed = np.abs(self._distorted(xy) - target).max(-1) > 1e3 * SOLVED
        folded = (a * c - b * b <= 0) | (np.hypot(xy[..., 0], xy[..., 1]) > radii[-1])
        return np.where((missed | folded)[..., None], np.nan, xy)


def lens_from_intrinsics(given: Sequence[float], size: tuple[int, int]) -> OpenCvLens:
    """The lens that ``--intrinsics`` names, over a photograph of ``size`` (width, height) pixels.

    Raises ConfigError for a wrong count, values that are not finite, focal lengths that are not positive, and
    distortion that folds inside the image.
    """
    if len(given) not in COUNTS:
        counts = ", ".join(map(str, COUNTS[:-1]))
        raise ConfigError(
            f"--intrinsics: expected {EXPECTED} ({counts} or {COUNTS[-1]} numbers) in pixels of the full-size image, "
            f"got {len(given)} numbers"
        )
    if not np.isfinite(given).all() or min(given[:2]) <= 0:
        raise ConfigError(f"--intrinsics: expected finite numbers with fx, fy > 0, got {_text(given)}")
    fx, fy, cx, cy, *distortion = given
    if len(distortion) == 1:
        distortion += [0.0, 0.0, 0.0]  # OpenCV knows no list of k1 alone
    lens = OpenCvLens(fx, fy, cx, cy, *size, tuple(distortion))
    if not lens.one_to_one():
        raise ConfigError(
            f"--intrinsics: expected distortion that is one-to-one over the {size[0]}x{size[1]} image, got "
            f"{_text(given[4:])}, which folds inside it"
        )
    return lens


def rectifier_for(given: Sequence[float], size: tuple[int, int]) -> Rectifier | None:
    """What makes photographs of ``size`` (width, height) pinhole images; None where nothing is given or they are.

    Raises ConfigError as ``lens_from_intrinsics`` does.
    """
    if not given:
        return None
    lens = lens_from_intrinsics(given, size)
    if not lens.bent and abs(lens.fx_px - lens.fy_px) <= SAME_FOCAL_RATIO * lens.fx_px:
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

    def frame(self, frame: Frame) -> Frame:
        """A photograph with all it carries, seen by the pinhole."""
        return replace(
            frame,
            image=self.image(frame.image),
            depth_m=None if frame.depth_m is None else self.depth(frame.depth_m),
            semantic=None if frame.semantic is None else self.semantic(frame.semantic),
        )

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


class RectifiedSource:
    """A source whose frames are seen by the pinhole. Truth stays in the photograph's pixels."""

    def __init__(self, source: Source, rectifier: Rectifier) -> None:
        self._source, self._rectifier = source, rectifier
        self.name, self.kind, self.size, self.length = source.name, source.kind, rectifier.size, source.length
        self.notes = source.notes
        self.has_depth, self.has_semantic = source.has_depth, source.has_semantic
        self.calibration: tuple[float, ...] = ()  # that of the photographs is not that of these
        self.truth = source.truth

    def frames(self) -> Iterator[Frame]:
        """Frame after frame, rectified; errors are those of the source."""
        return (self._rectifier.frame(frame) for frame in self._source.frames())


def _text(numbers: Sequence[float]) -> str:
    return ",".join(f"{v:g}" for v in numbers)


def tracked_frames(photographs: Iterator[Frame], rectifier: Rectifier | None, untaken: deque[Frame]) -> Iterator[Frame]:
    """What tracking is shown of each photograph. The photographs go to ``untaken``, for the caller to take in order."""
    for photograph in photographs:
        untaken.append(photograph)
        yield photograph if rectifier is None else rectifier.frame(photograph)
