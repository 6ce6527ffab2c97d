"""The protocol that every pointmap provider follows."""

from __future__ import annotations

from typing import Protocol

from ..types import Frame, Guess, PairPrediction, WorkFrame


class PointmapProvider(Protocol):
    """Two methods: look at one frame, and at a pair. A network adds one file that has them."""

    name: str
    depth_sigma_ratio: float | None  # relative 1-sigma of the depth measured in one frame; None: measures none

    def observe(self, frame: Frame, near: WorkFrame | None = None) -> WorkFrame:
        """What can be said of a frame alone: working image, pixels to match, own depth.

        ``near``: a frame that sees the same place, for a network that looks at pairs only.
        """
        ...

    def predict(self, ref: WorkFrame, new: WorkFrame, guess: Guess) -> PairPrediction:
        """Both pointmaps in ref's camera, confidences and matches of ref's chosen pixels."""
        ...
