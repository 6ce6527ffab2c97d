"""The evidence terms of one frame as pictures: what each of them says about every pixel."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from .pictures import mask_overlay

Array = NDArray[Any]
FULL_SCALE_LOG = 4.0  # natural log-likelihood ratio that is drawn in full colour
TITLES = {
    "motion": "motion: flow and grey values against the rigid scene",
    "depth": "depth: measured against the map",
    "time": "time: the log-odds of the frames around",
    "semantic": "semantic prior",
    "appearance": "appearance, learned from this video",
    "anomaly": "depth anomaly, eq. (1)",
}
GREY, MOVING, STILL = (np.array(c, np.float32) for c in ((216, 216, 216), (202, 0, 32), (5, 82, 176)))


@dataclass(frozen=True)
class EvidenceSample:
    """One frame, its mask, and the terms that led to it."""

    timestamp_s: float
    image: Array  # (h, w, 3) uint8 RGB
    probability: Array  # (h, w) float32 P(moving)
    terms: Mapping[str, Array]  # name -> (h', w') float32 log-likelihood ratio


def panel(sample: EvidenceSample) -> list[tuple[str, Array]]:
    """(caption, (h, w, 3) uint8 RGB) of every term, and of the mask that they give together, first."""
    size = (sample.image.shape[1], sample.image.shape[0])
    levels = np.rint(255 * np.clip(sample.probability, 0, 1)).astype(np.uint8)
    out = [("all together: P(moving)", mask_overlay(sample.image, levels))]
    for name, term in sample.terms.items():
        full = np.asarray(cv2.resize(term.astype(np.float32), size, interpolation=cv2.INTER_LINEAR))
        out.append((TITLES.get(name, name), signed_colours(full / FULL_SCALE_LOG)))
    return out


def signed_colours(values: Array) -> Array:
    """(h, w) in -1 … 1 to (h, w, 3) uint8: blue, grey, red; beyond is clipped."""
    v = np.clip(values, -1, 1)[..., None]
    return np.rint(GREY + np.maximum(v, 0) * (MOVING - GREY) + np.maximum(-v, 0) * (STILL - GREY)).astype(np.uint8)
