"""Running a suite's missing entries: tasks of their own, as many at once as jobs and memory allow."""

from __future__ import annotations

import shutil
import sys
from collections.abc import Callable, Collection, Mapping, Sequence
from pathlib import Path
from typing import Any

from ..errors import ConfigError
from ..export.files import writing
from ..reading.files import exists
from ..tasks.processes import Limits, Processes
from ..tasks.runner import Change, Place, Task, run_tasks
from .store import Store, command_of, record_of
from .suite import Entry

Launch = Callable[[Entry, Path, Path], list[str]]  # entry, sequence folder, run folder -> argument vector


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
    elsewhere: Place | None = None,
) -> None:
    """Run entries in their order; each leaves a JSON in the store, whether it worked or not, and calls ``done``.

    ``folders`` has the folder of every sequence's name. An entry starts when fewer than ``allowed.jobs`` run and
    their memory and its own, measured on its like or declared, keep within the budget; ``elsewhere`` is a place with
    limits of its own. Ctrl-C stops what runs and records nothing of it. Raises ConfigError before anything starts
    where one entry alone is over the budget.
    """
    needs = store.needs(entries)
    for entry in entries:
        if elsewhere is None and (need := needs[entry.id]) > allowed.memory_mib:
            got = f"{allowed.memory_mib:.0f}"
            raise ConfigError(f"--memory-mib: expected {need:.0f} or more, which {entry.label} needs, got {got}")
    by_id = {entry.id: entry for entry in entries}

    def task_of(entry: Entry) -> Task:
        run = store.run_folder(entry).absolute()

        def argv(attempt: int) -> list[str]:
            return launch(entry, folders[entry.sequence.name].absolute(), _fresh(run))

        return Task(entry.id, argv, run.with_name(f"{entry.id}.log"), run)

    def changed(change: Change) -> None:
        if change.ended is not None:
            entry = by_id[change.task.name]
            record = record_of(entry, change.task.run, change.ended, jobs=change.at_once)
            store.put(entry, record)
            done(entry, record)

    def needed(tasks: Collection[Task]) -> dict[str, float]:
        return store.needs([by_id[task.name] for task in tasks])

    with store.locked() as lock:
        place = Processes(allowed, lock) if elsewhere is None else elsewhere
        run_tasks([task_of(entry) for entry in entries], place, needed, changed)


def _fresh(folder: Path) -> Path:
    """What an interrupted run has left there goes."""
    if exists(folder):
        with writing(folder):
            shutil.rmtree(folder)
    return folder
