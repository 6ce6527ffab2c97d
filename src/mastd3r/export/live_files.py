"""What a live run gave out, written as it was given: trajectory_live.txt and live_frames.csv, a row a frame."""

from __future__ import annotations

from pathlib import Path
from typing import Any, TextIO

import numpy as np
from numpy.typing import NDArray

from .files import writing
from .trajectory_files import HEADER, tum_rows

Array = NDArray[Any]
COLUMNS = "timestamp_s,state,keyframe,submap,dropped_before,pose_latency_ms,latency_ms,reason\n"


class LiveFiles:
    """Rows are on disk as soon as they are written, so that a run that is killed leaves them."""

    def __init__(self, run: Path) -> None:
        """Begin both files in the run folder. Raises OutputError."""
        self._poses = self._begin(run / "trajectory_live.txt", HEADER)
        self._frames = self._begin(run / "live_frames.csv", COLUMNS)

    def pose(self, timestamp_s: float, world_from_cam: Array | None) -> None:
        """The pose (4, 4) of a frame as it was given out; none, no row. Raises OutputError."""
        if world_from_cam is not None and np.isfinite(world_from_cam).all():
            self._row(self._poses, tum_rows(np.array([timestamp_s]), world_from_cam[None]))

    def frame(self, timestamp_s: float, *cells: object) -> None:
        """The other ``COLUMNS`` of a frame. Raises OutputError."""
        words = (f"{c:.1f}" if isinstance(c, float) else str(c).replace(",", ";") for c in cells)
        self._row(self._frames, f"{timestamp_s:.6f},{','.join(words)}\n")

    def close(self) -> None:
        """No more rows."""
        for file in (self._poses, self._frames):
            with writing(Path(file.name)):
                file.close()

    def _begin(self, path: Path, head: str) -> TextIO:
        with writing(path):
            file = open(path, "w", encoding="utf-8", buffering=1)  # noqa: SIM115  open while the run is
            file.write(head)
        return file

    def _row(self, file: TextIO, row: str) -> None:
        with writing(Path(file.name)):
            file.write(row)
