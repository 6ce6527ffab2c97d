"""People as the semantic prior of eq. (2): P(D|S) from a network that finds people, asked where it is worth asking."""

from __future__ import annotations

import threading
from collections import deque
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from ..types import Frame
from .config import SemanticConfig

Array = NDArray[Any]
UNSURE = 1.0  # log-odds of the evidence below which it says nothing, either way
STILL_SHARE, MOVING_SHARE = 0.3, 0.03  # of a figure, that is seen to stand still, at least, and to move, at most
AGAIN_S = 0.25  # where nobody was seen, after which people are looked for again
TOLERANCE_S = 1e-6  # of times, which are sums
SOMEBODY = 0.005  # share of the image that is a person with P > 0.5, below: nobody is seen
REMEMBERED = 8  # frames that were looked at


def believed(semantic: Array | None, log_odds: Array, config: SemanticConfig) -> Array | None:
    """A map (h, w) as it is believed beside the evidence: one that shows people only, without those who stand still."""
    return semantic if semantic is None or config.shows_all else without_still(semantic, log_odds)


def without_still(shown: Array, log_odds: Array) -> Array:
    """A map of figures without those of which much is seen to stand still and nothing to move.

    A bust, a coat on a chair, a cupboard that a network takes for somebody: where it has no texture to be seen by, it
    would be held to move otherwise. Somebody who stands goes with them for as long as nothing of him stirs.

    ``shown`` (h, w) float32; ``log_odds`` of the evidence, of another size perhaps.
    """
    h, w = log_odds.shape
    small = cv2.resize(shown, (w, h), interpolation=cv2.INTER_AREA)
    count, figures = cv2.connectedComponents((small > 0.5).astype(np.uint8), connectivity=4)
    if count == 1:
        return shown
    figures = figures.ravel()
    size = np.bincount(figures, minlength=count)
    still = np.bincount(figures, (log_odds < -UNSURE).ravel(), count) > STILL_SHARE * size
    moves = np.bincount(figures, (log_odds > UNSURE).ravel(), count) > MOVING_SHARE * size
    gone = still & ~moves
    gone[0] = False
    if not gone.any():
        return shown
    away = cv2.dilate(gone[figures].reshape(h, w).astype(np.uint8), np.ones((5, 5), np.uint8))
    return np.where(cv2.resize(away, shown.shape[::-1], interpolation=cv2.INTER_NEAREST) > 0, np.float32(0), shown)


class PeoplePrior:
    """Fills frames with P(person), every frame while somebody is in sight, else four a second.

    Whether a frame is looked at depends on its time and on the looks before it, not on who asks or how often.
    """

    shows_all = False  # of what can move: people only

    def __init__(self, network: Callable[[Array], Array], note: str) -> None:
        """``network``: RGB image (h, w, 3) uint8 to P(person), (h', w') float32."""
        self.notes = (note,)
        self._network = network
        self._looks: deque[tuple[float, bool]] = deque(maxlen=REMEMBERED)  # time, and whether somebody was seen
        self._one_at_a_time = threading.Lock()

    def fill(self, frame: Frame) -> Frame:
        """The frame with P(person) as its semantic map, or as it is where nobody is seen or looked for."""
        with self._one_at_a_time:
            if not self._due(frame.timestamp_s):
                return frame
            found = self._network(frame.image)
            somebody = bool(np.count_nonzero(found > 0.5) >= SOMEBODY * found.size)
            self._looks.append((frame.timestamp_s, somebody))
        return replace(frame, semantic=found) if somebody else frame

    def features(self, frame: Frame) -> None:
        """None: descriptors are made of the image."""
        return

    def memory(self) -> tuple[tuple[float, bool], ...]:
        """What decides where it looks next."""
        with self._one_at_a_time:
            return tuple(self._looks)

    def remember(self, memory: tuple[tuple[float, bool], ...]) -> None:
        """What ``memory`` gave."""
        with self._one_at_a_time:
            self._looks.extend(memory)

    def forget(self) -> None:
        """The next frame is the first of a video."""
        with self._one_at_a_time:
            self._looks.clear()

    def _due(self, time_s: float) -> bool:
        last = max((look for look in self._looks if look[0] < time_s), default=None)
        return last is None or last[1] or time_s - last[0] > AGAIN_S - TOLERANCE_S
