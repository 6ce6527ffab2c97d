"""What the masks of the second pass say of the matches that the poses of frames came from."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from .finish import FinalFrame, final_frames
from .graph.keyframe_graph import FrameRecord, KeyframeGraph
from .view_depth import static_at

Array = NDArray[Any]
LEAST = 0.02  # of a match's weight stays: a frame of which all is said to move still has a pose


class LateMasks:
    """Masks that know final poses and the frames after. While tracking, a match was weighed by less."""

    def __init__(self) -> None:
        self._targets: dict[int, Array] = {}  # frame index -> (m,) float32 P(static) where its matches are
        self._keyframes: dict[int, Array] = {}  # kf id -> (h, w) uint8, 255 x P(moving)

    def see(self, record: FrameRecord, moving: Array) -> None:
        """The mask of one frame, (h, w) P(moving) at working size."""
        self._targets[record.index] = static_at(moving, record.target).astype(np.float32)
        if record.is_keyframe:
            self._keyframes[record.kf_id] = np.rint(255 * moving).astype(np.uint8)

    def poses(self, graph: KeyframeGraph) -> list[FinalFrame]:
        """Every frame's pose from the matches that the masks leave.

        Keyframes stay where the joint optimisation put them: their chain needs every match that it has.
        """
        self.weigh(graph)
        return final_frames(graph)

    def weigh(self, graph: KeyframeGraph) -> None:
        """The matches that frames keep of their keyframes count by P(static) at both ends."""
        static = {k: _static(m, graph.blocks[k].px) for k, m in self._keyframes.items()}
        for r in graph.records:
            if len(r.points):
                at_keyframe = static[r.kf_id][r.points] if r.kf_id in static else 1.0
                at_frame = np.maximum(self._targets.get(r.index, 1.0), LEAST)
                r.weight = (r.weight * at_frame * at_keyframe).astype(np.float32)


def _static(moving: Array, px: Array) -> Array:
    return np.maximum(static_at(moving / np.float32(255), px), LEAST)
