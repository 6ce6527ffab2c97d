"""How well P(moving) finds the pixels that truly move."""

from __future__ import annotations

import logging
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from ..errors import InputError
from ..reading.files import whole_bytes
from ..reading.pictures import decoded

Array = NDArray[Any]
log = logging.getLogger(__name__)
MIN_MOVING_RATIO = 0.01  # below this share of moving pixels, IoU says little


@dataclass(frozen=True)
class MaskError:
    """Figures over a sequence; None where nothing was there to judge."""

    iou: float | None  # mean over the frames in which at least 1 % of the pixels move
    false_positive_ratio: float | None  # mean share of pixels called moving that are not, all frames
    called_moving_ratio: float | None  # mean share of pixels called moving, all frames
    n_frames: int  # frames with an estimated mask
    n_moving: int  # of these, frames that IoU is the mean of


class TrueMasks:
    """The true masks of a sequence by stamp; those that cannot be read are left out, and told of: they stop no run."""

    def __init__(self, files: Mapping[str, str]) -> None:
        self._files = dict(files)
        self.broken: dict[str, str] = {}  # stamp -> what is wrong

    def __bool__(self) -> bool:
        return bool(self._files)

    def read(self, stamp: str) -> Array | None:
        """(h, w) uint8; None where there is none: nothing moves there, unless the stamp is among ``broken``."""
        if stamp not in self._files or stamp in self.broken:
            return None
        try:
            return read_mask(self._files[stamp])
        except InputError as e:
            self.broken[stamp] = str(e)
            return None

    def tell(self) -> None:
        """Log how many were left out."""
        if self.broken:
            first = next(iter(self.broken.values()))
            log.warning("true masks that cannot be read are left out: %d, the first: %s", len(self.broken), first)


def mask_error(pairs: Iterable[tuple[Array, Array | None]]) -> MaskError:
    """Compare (P(moving), truth) pairs, both (h, w) uint8, one a frame; truth None = nothing moves.

    P is resized bilinearly to the truth's size; a value above 127 is moving.
    """
    ious: list[float] = []
    wrong: list[float] = []
    called: list[float] = []
    for probability, truth in pairs:
        truly = np.zeros(probability.shape, bool) if truth is None else truth > 127
        size = (truly.shape[1], truly.shape[0])
        moving = np.asarray(cv2.resize(probability, size, interpolation=cv2.INTER_LINEAR)) > 127
        called.append(float(moving.mean()))
        wrong.append(float((moving & ~truly).mean()))
        if truly.mean() >= MIN_MOVING_RATIO:
            ious.append(float((moving & truly).sum() / (moving | truly).sum()))
    return MaskError(_mean(ious), _mean(wrong), _mean(called), len(called), len(ious))


def read_mask(path: Path | str) -> Array:
    """An 8-bit image as (h, w) uint8. Raises InputError where it is missing or unreadable."""
    path = Path(path)
    return np.asarray(decoded(whole_bytes(path, "a readable image"), path, cv2.IMREAD_GRAYSCALE))


def _mean(values: list[float]) -> float | None:
    return float(np.mean(values)) if values else None
