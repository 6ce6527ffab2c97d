"""Between tracking and the map's own process (``--realtime``): what is sent, when, and what came of it."""

from __future__ import annotations

import logging
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from ..camera.map_view import MapView
from ..camera.opencv_lens import OpenCvLens
from ..camera.pinhole import Camera
from ..config import Config
from ..graph.keyframe_graph import KeyframeGraph
from ..mapping.process import KeyframeNews, MapProcess, Outcome, PoseNews
from ..types import Frame, View
from .smoothing import is_holdout
from .static_cloud import static_cloud

Array = NDArray[Any]
log = logging.getLogger(__name__)
RECENT = 2  # frames; a keyframe may be the frame before the one that made it necessary
DELAY = 2  # keyframes that a keyframe waits for its depths to be seen from elsewhere


@dataclass(frozen=True)
class _Seen:
    """A keyframe's photograph, kept until it is sent."""

    photograph: Frame  # as the camera took it, for the view
    tracked: Array  # (h, w, 3) uint8 at working size, as tracking saw it, for the points' colours


class LiveMap:
    """Watches the graph grow and tells the map's process; never waits for it."""

    def __init__(self, config: Config, device: str) -> None:
        self._config, self._process = config, MapProcess(config.mapping, config.seed, device)
        self._waiting: dict[int, _Seen] = {}  # keyframe id -> what it needs
        self._sent: list[int] = []
        self._recent: deque[tuple[int, Frame]] = deque(maxlen=RECENT)
        self._paid_until = 0  # frames whose steps have been paid for
        self._known = 0

    def after(
        self,
        position: int,
        frame: Frame,
        graph: KeyframeGraph,
        lens: Callable[[], Camera | OpenCvLens],
    ) -> None:
        """One frame of tracking is done; ``position`` counts the frames read, ``lens`` is over the photograph."""
        self._recent.append((position, frame))
        if len(graph.keyframes) == self._known:
            return
        for kf in graph.keyframes[self._known :]:
            for at, shown in self._recent:
                if kf.work.index == shown.index and not is_holdout(at):
                    small = cv2.resize(shown.image, graph.size, interpolation=cv2.INTER_AREA)
                    self._waiting[kf.id] = _Seen(shown.as_taken, small)
        self._known = len(graph.keyframes)
        if graph.initialised and graph.submap_of[self._known - 1] == graph.submap_of[0]:
            if self._sent:
                self._process.offer(self._poses(graph))
            self._send(position, graph, lens, self._known - 1 - DELAY)

    def _poses(self, graph: KeyframeGraph) -> PoseNews:
        return PoseNews({k: graph.world_from_cam(k) for k in self._sent})

    def _send(self, position: int, graph: KeyframeGraph, lens: Callable[[], Camera | OpenCvLens], last: int) -> None:
        """Offer the keyframes up to ``last`` that wait."""
        ready = [k for k in self._waiting if k <= last]
        if not ready:
            return
        m = self._config.mapping
        map_view = MapView(lens(), m.width_px, m.tau_uncertainty_px)
        for k in ready:
            seen = self._waiting.pop(k)
            if graph.submap_of[k] != graph.submap_of[0]:
                continue
            steps = m.realtime_steps * (position - self._paid_until)
            if self._process.offer(_news(k, seen, graph, map_view, steps)):
                self._sent.append(k)
                self._paid_until = position

    def finish(
        self, graph: KeyframeGraph, lens: Callable[[], Camera | OpenCvLens]
    ) -> tuple[Outcome | None, dict[str, Any], str]:
        """The map so far at the final poses, the figures for run.json, and the line for its choices.

        No map where no keyframe could be sent, or where the process has died; then it is made after tracking.
        """
        if graph.initialised:
            self._send(self._paid_until, graph, lens, self._known - 1)
        outcome = self._process.finish(self._poses(graph))
        facts = {"keyframes_sent": len(self._sent), "messages_dropped": self._process.dropped}
        if outcome is None:
            note = "realtime: the map's process ended without a map; it is made after tracking"
            log.warning(note)
            return None, facts, note
        facts |= {"steps_while_tracking": outcome.steps, "keyframes_mapped": outcome.views}
        note = (
            f"realtime: {len(self._sent)} keyframes sent, {self._process.dropped} messages dropped, "
            f"{outcome.steps} steps while tracking"
        )
        return outcome if outcome.gaussians is not None else None, facts, note

    def close(self) -> None:
        """End the process."""
        self._process.close()


def _news(k: int, seen: _Seen, graph: KeyframeGraph, map_view: MapView, steps: int) -> KeyframeNews:
    """A keyframe as the graph knows it now."""
    kf, pose = graph.keyframes[k], graph.world_from_cam(k)
    image, inside = map_view.pinhole_image(seen.photograph.image)
    static = np.clip(1 - map_view.pinhole_map(kf.moving.astype(np.float32) / 255), 0.01, 1) * inside
    view = View(seen.photograph.timestamp_s, image, static.astype(np.float16), pose, map_view.pinhole, k)
    at = np.round(graph.variables[k].px).astype(int)
    cloud = static_cloud(graph, {k: seen.tracked[at[:, 1], at[:, 0]]}, {k: 1 - kf.static})
    return KeyframeNews(view, cloud, pose, steps)
