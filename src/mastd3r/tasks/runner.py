"""Tasks in their order, as many at once as their place has room for; what is killed is tried again."""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass
from pathlib import Path
from typing import Literal, Protocol

from .process import POLL_S, Ended

MORE_MEMORY = 2.0  # a task that was killed is taken to need so many times what it was given


@dataclass(frozen=True)
class Task:
    """One command."""

    name: str
    argv: Callable[[int], list[str]]  # of its first attempt (1), its second, …; what it says may make room for it
    log: Path  # what it says goes here
    run: Path  # the folder that it writes


@dataclass(frozen=True)
class Change:
    """What has just become of a task."""

    task: Task
    state: Literal["started", "ended", "again"]  # again: it was killed, and waits for another attempt
    attempt: int  # from 1
    ended: Ended | None = None  # of this attempt
    at_once: int = 1  # the most that ran while it did
    node: str = ""  # of a cluster


class Place(AbstractContextManager["Place"], Protocol):
    """Where tasks run. Left as a context, whatever still runs there is stopped."""

    def has_room(self, need_mib: float) -> bool:
        """Whether one more task may be given."""

    def give(self, task: Task, attempt: int, need_mib: float) -> None:
        """Take a task. Raises OutputError."""

    def begun(self) -> Iterable[tuple[Task, str]]:
        """Tasks that have begun since the last call, each with its node."""

    def ended(self) -> Iterable[tuple[Task, Ended]]:
        """Tasks that have ended since the last call. Raises SlamError where none can go on."""


Needs = Callable[[Collection[Task]], Mapping[str, float]]  # MiB by name, asked anew when one has ended


def run_tasks(
    tasks: Sequence[Task], place: Place, needs: Needs, changed: Callable[[Change], None], *, retries: int = 0
) -> None:
    """Run tasks in their order; ``changed`` hears of everything that becomes of one.

    A task that is killed, or whose node is lost, is tried ``retries`` times more, each time as if it needed
    ``MORE_MEMORY`` times as much; one that ends by itself is not, whatever its exit code. Whatever is raised, by
    ``changed`` or on Ctrl-C, ends all that run.
    """
    waiting, given, running = deque(tasks), set[str](), set[str]()
    attempts, at_once = dict.fromkeys((t.name for t in tasks), 0), dict[str, int]()
    with place:
        mib = needs(waiting)
        while waiting or given:
            while waiting:
                task = waiting[0]
                need_mib = mib[task.name] * MORE_MEMORY ** attempts[task.name]
                if not place.has_room(need_mib):
                    break
                waiting.popleft()
                attempts[task.name] += 1
                given.add(task.name)
                place.give(task, attempts[task.name], need_mib)
            time.sleep(POLL_S)
            for task, node in place.begun():
                running.add(task.name)
                at_once |= {name: max(at_once.get(name, 0), len(running)) for name in running}
                changed(Change(task, "started", attempts[task.name], node=node))
            for task, ended in place.ended():
                attempt = attempts[task.name]
                if task.name not in running:  # so quick that nobody saw it begin
                    changed(Change(task, "started", attempt, node=ended.node))
                given.discard(task.name)
                running.discard(task.name)
                again = ended.killed and attempt <= retries
                if again:
                    waiting.appendleft(task)
                most = at_once.pop(task.name, 1)
                changed(Change(task, "again" if again else "ended", attempt, ended, most, ended.node))
                mib = needs(waiting)
