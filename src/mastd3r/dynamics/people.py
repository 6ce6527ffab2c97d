"""People as the semantic prior of eq. (2): P(D|S) from a network that finds people, asked where it is worth asking."""

from __future__ import annotations

import logging
import threading
from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from ..types import Frame
from .config import SemanticConfig

Array = NDArray[Any]
Looks = tuple[tuple[float, bool], ...]  # time, and whether somebody was seen
Turns = tuple[int, tuple[tuple[float, tuple[float, ...], tuple[float, ...]], ...]]  # first; time, shares by turn
Shares = tuple[Array, Array]  # of an image that are surely and perhaps people, of each turn (4,)
log = logging.getLogger(__name__)
UNSURE = 1.0  # log-odds of the evidence below which it says nothing, either way
STILL_SHARE, MOVING_SHARE = 0.3, 0.03  # of a figure, that is seen to stand still, at least, and to move, at most
AGAIN_S = 0.25  # where nobody was seen, after which people are looked for again
TOLERANCE_S = 1e-6  # of times, which are sums
SOMEBODY = 0.005  # share of the image that is a person with P > 0.5, below: nobody is seen
REMEMBERED = 8  # frames that were looked at
TURN_AGAIN_S, TURN_SOON_S = 1.0, 0.25  # after which it is found again which way up people are; at first
TURNS_REMEMBERED, TURNS_SOON = 32, 16  # times that this was found; that it is found soon again
LEAST_TURNS = 8  # times that somebody was perhaps seen, before a turn is believed
SURELY, PERHAPS = 0.9, 0.1  # P(person): people the right way up are shown surely, others, and what is none, vaguely
MOSTLY_SURE = 0.25  # share of what is perhaps people that surely is, below: nobody
SURE_TURNED = 0.4  # the same of a turn, below: it is not believed
BETTER_TURNED = 1.2  # times that share of the picture as it is, for a turn to be taken


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

    A network that has learned from people who stand does not know them in pictures that lie on their side, as of a
    camera that was held or built in so. Once a second a picture is shown to it in all four turns.
    Whether a frame is looked at, and how, depends on its time and on the looks before it, not on who asks or how often.
    """

    shows_all = False  # of what can move: people only

    def __init__(self, network: Callable[[Array], Array], note: str) -> None:
        """``network``: RGB image (h, w, 3) uint8 to P(person), (h', w') float32."""
        self.notes = (note,)
        self._network = network
        self._looks: deque[tuple[float, bool]] = deque(maxlen=REMEMBERED)  # time, and whether somebody was seen
        self._turns = _Turns()
        self._found: dict[float, tuple[bool, Shares | None]] = {}  # by time: somebody, and what turns were compared by
        self._known: dict[float, tuple[bool, Shares | None]] = {}  # the same, of the pass before
        self._one_at_a_time = threading.Lock()

    def fill(self, frame: Frame) -> Frame:
        """The frame with P(person) as its semantic map, or as it is where nobody is seen or looked for."""
        time_s = frame.timestamp_s
        with self._one_at_a_time:
            if not self._due(time_s):
                return frame
            found = self._again(frame) if time_s in self._known else self._looked(frame)
            self._looks.append((time_s, found is not None))
        return frame if found is None else replace(frame, semantic=found)

    def features(self, frame: Frame) -> None:
        """None: descriptors are made of the image."""
        return

    def memory(self) -> tuple[Looks, Turns]:
        """What decides where it looks next, and which way up."""
        with self._one_at_a_time:
            return tuple(self._looks), self._turns.memory()

    def remember(self, memory: tuple[Looks, Turns]) -> None:
        """What ``memory`` gave."""
        with self._one_at_a_time:
            self._looks.extend(memory[0])
            self._turns.remember(memory[1])

    def forget(self) -> None:
        """The next frame is the first of the same video; the way up that was found last is where it begins.

        Where that is the way up that this pass began with, the next one would find the same of every image, and the
        network is asked only where somebody was seen.
        """
        with self._one_at_a_time:
            self._looks.clear()
            quarter = self._turns.quarter(np.inf)
            self._known = self._found if quarter == self._turns.first else {}
            self._found, self._turns = {}, _Turns(quarter)

    def _due(self, time_s: float) -> bool:
        last = max((look for look in self._looks if look[0] < time_s), default=None)
        return last is None or last[1] or time_s - last[0] > AGAIN_S - TOLERANCE_S

    def _looked(self, frame: Frame) -> Array | None:
        """P(person) of a frame; None where it shows nobody."""
        time_s, turns, shares = frame.timestamp_s, self._turns, None
        if turns.due(time_s):
            maps = [self._seen(frame.image, quarter) for quarter in range(4)]
            shares = _shares_of(maps)
            turns.compare(time_s, shares)
            found = maps[turns.quarter(time_s)]
        else:
            found = self._seen(frame.image, turns.quarter(time_s))
        somebody = turns.shows_somebody(time_s, found)
        self._found.setdefault(time_s, (somebody, shares))
        return found if somebody else None

    def _again(self, frame: Frame) -> Array | None:
        """``_looked`` of a frame that the pass before has looked at."""
        somebody, shares = self._found[frame.timestamp_s] = self._known[frame.timestamp_s]
        if shares is not None:
            self._turns.compare(frame.timestamp_s, shares)
        return self._seen(frame.image, self._turns.quarter(frame.timestamp_s)) if somebody else None

    def _seen(self, image: Array, quarter: int) -> Array:
        """P(person) by the network, of the image turned by ``quarter`` times 90 degrees, turned back."""
        found = self._network(np.ascontiguousarray(np.rot90(image, quarter)))
        return np.ascontiguousarray(np.rot90(found, -quarter))


class _Turns:
    """Which way up people are: the turn in which most of what is perhaps people surely is, over the last times."""

    def __init__(self, first: int = 0) -> None:
        """``first``: the turn that is taken until there is enough to tell."""
        self._shares: dict[float, Shares] = {}  # by time
        self.first = self._said = first

    def due(self, time_s: float) -> bool:
        """Whether it is to be found again at a time."""
        before = [t for t in self._shares if t < time_s]
        again_s = TURN_AGAIN_S if len(before) >= TURNS_SOON else TURN_SOON_S
        return not before or time_s - max(before) > again_s - TOLERANCE_S

    def compare(self, time_s: float, shares: Shares) -> None:
        """Add what the network shows of the four turns of one image."""
        self._shares[time_s] = shares
        for old in sorted(self._shares)[:-TURNS_REMEMBERED]:
            del self._shares[old]
        quarter = self.quarter(time_s)
        if quarter != self._said:
            self._said = quarter
            log.info("from %.2f s on people are looked for in images turned by %d degrees", time_s, 90 * quarter)

    def quarter(self, time_s: float) -> int:
        """How many quarters of a turn, counterclockwise, stand people up, as known until ``time_s``."""
        surely, perhaps, times = self._until(time_s)
        sure = surely / perhaps
        best = int(np.argmax(sure))
        if times < LEAST_TURNS or sure[best] < SURE_TURNED:
            return self.first
        return best if sure[best] > BETTER_TURNED * sure[0] else 0

    def shows_somebody(self, time_s: float, found: Array) -> bool:
        """Whether a map of the turn taken at a time shows somebody, by itself or by what was seen until then."""
        if np.count_nonzero(found > 0.5) < SOMEBODY * found.size:
            return False
        surely, perhaps, _ = self._until(time_s)
        quarter = self.quarter(time_s)
        own_surely, own_perhaps = _shares(found)
        return own_surely >= MOSTLY_SURE * own_perhaps or bool(surely[quarter] >= MOSTLY_SURE * perhaps[quarter])

    def _until(self, time_s: float) -> tuple[Array, Array, int]:
        """Surely and perhaps people by turn, (4,) each, and how often somebody was perhaps seen, until a time."""
        until = [shares for t, shares in self._shares.items() if t <= time_s]
        surely, perhaps = np.sum(until, axis=0) if until else np.zeros((2, 4))
        return surely, np.maximum(perhaps, SOMEBODY), sum(bool(p.max() >= SOMEBODY) for _, p in until)

    def memory(self) -> Turns:
        """What was found when, as numbers."""
        found = tuple((t, tuple(s.tolist()), tuple(p.tolist())) for t, (s, p) in self._shares.items())
        return self.first, found

    def remember(self, memory: Turns) -> None:
        """What ``memory`` gave."""
        self.first, found = memory
        self._shares = {t: (np.array(s), np.array(p)) for t, s, p in found}
        self._said = self.quarter(np.inf)


def _shares_of(maps: Sequence[Array]) -> Shares:
    """Shares of an image that are surely and perhaps people, of the four maps of its turns."""
    surely, perhaps = np.array([_shares(m) for m in maps]).T
    return surely, perhaps


def _shares(found: Array) -> tuple[float, float]:
    """Shares of an image that are surely and perhaps people."""
    return float((found > SURELY).mean()), float((found > PERHAPS).mean())
