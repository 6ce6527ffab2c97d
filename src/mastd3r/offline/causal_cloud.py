"""The static cloud while tracking: keyframe points with the colours and masks that they were tracked with."""

from __future__ import annotations

from collections import deque
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from ..graph.keyframe_graph import KeyframeGraph
from ..types import Frame, StaticCloud
from .static_cloud import static_cloud

Array = NDArray[Any]
HELD = 2  # frames: the last one may become a keyframe when the next is lost


class CausalCloud:
    """Colours are taken when a frame becomes a keyframe, so that no image is held for longer than two frames."""

    def __init__(self, graph: KeyframeGraph) -> None:
        self._graph = graph
        self._last: deque[Frame] = deque(maxlen=HELD)
        self._known = 0  # keyframes that were looked at
        self._colors: dict[int, tuple[int, Array]] = {}  # by keyframe: the frame that it was, (p, 3) uint8

    def see(self, frame: Frame) -> None:
        """A frame has been tracked: it, or the one before, may be a keyframe now."""
        self._last.append(frame)
        self.take_colors()

    def take_colors(self) -> None:
        """Of keyframes that are new. One of a frame that is held no longer stays without, and out of the cloud."""
        images = {f.index: f.image for f in self._last}
        self._known = min(self._known, len(self._graph.keyframes))  # a submap may have been dropped
        for kf in self._graph.keyframes[self._known :]:
            if kf.work.index in images:
                small = cv2.resize(images[kf.work.index], self._graph.size, interpolation=cv2.INTER_AREA)
                at = np.clip(np.round(kf.work.px), 0, np.array(self._graph.size) - 1).astype(int)
                self._colors[kf.id] = kf.work.index, np.asarray(small)[at[:, 1], at[:, 0]]
        self._known = len(self._graph.keyframes)

    def colors(self) -> dict[int, Array]:
        """(p, 3) uint8 RGB at the px of each keyframe that has a place, by its id."""
        graph = self._graph
        placed = {kf.id: kf.work.index for kf in graph.keyframes if graph.submap_of[kf.id] in graph.started}
        return {k: c for k, (frame, c) in self._colors.items() if placed.get(k) == frame}

    def moving(self) -> dict[int, Array]:
        """(p,) P(moving) of the same."""
        keyframes = {kf.id: kf for kf in self._graph.keyframes}
        return {k: 1 - keyframes[k].static for k in self.colors()}

    def whole(self) -> StaticCloud:
        """The static points of all submaps, once they stand in one world."""
        return static_cloud(self._graph, self.colors(), self.moving())

    def cloud(self) -> StaticCloud:
        """The static points now, of the submap that is tracked; of the largest where that has no depth yet."""
        graph, moving = self._graph, self.moving()
        colors = self.colors()
        sizes = {s: len(graph.members(s)) for s in sorted(graph.started)}
        shown = graph.submap if graph.initialised or not sizes else max(sizes, key=lambda s: sizes[s])
        return static_cloud(graph, {k: c for k, c in colors.items() if graph.submap_of[k] == shown}, moving)
