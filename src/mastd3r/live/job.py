"""What a live run leaves: rows and masks while it runs, and at its end all that is cheap."""

from __future__ import annotations

from collections import Counter, deque
from collections.abc import Sequence
from types import TracebackType
from typing import Any

import cv2
import numpy as np

from ..concurrency import Future, Worker, undivided
from ..evaluation.evaluate import Evaluation
from ..export.live_files import LiveFiles
from ..export.machine import peak_rss_mib
from ..export.run_folder import RunFolder
from ..offline.job import RunJob
from ..offline.run_report import write_run_report
from ..offline.tracked import Tracked
from ..offline.tracks import static_tracks
from ..progress import Reporter
from ..sources.passing import KeptSource, PassingSource
from .loop import LiveFrame, LiveLoop

LATE = 8  # frames whose files may be in the making: a slow disk makes the camera faster than tracking, nothing more
CLOUD_ONLY = "live: masks are the causal ones, as they were given out"


class LiveJob(RunJob):
    """A live run in progress. What is written while it runs is written beside tracking."""

    def __init__(self, loop: LiveLoop, folder: RunFolder, reporter: Reporter) -> None:
        slam = loop.slam
        tracked = Tracked(slam.source, slam.config, slam.graph, slam.parts, slam.rectifier, slam.map_device)
        super().__init__(tracked, folder, reporter)
        self.loop = loop
        self.latencies_s: list[tuple[float, float]] = []  # of every frame: to its pose, to its mask as well
        self._files = LiveFiles(folder.path)
        self._worker = Worker("live files")
        self._written = deque[Future[None]]()
        self._moving: list[float] = []  # share of each mask
        self._arrived_s: list[float] = []

    def __enter__(self) -> LiveJob:
        return self

    def see(self, seen: LiveFrame) -> None:
        """One frame has been tracked: its files. Raises OutputError for those of an earlier one."""
        self.frames += 1
        self._arrived_s.append(seen.arrived_s)
        self._written.append(self._worker.submit(lambda: self._write(seen)))
        while len(self._written) > LATE:
            self._written.popleft().get()

    def latency_ms(self) -> tuple[float, float]:
        """Median and 95 % of the milliseconds from a frame's arrival until pose and mask are out; nan before any."""
        return _median_and_most_ms([both for _, both in list(self.latencies_s)])

    def settle(self) -> None:
        """Wait for the files of all frames. Raises OutputError."""
        while self._written:
            self._written.popleft().get()
        self._files.close()
        if isinstance(self.source, KeptSource):
            self.source.settle()

    def end(self) -> None:
        """Everything that is cheap: joint optimisation and all poses, the cloud, figures, the report; complete."""
        loop = self.loop
        self.settle()
        self.folder.note(*loop.notes, CLOUD_ONLY)
        with self.timed("tracking"):
            self.timings["tracking"] = loop.tracking_s
            loop.slam.end_tracking()
        self.check_tracked()
        self.solve()
        loop.keyframes.take_colors()
        colors, moving = ({}, {}) if self._turns_only else (loop.keyframes.colors(), loop.keyframes.moving())
        if not self._turns_only:
            self.folder.write_cloud(loop.keyframes.whole())
            px = self.tracked.photograph_px
            self.folder.write_tracks(static_tracks(self.graph, self._final, colors, moving, px))
        self._report()

    def facts(self) -> dict[str, Any]:
        """How the live part went, for run.json."""
        loop = self.loop
        return {
            "camera": loop.camera.name,
            "kind": loop.camera.kind,
            "recorded": isinstance(self.source, KeptSource),
            "ended": loop.ended,
            "said": loop.said,
            "figures": self._live_figures(),
        }

    def _live_figures(self) -> dict[str, Any]:
        """Frames, their rate and how late they were."""
        loop, arrived = self.loop, self._arrived_s
        figures: dict[str, Any] = {
            "frames_came": loop.came,
            "frames_dropped": loop.dropped,
            "frames_dropped_ratio": loop.dropped / max(loop.came, 1),
        }
        if len(arrived) > 1:
            seconds = arrived[-1] - arrived[0]
            figures |= {"live_s": seconds, "fps_camera": (loop.came - 1) / seconds}
            figures["fps_live"] = (len(arrived) - 1) / seconds
        if self.latencies_s:
            pose, both = zip(*self.latencies_s, strict=True)
            for name, values in (("latency_ms", both), ("pose_latency_ms", pose)):
                figures[f"{name}_median"], figures[f"{name}_95"] = _median_and_most_ms(values)
        return figures

    def _write(self, seen: LiveFrame) -> None:
        """The files of a frame, once its mask is there."""
        moving, result = seen.moving, seen.result
        self.latencies_s.append((seen.pose_latency_s, seen.latency_s))
        self._files.pose(seen.timestamp_s, seen.world_from_cam)
        words = (seen.state, int(result.is_keyframe), result.submap, seen.dropped)
        self._files.frame(seen.timestamp_s, *words, 1e3 * seen.pose_latency_s, 1e3 * seen.latency_s, result.reason)
        small = cv2.resize(moving, self.graph.size, interpolation=cv2.INTER_LINEAR)
        self._moving.append(float((small > 0.5).mean()))
        self.folder.write_mask(seen.timestamp_s, np.asarray(small))

    def _report(self) -> None:
        """Figures, the report, and the end of the run. No frame is read again."""
        states = Counter("tracked" if f.state == "started" else f.state for f in self._final)
        posed = sum(bool(np.isfinite(f.world_from_cam).all()) for f in self._final)
        self.metrics = {
            "frames": self.frames,
            "frames_posed": posed,
            **{f"frames_{s}": states[s] for s in ("tracked", "interpolated", "lost")},
            "keyframes": len(self.graph.keyframes),
            "focal_px": self.folder.record["camera"]["focal_px"],
            "mask_moving_ratio": float(np.mean(self._moving)),
            "fps_tracking": self.frames / self.timings["tracking"],
            **self._live_figures(),
            "peak_rss_mib": peak_rss_mib(),
        }
        self.folder.write_metrics(self.metrics)
        self.folder.update(timings_s=self.timings, live=self.facts())
        record = self.folder.record | self.folder.ending()
        passed = PassingSource(self.loop.camera)
        write_run_report(self.folder.path, passed, Evaluation(self.metrics, None, ()), None, record)
        self.folder.finish()

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        with undivided():
            self._worker.close()
            if isinstance(self.source, KeptSource):
                self.source.close()
            if error is not None and self.folder.record["status"] == "running":
                self.folder.record["live"] = self.facts()
            super().__exit__(kind, error, trace)


def _median_and_most_ms(latencies_s: Sequence[float]) -> tuple[float, float]:
    """Median and 95 % in milliseconds; nan of none."""
    if not latencies_s:
        return np.nan, np.nan
    median, most = 1e3 * np.percentile(latencies_s, (50, 95))
    return float(median), float(most)
