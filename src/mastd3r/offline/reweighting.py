"""What the masks of the smoothing pass say of the matches that the poses of frames came from."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..dynamics.soft_mask import static_at
from ..graph.keyframe_graph import FrameRecord, KeyframeGraph
from .final_solve import FinalFrame, final_frames

Array = NDArray[Any]
LEAST = 0.02  # of a match's weight stays: a frame of which all is said to move still has a pose


class MaskReweighting:
    """Masks that know final poses and the frames after. While tracking, a match was weighed by less."""

    def __init__(self) -> None:
        self._targets: dict[int, Array] = {}  # frame index -> (m,) float32 P(static) where its matches are
        self._anchors: dict[int, Array] = {}  # kf id -> (p,) float32 P(static) at its px

    def see(self, graph: KeyframeGraph, record: FrameRecord, moving: Array) -> None:
        """The mask of one frame, (h, w) P(moving) at working size."""
        self._targets[record.index] = _static(moving, record.target)
        if record.is_keyframe:
            self._anchors[record.kf_id] = _static(moving, graph.variables[record.kf_id].px)

    def poses(self, graph: KeyframeGraph) -> list[FinalFrame]:
        """Every frame's pose from the matches that the masks leave.

        Keyframes stay where the joint optimisation put them: their chain needs every match that it has.
        """
        self.weigh(graph)
        return final_frames(graph)

    def weigh(self, graph: KeyframeGraph) -> None:
        """The matches that frames keep of their keyframes count by P(static) at both ends."""
        for r in graph.records:
            anchor = self._anchors.get(r.kf_id)
            at_keyframe = np.float32(1) if anchor is None else anchor[r.points]
            graph.set_weights(r, r.weight * self._targets.get(r.index, np.float32(1)) * at_keyframe)


def _static(moving: Array, px: Array) -> Array:
    return np.maximum(static_at(moving, px), LEAST).astype(np.float32)
