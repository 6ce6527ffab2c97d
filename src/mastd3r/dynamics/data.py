"""What goes into the dynamic mask and what comes out."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from numpy.typing import NDArray

from ..camera.pinhole import Camera
from ..errors import InputError

Array = NDArray[Any]


@dataclass(frozen=True)
class DynamicsInput:
    """One frame with its pose and with what the map expects to be seen from there."""

    index: int
    timestamp_s: float
    gray: Array  # (h, w) uint8
    camera: Camera  # at (h, w)
    world_from_cam: Array  # (4, 4)
    inv_depth: Array  # (h, w) float32, 1 / map unit, of the static background
    inv_depth_sigma: Array  # (h, w) float32, 1 sigma; inf = unknown
    own_inv_depth: Array | None = None  # (h, w) float32 measured in this frame, 0 = none
    semantic: Array | None = None  # (h, w) float32 P(movable)
    color: Array | None = None  # (h, w, 3) uint8 RGB; the refinement follows its edges where it is there
    features: Array | None = None  # (h', w', c) float32 descriptors of any kind, for the appearance classifier
    pose_known: bool = True  # False: the pose is a guess, against which nothing can be said to move


@dataclass(frozen=True)
class DynamicMask:
    """P(moving) of every pixel, the decision, and the terms that led to it."""

    probability: Array  # (h, w) float32
    moving: Array  # (h, w) bool
    evidence: dict[str, Array]  # name -> (h', w') float32 log-likelihood ratio, for display


def check_image(image: Array, name: str, width: int, height: int) -> None:
    """Raises InputError for an image of another size."""
    if image.shape != (height, width):
        raise InputError(f"dynamics: expected {name} of {width}x{height}, got shape {image.shape}")


def check_input(frame: DynamicsInput, width: int, height: int) -> None:
    """Raises InputError for images of another size."""
    for name in ("gray", "inv_depth", "inv_depth_sigma", "own_inv_depth"):
        if getattr(frame, name) is not None:
            check_image(getattr(frame, name), name, width, height)


class WithoutMemory:
    """Of a filter that knows one frame alone: a run that goes on from a checkpoint has nothing to tell it."""

    def memory(self) -> None:
        """Nothing."""

    def remember(self, memory: None) -> None:
        """Nothing."""
