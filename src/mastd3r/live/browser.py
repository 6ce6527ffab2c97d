"""A live run in the browser: ``mastd3r live --view``."""

from __future__ import annotations

import threading
import time
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..concurrency import Future, Worker
from ..types import State, StaticCloud
from ..viewer.scene import Scene
from .loop import LiveFrame

Array = NDArray[Any]
IMAGE_EVERY_S = 0.2  # the picture is sent no more often
_Placed = tuple[float, Array | None, State]


class BrowserView:
    """``LiveView`` by a viewer's scene. It never holds tracking up: what cannot be sent in time is sent together."""

    def __init__(self, scene: Scene) -> None:
        self._scene, self._worker, self._lock = scene, Worker("view"), threading.Lock()
        self._waiting: list[_Placed] = []
        self._newest: LiveFrame | None = None
        self._cloud: tuple[StaticCloud, Array, Array] | None = None
        self._sending: Future[None] = Future.done(None)
        self._shown_at = 0.0

    def frame(self, seen: LiveFrame) -> None:
        """See ``LiveView``."""
        pose = seen.world_from_cam
        with self._lock:
            self._waiting.append((seen.timestamp_s, pose, "lost" if pose is None else "tracked"))
            self._newest = seen
        self._send_if_free()

    def cloud(self, cloud: StaticCloud, times_s: Array, path: Array) -> None:
        """See ``LiveView``."""
        with self._lock:
            self._cloud = cloud, times_s, path
            self._waiting.clear()
        self._send_if_free()

    def close(self) -> None:
        """Send what is left, and end the thread; the scene stays."""
        self._sending.get()
        self._send()
        self._worker.close()

    def _send_if_free(self) -> None:
        if self._sending.ready():
            self._sending = self._worker.submit(self._send)

    def _send(self) -> None:
        with self._lock:
            waiting, self._waiting = self._waiting, []
            cloud, self._cloud = self._cloud, None
            newest, self._newest = self._newest, None
        scene = self._scene
        if cloud is not None and len(cloud[0].points_world):
            scene.set_cloud("sparse", cloud[0].points_world, cloud[0].colors)
        if cloud is not None:
            scene.replace_frames(list(cloud[1]), list(cloud[2]), ["tracked"] * len(cloud[1]))
        if waiting:
            scene.add_frames(*(list(part) for part in zip(*waiting, strict=True)))
        if newest is None:
            return
        if waiting:
            scene.select(scene.count - 1)
        if time.monotonic() - self._shown_at >= IMAGE_EVERY_S:
            mask = np.rint(255 * np.clip(newest.moving, 0, 1)).astype(np.uint8)
            scene.set_image(newest.image, mask, f"{newest.timestamp_s:.3f} s · {newest.state}")
            self._shown_at = time.monotonic()
