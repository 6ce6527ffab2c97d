"""Pictures for the report: overlays, differences, data URIs. Images are (h, w, 3) uint8 RGB."""

from __future__ import annotations

import base64
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from ..errors import OutputError

Array = NDArray[Any]
DIFFERENCE_FULL_SCALE = 0.25  # mean absolute difference of the channels that is drawn brightest
JPEG_QUALITY = 86
MOVING_COLOUR = (255.0, 98.0, 0.0)


def data_uri(image: Array) -> str:
    """An image as a JPEG data URI, so that a page needs no other file."""
    done, data = cv2.imencode(".jpg", np.ascontiguousarray(image[..., ::-1]), [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY])
    if not done:
        raise OutputError(f"report: expected an image of some size, got shape {image.shape}")
    return "data:image/jpeg;base64," + base64.b64encode(data.tobytes()).decode()


def fitted(image: Array, width: int) -> Array:
    """The image at most ``width`` pixels wide, in its own proportions."""
    if image.shape[1] <= width:
        return image
    height = max(1, round(image.shape[0] * width / image.shape[1]))
    return np.asarray(cv2.resize(image, (width, height), interpolation=cv2.INTER_AREA))


def mask_overlay(image: Array, probability: Array) -> Array:
    """The photograph, dimmed, with P(moving) (h', w') uint8 over it in orange and its 0.5 line in white."""
    size = (image.shape[1], image.shape[0])
    p = np.asarray(cv2.resize(probability, size, interpolation=cv2.INTER_LINEAR))
    out = tinted(np.ascontiguousarray(image), p, MOVING_COLOUR)
    outlines, _ = cv2.findContours((p > 127).astype(np.uint8), cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
    thickness = max(1, round(size[0] / 400))
    return np.asarray(cv2.drawContours(out, outlines, -1, (255, 255, 255), thickness, cv2.LINE_AA))


def tinted(image: Array, level: Array, colour: tuple[float, float, float]) -> Array:
    """The image (h, w, 3) uint8, a quarter of its colour gone, and ``colour`` over it as ``level`` (h, w) uint8 says.

    By OpenCV's fused passes: a run draws every frame.
    """
    pale = cv2.transform(image, 0.75 * np.eye(3) + 0.25 / 3)
    share = level.astype(np.float32) * np.float32(0.6 / 255)
    over = np.empty_like(image)
    over[:] = np.array(colour, np.uint8)
    return np.asarray(cv2.blendLinear(pale, over, 1 - share, share))


def difference(photograph: Array, splat: Array) -> Array:
    """|photograph - splat|, mean over channels, black at 0 and brightest at a quarter of the range."""
    apart = np.abs(photograph.astype(np.float32) - splat.astype(np.float32)).mean(2) / 255
    level = np.clip(apart / DIFFERENCE_FULL_SCALE * 255, 0, 255).astype(np.uint8)
    return np.asarray(cv2.applyColorMap(level, cv2.COLORMAP_INFERNO))[..., ::-1]
