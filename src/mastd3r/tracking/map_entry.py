"""A video that goes on in a saved map: where it is found there for the first time."""

from __future__ import annotations

from typing import Any

from numpy.typing import NDArray

from ..concurrency import Future
from ..config import Config
from ..geometry.se3 import inverse
from ..graph.keyframe_graph import KeyframeGraph
from ..graph.prediction import rigid_flow_to
from ..parts import Parts
from ..types import WorkFrame
from .localisation import Localiser, Place
from .two_view import Start, TwoView, TwoViewEstimator

Array = NDArray[Any]
MAP = 0  # its submap


class MapEntry:
    """Looks for the video in the map, frame by frame, until it is found; after that nothing is asked here.

    Nothing else speaks for such a place, so that it takes what ``mastd3r localise`` asks for: keyframes that agree.
    """

    def __init__(self, config: Config, parts: Parts, graph: KeyframeGraph, two_view: TwoViewEstimator) -> None:
        self.graph, self.two_view = graph, two_view
        self._localiser = Localiser(config, parts, graph, MAP)

    @property
    def wanted(self) -> bool:
        """True while the video has not been found in the map that there is."""
        return self.graph.held > 0 and self.graph.found_at is None

    def open_to(self, ids: list[int]) -> list[int]:
        """Of some keyframes those that others may be compared with one by one: not a map before it is entered."""
        return [k for k in ids if not self.wanted or k >= self.graph.held]

    def view(self, work: WorkFrame, moving: Future[Array]) -> TwoView | None:
        """A frame seen from the keyframe of the map that shows most of it; None where it is not found.

        ``moving`` (h, w) P(moving).
        """
        place = self._localiser.find(work, moving.get()) if self.wanted else None
        if not isinstance(place, Place):
            return None
        graph, kf = self.graph, self.graph.keyframes[place.keyframes[0]]
        cam_from_world = inverse(place.world_from_cam)
        guess = cam_from_world @ inverse(graph.variables[kf.id].cam_from_world)
        start = Start(rigid_flow_to(graph, kf.id, cam_from_world), near=True)
        view = self.two_view.estimate(kf, work, moving, start, guess)
        return view if self.two_view.accepted(view) else None
