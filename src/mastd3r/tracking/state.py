"""Where tracking stands: one frozen value, replaced after every frame and never edited."""

from __future__ import annotations

from dataclasses import dataclass, field
from enum import StrEnum
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..concurrency import Future
from ..graph.keyframe_graph import Keyframe, KeyframeGraph
from ..types import WorkFrame

Array = NDArray[Any]


class Status(StrEnum):
    """What the camera is known of."""

    INITIALISING = "initialising"  # frames are matched, but lens and structure are not found yet
    TRACKING = "tracking"  # the last frame has a pose in the map
    RELOCALISING = "relocalising"  # what follows a loss has no structure yet, and is looked for in the map
    LOST = "lost"  # the last frame shows nothing that could be placed


@dataclass(frozen=True)
class TrackedFrame:
    """The last frame that was placed."""

    work: WorkFrame
    moving: Future[Array]  # (h, w) P(moving), which may still be in the making


@dataclass(frozen=True)
class TrackingState:
    """What the next frame is tracked from."""

    status: Status = Status.INITIALISING
    reason: str = ""  # why it is lost or starts anew; empty otherwise
    anchor: Keyframe | None = None  # the keyframe that frames are tracked against
    cam_from_anchor: Array = field(default_factory=lambda: np.eye(4))  # of the last tracked frame
    flow: Array | None = None  # (h, w, 2) anchor -> last frame; None: that is the anchor itself, or shows nothing
    most_matched: int = 0  # by any frame since the anchor was chosen
    last: TrackedFrame | None = None
    anchor_before_loss: Keyframe | None = None


def status_in(graph: KeyframeGraph) -> Status:
    """The status of a frame that was placed in this graph."""
    if graph.initialised:
        return Status.TRACKING
    return Status.RELOCALISING if graph.started else Status.INITIALISING
