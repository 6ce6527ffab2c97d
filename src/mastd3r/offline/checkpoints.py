"""When a run writes down how far it is, and what."""

from __future__ import annotations

import logging
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

from ..errors import OutputError
from ..export.checkpoint import CheckpointStore
from ..export.claim import CHECKPOINT
from ..export.machine import program
from ..tracking.memory import TrackingMemory
from .final_solve import FinalFrame

log = logging.getLogger(__name__)
Stage = Literal["tracking", "tracked", "solved"]
EVERY_S = 10.0  # of work that is lost at most
MOST_OF_TIME = 0.02  # that checkpoints may take: where one takes long they are farther apart


@dataclass(frozen=True)
class JobMemory:
    """What the stages after tracking need of those before."""

    frames: int
    tracking_s: float
    final: list[FinalFrame]
    turns_only: bool
    scale: dict[str, Any] | None = None  # what run.json says of the unit that ``final`` has


@dataclass(frozen=True)
class Memory:
    """A checkpoint."""

    stage: Stage  # what was under way, or has just ended
    tracking: TrackingMemory
    job: JobMemory


class Checkpoints:
    """Of one run."""

    def __init__(self, run: Path) -> None:
        self.store = CheckpointStore(run / CHECKPOINT, program())
        self.spent_s = 0.0
        self.written = 0
        self._last, self._took_s = time.monotonic(), 0.0
        self._broken = False

    def due(self) -> bool:
        """Whether enough was done since the last."""
        return time.monotonic() - self._last >= max(EVERY_S, self._took_s / MOST_OF_TIME)

    def write(self, stage: Stage, tracking: Callable[[], TrackingMemory], job: JobMemory) -> None:
        """Write one. A disk without room for it is said once, and costs nothing but the checkpoints."""
        if self._broken:
            return
        began = time.monotonic()
        try:
            self.store.save(Memory(stage, tracking(), job))
        except OutputError as e:
            self._broken = True
            log.warning("no checkpoints from here on: %s", e)
        self._last = time.monotonic()
        self._took_s = self._last - began
        self.spent_s += self._took_s
        self.written += 1

    def load(self) -> Memory | None:
        """The newest that is good."""
        found: Any = self.store.load()
        if found is not None and not isinstance(found, Memory):
            log.warning("checkpoint: expected one of a run, got %s", type(found).__name__)
            return None
        return found

    def facts(self) -> dict[str, Any]:
        """For run.json."""
        return {"written": self.written, "seconds": round(self.spent_s, 3)}

    def remove(self) -> None:
        """The run is complete."""
        self.store.remove()
