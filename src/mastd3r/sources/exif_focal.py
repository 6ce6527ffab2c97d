"""The focal length that photographs say in their EXIF data."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from ..errors import InputError
from ..reading.pictures import BROKEN, opened
from .grey_levels import spread

FILM_DIAGONAL_MM = float(np.hypot(36.0, 24.0))  # CIPA DCG-001: equivalents are of the same angle across the diagonal
LOOKED_AT = 200  # files
SAME_RATIO = 0.05  # files further from their median than this were taken with another zoom
MOST_SILENT = 0.5  # share of the files that may say nothing
ASPECT_RATIO = 0.02  # sides of the image and those in EXIF that differ by more: it was cropped
UNITS_MM = {2: 25.4, 3: 10.0, 4: 1.0, 5: 1e-3}  # FocalPlaneResolutionUnit: inch, cm, mm, um
EXIF_IFD = 0x8769
FOCAL_LENGTH, FOCAL_35MM = 0x920A, 0xA405
PLANE_X, PLANE_UNIT, PIXELS_X, PIXELS_Y = 0xA20E, 0xA210, 0xA002, 0xA003


def focal_of(files: Sequence[Path], size: tuple[int, int]) -> tuple[float | None, str]:
    """Focal length in pixels of images of ``size`` (width, height), and what it was told by; (None, "") for unknown.

    The median over files. Unknown where more than half of them say nothing, and where they disagree: a zoom.
    """
    looked_at = [files[k] for k in spread(range(len(files)), LOOKED_AT)]
    found = [told for path in looked_at if (told := focal_of_file(path, size)) is not None]
    if len(found) < (1 - MOST_SILENT) * len(looked_at) or not found:
        return None, ""
    focal_px = float(np.median([f for f, _ in found]))
    if any(abs(f / focal_px - 1) > SAME_RATIO for f, _ in found):
        return None, ""
    return focal_px, min(found, key=lambda told: abs(told[0] - focal_px))[1]


def focal_of_file(path: Path, size: tuple[int, int]) -> tuple[float, str] | None:
    """Focal length in pixels of one file whose image is of ``size``, and what it was told by; None for unknown.

    The equivalent on 35 mm film: f_px = f_35 * diagonal_px / 43.27 mm. Else the focal length in mm and the pixels a
    unit of the sensor, scaled from the size that the camera wrote to that of the file.
    """
    try:
        with opened(path) as image:
            if image.format == "PNG" and "exif" not in image.info:
                return None  # Pillow would decode the image to look behind it
            exif = image.getexif().get_ifd(EXIF_IFD)
    except (InputError, *BROKEN):
        return None
    sides, written = sorted(size), sorted(_number(exif.get(tag)) for tag in (PIXELS_X, PIXELS_Y))
    if written[0] > 0 and abs((sides[1] / sides[0]) / (written[1] / written[0]) - 1) > ASPECT_RATIO:
        return None
    equivalent_mm = _number(exif.get(FOCAL_35MM))
    if equivalent_mm > 0:
        return equivalent_mm * float(np.hypot(*size)) / FILM_DIAGONAL_MM, f"EXIF's {equivalent_mm:g} mm equivalent"
    focal_mm, per_unit = _number(exif.get(FOCAL_LENGTH)), _number(exif.get(PLANE_X))
    unit_mm = UNITS_MM.get(int(_number(exif.get(PLANE_UNIT, 2))))
    if focal_mm <= 0 or per_unit <= 0 or unit_mm is None or written[0] <= 0:
        return None
    return focal_mm * per_unit / unit_mm * sides[1] / written[1], f"EXIF's {focal_mm:g} mm and pixels of the sensor"


def _number(value: object) -> float:
    """A finite number above 0 of an EXIF entry, else 0."""
    try:
        number = float(value)  # type: ignore[arg-type]
    except (TypeError, ValueError, ZeroDivisionError):
        return 0.0
    return number if np.isfinite(number) and number > 0 else 0.0
