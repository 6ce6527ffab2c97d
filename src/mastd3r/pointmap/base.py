"""The protocol that every pointmap provider follows."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Protocol

from ..types import Frame, Guess, PairPrediction, WorkFrame


class PointmapProvider(Protocol):
    """Look at one frame, and at a pair. A network adds one file that has these methods."""

    name: str
    depth_sigma_ratio: float | None  # relative 1-sigma of the depth measured in one frame; None: measures none
    finds_far: bool  # ``predict`` matches views of one place without a start, however far apart in the image
    side_by_side: bool  # ``predict`` may be asked in two threads at once

    def look(self, frame: Frame) -> WorkFrame:
        """What can be said of a frame alone: working image, pixels to match, own depth. May run in another thread."""
        ...

    def beside(self, work: WorkFrame, near: WorkFrame | None) -> WorkFrame:
        """The same with what a network that looks at pairs only can say of it. May run in another thread.

        ``near``: a frame that sees the same place; None: the frame itself.
        """
        ...

    def expect(self, pairs: Sequence[tuple[WorkFrame, WorkFrame]]) -> None:
        """These (ref, new) and their reverses are about to be predicted: a network may look at them together."""
        ...

    def predict(self, ref: WorkFrame, new: WorkFrame, guess: Guess) -> PairPrediction:
        """Both pointmaps in ref's camera, confidences and matches of ref's chosen pixels."""
        ...


class Observing:
    """Both looks at once."""

    def observe(self: PointmapProvider, frame: Frame, near: WorkFrame | None = None) -> WorkFrame:
        """What can be said of a frame, alone and beside one that sees the same place."""
        return self.beside(self.look(frame), near)
