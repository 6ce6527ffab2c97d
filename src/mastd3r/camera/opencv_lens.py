"""Calibrated cameras: OpenCV's lens.

The model is that of OpenCV's calib3d (``projectPoints``): with x, y on the unit plane and r² = x² + y²,
R = (1 + k1 r² + k2 r⁴ + k3 r⁶) / (1 + k4 r² + k5 r⁴ + k6 r⁶),
x_d = x R + 2 p1 x y + p2 (r² + 2 x²), y_d = y R + p1 (r² + 2 y²) + 2 p2 x y.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..errors import ConfigError
from .pinhole import Camera

Array = NDArray[Any]
EXPECTED = "fx,fy,cx,cy[,k1[,k2,p1,p2[,k3[,k4,k5,k6]]]]"
COUNTS = (4, 5, 8, 9, 12)
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
    def distorted(self) -> bool:
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
        x = self._solved(target) if self.distorted else target
        return np.concatenate([x, np.ones_like(x[..., :1])], -1)

    def one_to_one(self) -> bool:
        """True where every pixel of the image has a ray of its own: the lens does not fold inside the image."""
        if not self.distorted:
            return True
        x, y = np.linspace(-0.5, self.width - 0.5, 65), np.linspace(-0.5, self.height - 0.5, 49)
        with np.errstate(all="ignore"):  # numbers that nobody can count with end as no number, and are refused so
            if not len(self._radii[0]):
                return False
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


def _text(numbers: Sequence[float]) -> str:
    return ",".join(f"{v:g}" for v in numbers)
