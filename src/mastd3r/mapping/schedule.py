"""How a training is spent, by steps or by time: small images first, full ones last."""

from __future__ import annotations

import time
from dataclasses import dataclass

SMALLEST_PX = 150  # width below which images are not made smaller
SHRINKS = (4, 2, 1)
EXPOSURE_FADES = (0.75, 0.9)  # share of the training from which, and at which, exposures go into the colours
STEP_SHARES = (0.2, 0.3, 0.5)  # of the steps; a level that is left out gives its share to the next larger one
TIME_SHARES = (0.07, 0.18, 0.75)  # of the time, where that is what is given


@dataclass(frozen=True)
class Level:
    """A part of the training on images of one size."""

    shrink: int  # images are a shrink-th of the views' width
    until: float  # share of the training at which it ends


def levels(width_px: int, shares: tuple[float, ...] = STEP_SHARES) -> tuple[Level, ...]:
    """From small to full size, for views of ``width_px``."""
    found, done, waiting = [], 0.0, 0.0
    for shrink, share in zip(SHRINKS, shares, strict=True):
        if shrink > 1 and width_px / shrink < SMALLEST_PX:
            waiting += share
            continue
        done, waiting = done + share + waiting, 0.0
        found.append(Level(shrink, 1.0 if shrink == 1 else done))
    return tuple(found)


class Pace:
    """How far a training is, 0..1: by the steps that it has, or by the seconds where some are given."""

    def __init__(self, width_px: int, steps: int, steps_done: int = 0, seconds: float | None = None) -> None:
        """``steps_done`` of ``steps`` are behind; the rest of the schedule is spent over ``seconds``, where given."""
        self.steps, self._all, self._seconds = steps_done, steps, seconds
        self._from = min(1.0, steps_done / max(1, steps))
        self._levels = levels(width_px, STEP_SHARES if seconds is None else TIME_SHARES)
        self._began = time.monotonic()

    @property
    def done(self) -> float:
        """1 at the end."""
        if self._seconds is not None:
            passed = (time.monotonic() - self._began) / max(self._seconds, 1e-9)
            return min(1.0, self._from + (1 - self._from) * passed)
        return min(1.0, self.steps / max(1, self._all))

    @property
    def exposure_share(self) -> float:
        """How much of its own exposure a view is drawn with, 1 to 0.

        A file has one colour for all who look at it. Exposures of their own keep the views from contradicting one
        another while the world takes shape; at the end every place takes the colours of those who see it.
        """
        first, last = EXPOSURE_FADES
        return min(1.0, max(0.0, (last - self.done) / (last - first)))

    @property
    def shrink(self) -> int:
        """Images are now a shrink-th of the views' width."""
        done = self.done
        return next((level.shrink for level in self._levels if done < level.until), self._levels[-1].shrink)
