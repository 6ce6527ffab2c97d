"""The variant ``none``: nothing moves."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from .config import DynamicsConfig
from .data import DynamicMask, DynamicsInput, WithoutMemory, check_image, check_input

Array = NDArray[Any]
T = TypeVar("T")


class NothingMoves(WithoutMemory):
    """Filter and smoother at once; it has no memory."""

    appearance = None

    def __init__(self, width: int, height: int) -> None:
        self.width, self.height = width, height

    def prior(self, gray: Array, semantic: Array | None = None, features: Array | None = None) -> Array:
        """(h, w) float32 zeros. Raises InputError for an image of another size."""
        check_image(gray, "gray", self.width, self.height)
        return np.zeros((self.height, self.width), np.float32)

    def update(self, frame: DynamicsInput) -> DynamicMask:
        """A mask of zeros. Raises InputError for images of another size."""
        check_input(frame, self.width, self.height)
        nothing = np.zeros((self.height, self.width), np.float32)
        return DynamicMask(nothing, nothing > 0.5, {})

    def masks(self, inputs: Iterable[tuple[DynamicsInput, T]]) -> Iterator[tuple[DynamicMask, T]]:
        """One mask an input, at once, with what came beside it."""
        for frame, beside in inputs:
            yield self.update(frame), beside


class StaticModel:
    """A scene in which nothing moves."""

    needs_features = False

    def filter(self, width: int, height: int) -> NothingMoves:
        """For images of this working size."""
        return NothingMoves(width, height)

    def smoother(self, width: int, height: int, appearance: Any = None) -> NothingMoves:
        """For images of this working size."""
        return NothingMoves(width, height)


def build(_config: DynamicsConfig) -> StaticModel:
    """For the registry."""
    return StaticModel()
