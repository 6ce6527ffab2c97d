"""A camera into a run folder: what ``mastd3r live`` does."""

from __future__ import annotations

import logging
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from ..concurrency import one_blas_thread
from ..config import Config, check_config
from ..errors import reason_of
from ..export.claim import RECORDED
from ..export.run_folder import RunFolder
from ..offline.reconstruction import Reconstruction
from ..progress import Bar, Reporter, Silent
from ..reading.files import exists, user_path
from ..registry import LARGEST, Range
from ..sources.camera import CameraOptions, open_camera
from ..sources.passing import KeptSource, PassingSource
from ..types import StaticCloud
from .job import LiveJob
from .loop import LiveFrame, LiveLoop

Array = NDArray[Any]
log = logging.getLogger(__name__)
SECONDS = Range(0, LARGEST, above=True)
LATENCY_EVERY_S = 1.0  # how late frames are is said anew no more often
CLOUD_EVERY_S = 1.0  # a view gets the cloud no more often


class LiveView(Protocol):
    """Who shows a live run while it runs. Both are called by the loop's thread, and must return at once."""

    def frame(self, seen: LiveFrame) -> None:
        """A frame has been tracked; its ``moving`` may still be in the making."""
        ...

    def cloud(self, cloud: StaticCloud, times_s: Array, path: Array) -> None:
        """The static points, times (n,) and poses (n, 4, 4) world_from_cam as they are now: after a new keyframe."""
        ...


@one_blas_thread()
def run_live(
    camera: str | Path,
    out: str | Path,
    config: Config | None = None,
    *,
    options: CameraOptions | None = None,
    record: bool = False,
    seconds: float | None = None,
    overwrite: bool = False,
    command: Sequence[str] = (),
    reporter: Reporter | None = None,
    view: LiveView | None = None,
) -> Reconstruction:
    """Track a camera while it runs, until it ends, for ``seconds``, or up to KeyboardInterrupt; gives what came of it.

    The run is then complete: trajectory_live.txt (poses as they were given out), trajectory.txt (after the joint
    optimisation), causal masks, cloud, figures, report. ``record`` keeps the frames that were tracked, so that
    ``finish_live`` can make the rest. Interrupted before its second frame, and a second time, it raises.
    Raises SlamError children: where the camera is not there, before the folder is touched.
    """
    if seconds is not None:
        SECONDS.check(seconds, "--seconds")
    config = check_config(config or Config())
    opened = open_camera(camera, options or CameraOptions(), config.source)
    source = KeptSource(opened) if record else PassingSource(opened)
    reporter = reporter or Silent()
    with reporter.stage("warming up", 1, "loop") as bar:
        bar.say("kernels are compiled by their first use, and loaded by later ones")
        loop = LiveLoop(opened, config, source=source, seconds=seconds)
        bar.advance()
    with loop:
        path = user_path(camera)
        read = [path] if exists(path) and not path.is_char_device() else []
        with RunFolder(user_path(out, "out"), list(command), read, overwrite=overwrite) as folder:
            where = str((folder.home / RECORDED).resolve()) if record else opened.name
            folder.update(source={"path": where, "maps": None}, live={"recorded": record})
            if isinstance(source, KeptSource):
                source.begin(folder.path / RECORDED)
            with LiveJob(loop, folder, reporter) as job:
                _watch(loop, job, view)
                job.end()
    return Reconstruction(folder.path)


def _watch(loop: LiveLoop, job: LiveJob, view: LiveView | None) -> None:
    """Frame after frame, to the end of the camera; a request to stop is an end like others."""
    with job.reporter.stage("live", None, "frames") as bar:
        told = _Teller(loop, job, bar, view)
        loop.on_frame, loop.while_silent = told.frame, told.say
        try:
            for _ in loop:
                pass
        except KeyboardInterrupt as e:
            if loop.tracked < 2:
                raise
            loop.ended = reason_of(e)
            loop.said.append(loop.ended)
        finally:
            told.say()
            loop.close()


class _Teller:
    """Hands each frame on, and says on the terminal how it goes."""

    def __init__(self, loop: LiveLoop, job: LiveJob, bar: Bar, view: LiveView | None) -> None:
        self._loop, self._job, self._bar, self._view = loop, job, bar, view
        self._said, self._keyframes, self._cloud_at = 0, 0, 0.0
        self._late, self._late_at = "", -LATENCY_EVERY_S

    def frame(self, seen: LiveFrame) -> None:
        """One more."""
        self._job.see(seen)
        self._bar.advance()
        self.say()
        if self._view is None:
            return
        self._view.frame(seen)
        count, now = len(self._loop.slam.graph.keyframes), time.monotonic()
        if count != self._keyframes and now - self._cloud_at > CLOUD_EVERY_S:
            self._keyframes, self._cloud_at = count, now
            self._view.cloud(self._loop.cloud(), *self._loop.path())

    def say(self) -> None:
        """The state in one line, and what has happened to the camera."""
        loop = self._loop
        for line in loop.said[self._said :]:
            log.warning(line)
        self._said = len(loop.said)
        if time.monotonic() - self._late_at >= LATENCY_EVERY_S:  # it goes through all frames that there were
            median, most = self._job.latency_ms()
            self._late = "" if np.isnan(median) else f" · latency {median:.0f} ms (95 %: {most:.0f})"
            self._late_at = time.monotonic()
        share = loop.dropped / max(loop.came, 1)
        self._bar.say(f"{loop.state}{self._late} · dropped {loop.dropped} of {loop.came} ({share:.1%})")
