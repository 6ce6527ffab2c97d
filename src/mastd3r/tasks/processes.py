"""Tasks in processes of this machine, as many at once as jobs and memory allow, each on its share of the cores."""

from __future__ import annotations

import os
import time
from collections.abc import Iterable
from dataclasses import dataclass
from types import TracebackType

from ..errors import ConfigError
from ..export.machine import total_memory_mib, usable_cores
from .process import END_S, Child, Ended
from .runner import Task

MEMORY_SHARE = 0.8  # of the machine's, where --memory-mib is not given


@dataclass(frozen=True)
class Limits:
    """How much may run at once."""

    jobs: int
    memory_mib: float


def limits(jobs: int | None, memory_mib: float | None) -> Limits:
    """Checked limits; one job, most of the machine's memory where nothing is said. Raises ConfigError."""
    if jobs is not None and jobs < 1:
        raise ConfigError(f"--jobs: expected 1 or more, got {jobs}")
    if memory_mib is not None and not memory_mib > 0:
        raise ConfigError(f"--memory-mib: expected more than 0, got {memory_mib:g}")
    total = total_memory_mib()
    own = MEMORY_SHARE * total if total else float("inf")
    return Limits(jobs or 1, own if memory_mib is None else memory_mib)


@dataclass(frozen=True)
class _Running:
    task: Task
    child: Child
    need_mib: float
    cores: tuple[int, ...]


class Processes:
    """A place for tasks (``runner.Place``)."""

    def __init__(self, allowed: Limits, lock: int | None = None) -> None:
        """``lock``: an open file that tasks keep open too, so that what it locks stays locked while one runs."""
        self.allowed = allowed
        self._inherits = () if lock is None else (lock,)
        self.said = f"at most {allowed.jobs} at once, within {allowed.memory_mib:.0f} MiB"
        self._running: list[_Running] = []
        self._new: list[Task] = []

    def has_room(self, need_mib: float) -> bool:
        """A task that needs more than the whole budget, as its like has just shown, still runs, alone."""
        if len(self._running) >= self.allowed.jobs:
            return False
        return not self._running or sum(r.need_mib for r in self._running) + need_mib <= self.allowed.memory_mib

    def give(self, task: Task, attempt: int, need_mib: float) -> None:
        """Begin it at once. Raises OutputError."""
        cores = _cores(self.allowed.jobs, [r.cores for r in self._running])
        child = Child(task.argv(attempt), task.log, cores=cores, inherits=self._inherits)
        self._running.append(_Running(task, child, need_mib, cores))
        self._new.append(task)

    def begun(self) -> Iterable[tuple[Task, str]]:
        """All that were given since the last call."""
        new, self._new = self._new, []
        return [(task, "") for task in new]

    def ended(self) -> Iterable[tuple[Task, Ended]]:
        """Those whose process has ended, one after another: nobody need wait until all of them were heard of."""
        for r in list(self._running):
            if (ended := r.child.ended()) is not None:
                self._running.remove(r)
                yield r.task, ended

    def __enter__(self) -> Processes:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """No task goes on alone: each is asked to stop, and then made to."""
        for r in self._running:
            r.child.ask_to_stop()
        end_s = time.monotonic() + END_S
        for r in self._running:
            r.child.wait_or_kill(end_s)


def _cores(jobs: int, taken: list[tuple[int, ...]]) -> tuple[int, ...]:
    """One of ``jobs`` equal shares of the cores that nobody has; empty where there is nothing to share."""
    if jobs < 2 or not hasattr(os, "sched_setaffinity"):
        return ()
    mine = sorted(os.sched_getaffinity(0))
    count = max(1, usable_cores() // jobs)
    shares = [tuple(mine[k * count : (k + 1) * count]) for k in range(len(mine) // count)]
    return next((share for share in shares if share not in taken), ())
