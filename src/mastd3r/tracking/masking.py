"""III-A beside the main loop: the mask of a frame is made while the next one is matched."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..concurrency import Future, Worker
from ..dynamics.soft_mask import dilated
from ..geometry.se3 import inverse
from ..graph.keyframe_graph import KeyframeGraph
from ..protocols import DynamicsFilter
from .mask_input import dynamics_input
from .observation import Observation
from .two_view import TwoView

Array = NDArray[Any]


class MaskTracker:
    """Owns the filter of the mask, which lives in a thread of its own: it is updated while the next frame is matched.

    P(moving) is dilated by the matching window: a match near a moving thing sees it too.
    """

    def __init__(self, dynamics: DynamicsFilter, graph: KeyframeGraph) -> None:
        self.filter, self._graph = dynamics, graph
        self._worker, self._closed = Worker("mask"), False

    def prior(self, seen: Observation) -> Future[Array]:
        """(h, w) P(moving) before the pose is known: the prior of eq. (2)."""
        work = seen.work
        if seen.blank:
            return Future.done(np.zeros(work.gray.shape, np.float32))
        return self._worker.submit(lambda: dilated(self.filter.prior(work.gray, work.semantic, seen.features.get())))

    def update(self, seen: Observation, view: TwoView | None, prior: Future[Array]) -> Future[Array]:
        """(h, w) P(moving) under the frame's pose, eq. (1)-(4); the prior where the map has no structure to tell."""
        graph = self._graph
        if view is None or not graph.initialised:
            return prior
        cam_from_world = view.alignment.new_from_ref @ graph.variables[view.anchor.id].cam_from_world
        given = dynamics_input(graph, view.anchor.id, inverse(cam_from_world), seen.work, view.alignment.scale)
        return self._worker.submit(
            lambda: dilated(self.filter.update(replace(given, features=seen.features.get())).probability)
        )

    def memory(self) -> Any:
        """What the filter remembers, once all that was asked of it is done."""
        what = self.filter.memory  # type: ignore[attr-defined]
        return what() if self._closed else self._worker.submit(what).get()

    def remember(self, memory: Any) -> None:
        """What ``memory`` gave."""
        self.filter.remember(memory)  # type: ignore[attr-defined]

    def close(self) -> None:
        """End the thread, once all that was asked of it is done."""
        self._worker.close()
        self._closed = True
