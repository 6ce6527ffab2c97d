"""The masks of the second pass by the filter alone: every mask knows the frames before it, under their final poses."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from typing import Any, Protocol, TypeVar

from numpy.typing import NDArray

from .data import DynamicMask, DynamicsInput

Array = NDArray[Any]
T = TypeVar("T")
MOVING = 0.5  # P(moving) of a pixel that counts as moving, where no pose says more


class Filter(Protocol):
    """What is asked of a filter; see ``protocols.DynamicsFilter``."""

    appearance: Any

    def prior(self, gray: Array, semantic: Array | None = None, features: Array | None = None) -> Array:
        """(h, w) P(moving) before the pose is known."""
        ...

    def update(self, frame: DynamicsInput) -> DynamicMask:
        """The mask once it is."""
        ...


class CausalMasks:
    """A smoother that looks back only: half the work of one that looks both ways, and its masks are a little worse."""

    def __init__(self, dynamics: Filter, appearance: Any = None) -> None:
        """``dynamics``: a filter that has seen nothing; ``appearance``: what another learned of moving things."""
        self._filter = dynamics
        if appearance is not None:
            dynamics.appearance = appearance

    def masks(self, inputs: Iterable[tuple[DynamicsInput, T]]) -> Iterator[tuple[DynamicMask, T]]:
        """One mask an input, at once, with what came beside it; of a frame whose pose is a guess, its prior."""
        for frame, beside in inputs:
            prior = self._filter.prior(frame.gray, frame.semantic, frame.features)
            yield self._filter.update(frame) if frame.pose_known else DynamicMask(prior, prior > MOVING, {}), beside
