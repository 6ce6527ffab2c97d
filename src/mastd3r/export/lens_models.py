"""A lens in the words of other tools: models whose terms are OpenCV's, with (0.5, 0.5) at the first pixel's centre."""

from __future__ import annotations

from typing import Any

from ..camera.opencv_lens import OpenCvLens
from ..camera.pinhole import Camera
from ..errors import InputError

SAME_FOCAL_RATIO = 1e-6  # fx and fy that differ by less are one focal length


def distortion_of(lens: Camera | OpenCvLens) -> tuple[float, ...]:
    """k1 k2 p1 p2 k3 k4 k5 k6, OpenCV's order."""
    if isinstance(lens, OpenCvLens):
        return (*lens.distortion, *(0.0,) * 8)[:8]
    return lens.k1, lens.k2, 0.0, 0.0, lens.k3, 0.0, 0.0, 0.0


def colmap_model(lens: Camera | OpenCvLens) -> tuple[str, list[float]]:
    """COLMAP's name of the simplest model that holds the lens (PINHOLE where it bends nothing), and its parameters."""
    k1, k2, p1, p2, *higher = distortion_of(lens)
    fx, fy, centre = lens.fx_px, lens.fy_px, [lens.cx_px + 0.5, lens.cy_px + 0.5]
    if any(higher):
        return "FULL_OPENCV", [fx, fy, *centre, k1, k2, p1, p2, *higher]
    if not any((k1, k2, p1, p2)):
        return "PINHOLE", [fx, fy, *centre]
    if abs(fx - fy) > SAME_FOCAL_RATIO * fx or p1 != 0.0 or p2 != 0.0:
        return "OPENCV", [fx, fy, *centre, k1, k2, p1, p2]
    if k2 == 0.0:
        return "SIMPLE_RADIAL", [fx, *centre, k1]
    return "RADIAL", [fx, *centre, k1, k2]


def nerfstudio_lens(lens: Camera | OpenCvLens) -> dict[str, Any]:
    """The fields of transforms.json. Raises InputError for rational distortion, which nerfstudio has no fields for."""
    k1, k2, p1, p2, k3, *rational = distortion_of(lens)
    if any(rational):
        raise InputError(
            f"nerfstudio: expected distortion of k1, k2, p1, p2 and k3, got k4, k5, k6 = {rational}; use --undistort"
        )
    fields: dict[str, Any] = {
        "camera_model": "OPENCV" if any((k1, k2, p1, p2, k3)) else "PINHOLE",
        "w": lens.width,
        "h": lens.height,
        "fl_x": lens.fx_px,
        "fl_y": lens.fy_px,
        "cx": lens.cx_px + 0.5,
        "cy": lens.cy_px + 0.5,
    }
    terms = {"k1": k1, "k2": k2, "k3": k3, "p1": p1, "p2": p2}
    return fields | (terms if fields["camera_model"] == "OPENCV" else {})
