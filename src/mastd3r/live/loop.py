"""The live loop: the newest frame of a camera is tracked, the others are dropped; each result says how late it is."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..concurrency import Future, Newest, Worker, undivided
from ..config import Config
from ..errors import ConfigError
from ..geometry.se3 import inverse
from ..offline.causal_cloud import CausalCloud
from ..parts import with_dataset_lens
from ..slam import Slam, TrackResult
from ..sources.camera import Camera, CameraFrame
from ..sources.passing import KeptSource, PassingSource
from ..sources.rectified import rectified
from ..tracking.state import Status
from ..types import Frame, StaticCloud
from .warm import warm_up

Array = NDArray[Any]
LOOK_S = 0.2  # how long a frame is waited for before somebody looks at the clock
SILENT_S = 1.0  # without a frame, from which on it is said


@dataclass(frozen=True)
class LiveFrame:
    """What is known of a frame when it has been tracked; later frames may still correct it."""

    result: TrackResult
    image: Array  # (h, w, 3) uint8 RGB, as it came
    arrived_s: float  # on the clock of time.perf_counter
    pose_latency_s: float  # from its arrival until its pose was there
    dropped: int  # frames that came since the one before, and were dropped
    _made: Future[tuple[Array, float]]

    @property
    def timestamp_s(self) -> float:
        """Its time, ascending."""
        return self.result.timestamp_s

    @property
    def state(self) -> Status:
        """What the camera is known of."""
        return self.result.state

    @property
    def world_from_cam(self) -> Array | None:
        """(4, 4) its pose as it was given out, OpenCV axes, map units; None where it has no place in the map yet."""
        return self.result.world_from_cam

    @property
    def moving(self) -> Array:
        """(h, w) float32 the causal P(moving) over the image; waits until it is made."""
        return self._made.get()[0]

    @property
    def latency_s(self) -> float:
        """From its arrival until pose and mask were both there; waits until they are."""
        return self._made.get()[1]


class LiveLoop:
    """Frames of a camera, tracked as they come; as a context it gives camera and threads back.

    ``for seen in live`` gives a ``LiveFrame`` as soon as its pose is there; it ends with the camera, or after ``stop``.
    ``live.slam`` has the graph. All but ``stop`` is for the thread that asks for frames.
    """

    def __init__(
        self,
        camera: Camera,
        config: Config | None = None,
        *,
        source: PassingSource | None = None,
        seconds: float | None = None,
        on_frame: Callable[[LiveFrame], None] | None = None,
        warm: bool = True,
    ) -> None:
        """``source``: what keeps the frames; by default they pass. ``seconds``: it ends so long after its first frame.

        ``on_frame`` is called with every frame before it is given, and is not divided from its tracking by a signal.
        ``warm``: before the camera is read, all kernels are made ready (live/warm.py), which takes seconds.
        Raises ConfigError and InputError for options that a camera cannot serve.
        """
        source = PassingSource(camera) if source is None else source
        config = _servable(config or Config())
        config, self.notes = with_dataset_lens(config, source)
        self.camera, self.source, self._seconds, self.on_frame = camera, source, seconds, on_frame
        self.while_silent: Callable[[], None] = lambda: None  # called now and then while no frame comes
        if warm:
            warm_up(config, source.size)
        self.slam = Slam(config, source.size, source=source, live=True)
        self.said: list[str] = []  # what happened, a line each
        self.ended: str | None = None  # why, once it has
        self.state = "waiting"  # for people: of the camera while nothing comes, else of tracking
        self.tracked, self.tracking_s = 0, 0.0
        self._slot: Newest[CameraFrame] | None = None
        self._out = Worker("live masks")
        self.keyframes = CausalCloud(self.slam.graph)
        self._stopped = False

    def __enter__(self) -> LiveLoop:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    @property
    def came(self) -> int:
        """Frames that have come from the camera."""
        return 0 if self._slot is None else self._slot.came

    @property
    def dropped(self) -> int:
        """Frames of those that were not tracked, because a newer one was there."""
        return 0 if self._slot is None else self._slot.dropped

    def __iter__(self) -> Iterator[LiveFrame]:
        self._slot = slot = Newest(self._frames(), "camera")
        dropped, last = 0, time.perf_counter()
        first: float | None = None
        while not self._stopped:
            came = slot.take(LOOK_S)
            self.said += self.camera.said[len(self.said) :]
            now = time.perf_counter()
            if first is not None and self._seconds is not None and now - first >= self._seconds:
                self.ended = f"after {self._seconds:g} s, as was asked"
                return
            if came is None:
                if slot.over:
                    break
                if self._lost(now - last):
                    return
                self.while_silent()
                continue
            first = came.arrived_s if first is None else first
            before, dropped = dropped, slot.dropped
            with undivided():
                seen = self._track(came, dropped - before)
            last = time.perf_counter()
            yield seen
        self.said += self.camera.said[len(self.said) :]
        self.ended = self.ended or (self.said[-1] if self.said else "the camera ended")

    def stop(self) -> None:
        """No frame more; from any thread."""
        self._stopped, self.ended = True, self.ended or "it was stopped"

    def close(self) -> None:
        """Give the camera back, and wait for the masks that are asked for."""
        self.stop()
        self.camera.close()
        if self._slot is not None:
            self._slot.close()
        self._out.close()

    def cloud(self) -> StaticCloud:
        """The static points of all keyframes so far, where they are now; empty until there is depth."""
        return self.keyframes.cloud()

    def path(self) -> tuple[Array, Array]:
        """(n,) times in seconds and (n, 4, 4) world_from_cam of all frames with a place in the map, as it is now."""
        graph = self.slam.graph
        placed = [r for r in graph.records if r.state != "lost" and graph.submap_of.get(r.kf_id) in graph.started]
        if not placed:
            return np.zeros(0), np.zeros((0, 4, 4))
        poses = [inverse(r.cam_from_kf @ graph.variables[r.kf_id].cam_from_world) for r in placed]
        return np.array([r.timestamp_s for r in placed]), np.stack(poses)

    def _frames(self) -> Iterator[CameraFrame]:
        """In the camera's thread: what comes, kept where that is wanted."""
        for came in self.camera.frames():
            if isinstance(self.source, KeptSource):
                self.source.keep(came)
            yield came

    def _track(self, came: CameraFrame, dropped: int) -> LiveFrame:
        frame = Frame(self.tracked, came.timestamp_s, came.image)
        if self.slam.rectifier is not None:
            frame = rectified(frame, self.slam.rectifier)
        began = time.perf_counter()
        result = self.slam.track(frame)
        now = time.perf_counter()
        self.tracked, self.tracking_s = self.tracked + 1, self.tracking_s + now - began
        self.keyframes.see(frame)
        self.state = str(result.state)
        made = self._out.submit(_measured(result, came.arrived_s))
        seen = LiveFrame(result, came.image, came.arrived_s, now - came.arrived_s, dropped, made)
        if self.on_frame is not None:
            self.on_frame(seen)
        return seen

    def _lost(self, silent_s: float) -> bool:
        """Whether a camera that has said nothing for so long is lost."""
        if self.camera.state != "open":
            self.state = self.camera.state
            return False
        if silent_s > SILENT_S:
            self.state = f"nothing for {silent_s:.0f} s"
        limit_s = self.camera.timeout_s
        if limit_s is None or silent_s < limit_s + SILENT_S:  # who notices itself says it better
            return False
        self.ended = f"nothing came from {self.camera.name} for {limit_s:g} s"
        self.said.append(self.ended)
        return True


def _measured(result: TrackResult, arrived_s: float) -> Callable[[], tuple[Array, float]]:
    def made() -> tuple[Array, float]:
        moving = result.moving
        return moving, time.perf_counter() - arrived_s

    return made


def _servable(config: Config) -> Config:
    """The options, if a camera can serve them. Raises ConfigError."""
    if config.pointmaps == "depth":
        raise ConfigError("pointmaps=depth: expected pointmaps from pictures alone, since a camera brings no depth")
    if config.semantics == "maps":
        raise ConfigError("semantics=maps: expected another prior, since a camera brings no maps")
    if config.mapping.enabled and config.mapping.realtime:
        raise ConfigError("mapping.realtime=true: expected a map that is made afterwards (mastd3r finish)")
    return config
