"""The shared intrinsics, their priors, and the camera that they stand for."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..camera.pinhole import Camera
from ..config import CameraConfig
from ..geometry.reprojection_kernels import N_GLOBAL

Array = NDArray[Any]


@dataclass
class Intrinsics:
    """Shared intrinsics g = (log f, k, cx, cy, m, n) at the working resolution, with a Gaussian prior on each."""

    values: Array  # (6,)
    prior: Array  # (6,)
    prior_info: Array  # (6,) 1/variance in px^-2 units; inf = fixed
    focal_source: str = "assumed"  # where the prior's focal length comes from: "given", "EXIF" or "assumed"

    @property
    def free(self) -> Array:
        """(6,) bool, which intrinsics are estimated."""
        return np.isfinite(self.prior_info)


FOCAL_RATIOS_BELIEVED = (0.35, 4.0)  # focal / sqrt(width * height) of a network's points, for the lens to start there
PRIOR_FOCAL_RATIO, PRIOR_FOCAL_SIGMA = 1.0, 0.25  # focal / sqrt(width * height) of most cameras; 1 sigma of its log
EXIF_FOCAL_SIGMA = 0.05  # of its log, where EXIF tells it: equivalents are in whole mm, lenses focus and are corrected
PRIOR_RADIAL_SIGMA = (0.05, 0.1, 0.1)  # of k, m, n
PRIOR_CENTRE_SIGMA = 0.02  # of the principal point from the image's centre / width
RADIAL, HELD_AT_FIRST = (1, 4, 5), (2, 3, 4, 5)  # indices into g: radial terms; what waits for lens_keyframes
PRIOR_GAIN = 10.0  # match errors are alike within a view, so their sum claims too much: the prior is raised instead


def as_given(intrinsics: Intrinsics) -> Intrinsics:
    """The same, as known as if they had been given."""
    return Intrinsics(intrinsics.values, intrinsics.values, np.full(N_GLOBAL, np.inf))


def without_radial(intrinsics: Intrinsics) -> Intrinsics:
    """The same with no radial term, held there."""
    values, info = intrinsics.values.copy(), intrinsics.prior_info.copy()
    values[list(RADIAL)], info[list(RADIAL)] = 0.0, np.inf
    return Intrinsics(values, intrinsics.prior, info, intrinsics.focal_source)


def of_camera(camera: Camera) -> Intrinsics:
    """Those of a camera at working size, as given; fx and fy are joined by their geometric mean."""
    focal = float(np.sqrt(camera.fx_px * camera.fy_px))
    k, m, n = inverse_radial(focal, (camera.k1, camera.k2, camera.k3), (camera.width, camera.height))
    values = np.array([np.log(focal), k, camera.cx_px, camera.cy_px, m, n])
    return Intrinsics(values, values.copy(), np.full(N_GLOBAL, np.inf), "given")


def believing(intrinsics: Intrinsics, focal_px: float | None, size: tuple[int, int]) -> Intrinsics:
    """The same, starting at a focal length in pixels of ``size``, where a camera may have it.

    What EXIF says goes before it.
    """
    low, high = FOCAL_RATIOS_BELIEVED
    if intrinsics.focal_source == "EXIF":
        return intrinsics
    if focal_px is None or not low < focal_px / np.sqrt(size[0] * size[1]) < high:
        return intrinsics
    values = np.concatenate([[np.log(focal_px)], intrinsics.values[1:]])
    return Intrinsics(values, values.copy(), intrinsics.prior_info)


def camera_of(intrinsics: Intrinsics, size: tuple[int, int]) -> Camera:
    """The camera (width, height) that they stand for; radial terms fitted to the undistortion of the solver."""
    g = intrinsics.values
    f, cx, cy = float(np.exp(g[0])), float(g[2]), float(g[3])
    return Camera(f, f, cx, cy, *size, *inverse_radial(f, tuple(g[list(RADIAL)]), size))


def inverse_radial(focal_px: float, terms: tuple[float, ...], size: tuple[int, int]) -> tuple[float, ...]:
    """(a, b, c) of x = y (1 + a y² + b y⁴ + c y⁶) from those of y = x (1 + …) in ``terms``.

    Least squares over radii of the image, weighted to be best in y's pixels; as many terms as are not zero there,
    so that a lens of one term stays one. Both ways: the solver undistorts, ``Camera`` distorts.
    """
    used = max((n + 1 for n, t in enumerate(terms) if t != 0.0), default=0)
    if used == 0:
        return 0.0, 0.0, 0.0
    x = np.linspace(0.05, 1.0, 60) * 0.5 * np.hypot(*size) / focal_px
    y = x * (1 + sum(t * x ** (2 * n + 2) for n, t in enumerate(terms)))
    powers = np.stack([y ** (2 * n + 3) for n in range(used)], -1)
    found = np.linalg.lstsq(powers, x - y, rcond=None)[0]
    return tuple(float(v) for v in (*found, 0.0, 0.0))[:3]


def intrinsics_for(
    camera: CameraConfig, width: int, height: int, full_size: tuple[int, int], focal_hint_px: float | None = None
) -> Intrinsics:
    """Intrinsics before anything is seen: fixed where they are given, otherwise centred with wide priors.

    focal_hint_px: the focal length that photographs say in EXIF, pixels of the full size; the prior is narrow then.
    The optimisation knows one focal length, so fx and fy are joined by their geometric mean.
    """
    if camera.intrinsics:
        fx, fy, cx, cy = camera.intrinsics[:4]
        c = Camera(fx, fy, cx, cy, *full_size).resized(width, height)
        f = float(np.sqrt(c.fx_px * c.fy_px))
        k1 = camera.intrinsics[4] if len(camera.intrinsics) > 4 else 0.0
        k, m, n = inverse_radial(f, (k1, 0.0, 0.0), (width, height))
        g = np.array([np.log(f), k, c.cx_px, c.cy_px, m, n])
        return Intrinsics(g, g.copy(), np.full(N_GLOBAL, np.inf), "given")
    focal, focal_sigma, focal_source = PRIOR_FOCAL_RATIO * np.sqrt(width * height), PRIOR_FOCAL_SIGMA, "assumed"
    if focal_hint_px is not None:
        focal = focal_hint_px * np.sqrt(width * height / (full_size[0] * full_size[1]))
        focal_sigma, focal_source = EXIF_FOCAL_SIGMA, "EXIF"
    g = np.array([np.log(focal), 0.0, (width - 1) / 2, (height - 1) / 2, 0.0, 0.0])
    centre = PRIOR_CENTRE_SIGMA * width
    sigma = np.array([focal_sigma, PRIOR_RADIAL_SIGMA[0], centre, centre, *PRIOR_RADIAL_SIGMA[1:]])
    info = PRIOR_GAIN / sigma**2
    if not camera.estimate_radial:
        info[1:] = np.inf
    return Intrinsics(g, g.copy(), info, focal_source)
