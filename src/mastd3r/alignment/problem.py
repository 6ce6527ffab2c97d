"""What the stages of the alignment are given of a pair."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..types import Matches, PairPrediction, Pointmap
from .reproject import StaticMatches

Array = NDArray[Any]


@dataclass(frozen=True)
class AlignmentProblem:
    """A new view against its anchor keyframe."""

    pair: PairPrediction
    weight: Array  # (p,) static weight of each match, eq. (5)(6)
    matches: StaticMatches | None  # the same with the anchor's depths; None before the map has structure
    guess: Array  # (4, 4) new_from_ref
    sigma_ratio: float | None  # relative 1-sigma of new's own points; None: it has none

    @staticmethod
    def nothing(guess: Array) -> AlignmentProblem:
        """No match at all: there is no anchor, or the image is blank."""
        none = np.zeros((0, 2))
        ref = Pointmap(none, np.zeros((0, 3)), np.zeros(0))
        pair = PairPrediction(Matches(none, none, np.zeros(0)), ref, None, np.zeros((0, 0, 2), np.float32))
        return AlignmentProblem(pair, np.zeros(0), None, guess, None)
