"""Running a suite's missing entries: processes of their own, as many at once as jobs and memory allow."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
import time
from collections import deque
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from ..errors import ConfigError
from ..export.files import writing
from ..export.machine import total_memory_mib, usable_cores
from .store import Store, command_of, record_of
from .suite import Entry

POLL_S = 0.1
LOG_END_BYTES = 2**16  # of what an entry has said, its last line is looked for in
END_S = 20.0  # for a run to save what it has, once it is told to stop
MEMORY_SHARE = 0.8  # of the machine's, where --memory-mib is not given
Launch = Callable[[Entry, Path, Path], list[str]]  # entry, sequence folder, run folder -> argument vector


@dataclass
class Running:
    """An entry at work."""

    entry: Entry
    process: subprocess.Popen[bytes]
    memory_mib: float
    cores: tuple[int, ...]
    began_s: float
    jobs: int  # the most that ran at once while it did


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


def by_command_line(entry: Entry, folder: Path, out: Path) -> list[str]:
    """``mastd3r run`` in a process of its own, which ends when this one does."""
    return [sys.executable, "-m", *command_of(entry, str(folder), str(out)), "--quiet", "--end-with-stdin"]


def run_entries(
    entries: Sequence[Entry],
    folders: Mapping[str, Path],
    store: Store,
    allowed: Limits,
    *,
    done: Callable[[Entry, dict[str, Any]], None],
    launch: Launch = by_command_line,
) -> None:
    """Run entries in their order; each leaves a JSON in the store, whether it worked or not, and calls ``done``.

    ``folders`` has the folder of every sequence's name. An entry starts when fewer than ``allowed.jobs`` run and
    their memory and its own, measured on its like or declared, keep within the budget. Ctrl-C stops what runs
    and records nothing of it. Raises ConfigError before anything starts where one entry alone is over the budget.
    """
    needs = store.needs(entries)
    for entry in entries:
        if (need := needs[entry.id]) > allowed.memory_mib:
            got = f"{allowed.memory_mib:.0f}"
            raise ConfigError(f"--memory-mib: expected {need:.0f} or more, which {entry.label} needs, got {got}")
    with store.locked() as lock:
        waiting, running = deque(entries), list[Running]()
        with _stopped_at_the_end(running):
            while waiting or running:
                while waiting and _fits(needs[waiting[0].id], running, allowed):
                    entry = waiting.popleft()
                    argv = launch(entry, folders[entry.sequence.name], _fresh(store.run_folder(entry)))
                    running.append(_start(entry, argv, needs[entry.id], store, running, allowed.jobs, lock))
                    for other in running:
                        other.jobs = max(other.jobs, len(running))
                time.sleep(POLL_S)
                for finished in [r for r in running if r.process.poll() is not None]:
                    running.remove(finished)
                    done(finished.entry, _recorded(finished, store))
                    needs = store.needs(waiting)


def _fits(need_mib: float, running: list[Running], allowed: Limits) -> bool:
    """An entry whose like has just shown that it needs more than the budget still runs, alone."""
    if len(running) >= allowed.jobs:
        return False
    return not running or sum(r.memory_mib for r in running) + need_mib <= allowed.memory_mib


def _fresh(folder: Path) -> Path:
    """What an interrupted run has left there goes."""
    if folder.exists():
        with writing(folder):
            shutil.rmtree(folder)
    return folder


def _start(
    entry: Entry,
    argv: list[str],
    need_mib: float,
    store: Store,
    running: list[Running],
    jobs: int,
    lock: int | None,
) -> Running:
    """The entry's process on cores of its own, so that jobs side by side do not fight for them."""
    with writing(store.runs), open(store.runs / f"{entry.id}.log", "wb") as log:
        process = subprocess.Popen(
            argv,
            stdin=subprocess.PIPE,  # it closes when this process ends, however that happens
            stdout=subprocess.DEVNULL,
            stderr=log,
            pass_fds=() if lock is None else (lock,),
        )
    cores = _cores(jobs, [r.cores for r in running])
    if cores:
        with suppress(ProcessLookupError):  # it has ended already: its exit code will tell
            os.sched_setaffinity(process.pid, cores)
    return Running(entry, process, need_mib, cores, time.monotonic(), len(running) + 1)


def _cores(jobs: int, taken: list[tuple[int, ...]]) -> tuple[int, ...]:
    """One of ``jobs`` equal shares of the cores that nobody has; empty where there is nothing to share."""
    if jobs < 2 or not hasattr(os, "sched_setaffinity"):
        return ()
    mine = sorted(os.sched_getaffinity(0))
    count = max(1, usable_cores() // jobs)
    shares = [tuple(mine[k * count : (k + 1) * count]) for k in range(len(mine) // count)]
    return next((share for share in shares if share not in taken), ())


def _recorded(finished: Running, store: Store) -> dict[str, Any]:
    if finished.process.stdin is not None:
        finished.process.stdin.close()
    entry, log = finished.entry, store.runs / f"{finished.entry.id}.log"
    record = record_of(
        entry,
        store.run_folder(entry),
        exit_code=finished.process.returncode,
        said=_last_of(log),
        wall_s=time.monotonic() - finished.began_s,
        jobs=finished.jobs,
    )
    store.put(entry, record)
    return record


def _last_of(log: Path) -> str:
    """The end of what an entry has said."""
    with log.open("rb") as file:
        file.seek(max(0, log.stat().st_size - LOG_END_BYTES))
        return file.read().decode("utf-8", "replace")


@contextmanager
def _stopped_at_the_end(running: list[Running]) -> Iterator[None]:
    """Whatever happens, no entry goes on alone: each is asked to stop, and then made to."""
    try:
        yield
    finally:
        for r in running:
            with suppress(ProcessLookupError):
                r.process.terminate()
        end = time.monotonic() + END_S
        for r in running:
            try:
                r.process.wait(max(0.1, end - time.monotonic()))
            except subprocess.TimeoutExpired:
                r.process.kill()
                r.process.wait()
