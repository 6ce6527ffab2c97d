"""What an alignment gives back: the transform and how well it fits."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from numpy.typing import NDArray

Array = NDArray[Any]


@dataclass(frozen=True)
class Alignment:
    """Pose of a new view against its reference."""

    new_from_ref: Array  # (4, 4) rigid
    scale: float  # factor that brings new's own points to ref's scale; 1 where new has no own points
    converged: bool
    inlier_ratio: float  # share of the weighted matches within 2 px (3 sigma for own points)
    error_px: float  # median re-mapping residual of the weighted matches, inf without any
    stages: tuple[str, ...]  # what ran, in order
    has_failed: bool = False  # nothing could be solved; the pose is the guess

    @staticmethod
    def failed(new_from_ref: Array, stage: str) -> Alignment:
        """Nothing could be solved; the pose is the guess."""
        return Alignment(new_from_ref, 1.0, False, 0.0, float("inf"), (stage,), True)
