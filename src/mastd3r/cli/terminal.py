"""Progress as bars on a terminal."""

from __future__ import annotations

import time
from collections.abc import Iterable, Iterator
from contextlib import contextmanager

from rich.console import Console, RenderableType
from rich.progress import (
    BarColumn,
    MofNCompleteColumn,
    Progress,
    ProgressColumn,
    Task,
    TaskID,
    TextColumn,
    TimeRemainingColumn,
)
from rich.text import Text

from ..progress import Bar

LINE_EVERY_S = 30.0


class _Speed(ProgressColumn):
    def render(self, task: Task) -> Text:
        speed = task.finished_speed or task.speed
        return Text(f"{speed:6.1f} {task.fields['unit']}/s" if speed else "", style="cyan")


class _Progress(Progress):
    """Bars, and below them the line that was said last."""

    said = ""

    def get_renderables(self) -> Iterable[RenderableType]:
        yield from super().get_renderables()
        if self.said:
            yield Text(self.said, style="dim", overflow="ellipsis")


class _RichBar:
    def __init__(self, progress: _Progress, task: TaskID) -> None:
        self._progress, self._task = progress, task

    def advance(self, steps: int = 1) -> None:
        self._progress.advance(self._task, steps)

    def say(self, text: str) -> None:
        self._progress.said = text


class _LineBar:
    """A line now and then, where output goes to a file: how far the stage is."""

    def __init__(self, console: Console, name: str, total: int | None, unit: str) -> None:
        self._console, self._name, self._of, self._unit = console, name, f" of {total}" if total else "", unit
        self._done, self._began, self._told = 0, time.monotonic(), time.monotonic()

    def advance(self, steps: int = 1) -> None:
        self._done += steps
        now = time.monotonic()
        if now - self._told >= LINE_EVERY_S:
            self._told = now
            speed = self._done / (now - self._began)
            self._line(f"{self._done}{self._of} {self._unit}, {speed:.1f} {self._unit}/s")

    def say(self, text: str) -> None:
        if time.monotonic() - self._told >= LINE_EVERY_S:
            self._told = time.monotonic()
            self._line(text)

    def _line(self, text: str) -> None:
        self._console.print(f"{self._name}: {text}", markup=False, highlight=False, soft_wrap=True)


class Terminal:
    """Bars with speed and remaining time, one a stage, through rich; lines where output is no terminal."""

    def __init__(self, console: Console) -> None:
        self.console = console

    @contextmanager
    def stage(self, name: str, total: int | None, unit: str) -> Iterator[Bar]:
        if not self.console.is_terminal:
            yield _LineBar(self.console, name, total, unit)
            return
        columns = (
            TextColumn("{task.description:<12}"), BarColumn(), MofNCompleteColumn(), _Speed(),
            TextColumn("left"), TimeRemainingColumn(),
        )  # fmt: skip
        with _Progress(*columns, console=self.console) as progress:
            task = progress.add_task(name, total=total, unit=unit)
            yield _RichBar(progress, task)
            if total is None:
                progress.update(task, total=progress.tasks[0].completed)
