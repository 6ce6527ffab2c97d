"""More than 8 bits of grey (thermal cameras, machine vision) as 8 bits, in the same way in all frames of a sequence."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

Array = NDArray[Any]
TOP = 65535
SAMPLED = 16  # frames that the range is found from
SAMPLED_PIXELS = 20_000  # of each
PERCENTILES = (0.5, 99.5)  # of the levels: a defective pixel or a lamp has no say
WIDENED_RATIO = 0.05  # of the range, at both ends: frames between the samples
WHOLE_RATIO = 0.5  # of all levels; a sequence that uses more is read over the whole of them
LEAST_LEVELS = 64  # a range narrower than this is the sensor's noise


@dataclass(frozen=True)
class GreyRange:
    """Levels of 16 bits that become 0 and 255."""

    low: int = 0
    high: int = TOP

    @property
    def whole(self) -> bool:
        """True where 16 bits are divided by 257."""
        return (self.low, self.high) == (0, TOP)

    @property
    def note(self) -> str:
        """One line for the notes."""
        return f"16-bit grey: levels {self.low} to {self.high} become 0 to 255, the same in all frames"

    def as_8_bit(self, levels: Array) -> NDArray[np.uint8]:
        """(h, w) integers in 0..65535 as (h, w) uint8, rounded, cut off at both ends."""
        return self._table[levels]

    @cached_property
    def _table(self) -> NDArray[np.uint8]:
        scaled = (np.arange(TOP + 1) - self.low) * (255 / (self.high - self.low))
        return np.clip(np.rint(scaled), 0, 255).astype(np.uint8)


WHOLE = GreyRange()


def spread(indices: range | list[int], most: int = SAMPLED) -> list[int]:
    """At most so many of the indices, evenly spread, first and last among them."""
    at = np.unique(np.linspace(0, len(indices) - 1, min(most, len(indices))).round().astype(int))
    return [indices[k] for k in at]


def range_of(samples: Iterable[Array]) -> GreyRange | None:
    """The range that a sequence uses, by some of its frames (h, w) in 0..65535; None without any."""
    taken = [levels.ravel()[:: max(1, levels.size // SAMPLED_PIXELS)] for levels in samples]
    if not taken:
        return None
    low, high = np.percentile(np.concatenate(taken), PERCENTILES)
    wider = max(WIDENED_RATIO * (high - low), (LEAST_LEVELS - (high - low)) / 2)
    low, high = low - wider, high + wider
    if high - low >= WHOLE_RATIO * TOP:
        return WHOLE
    return GreyRange(max(int(np.floor(low)), 0), min(int(np.ceil(high)), TOP))
