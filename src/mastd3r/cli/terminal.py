"""Progress as bars on a terminal."""

from __future__ import annotations

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


class Terminal:
    """Bars with speed and remaining time, one a stage, through rich."""

    def __init__(self, console: Console) -> None:
        self.console = console

    @contextmanager
    def stage(self, name: str, total: int | None, unit: str) -> Iterator[Bar]:
        columns = (
            TextColumn("{task.description:<12}"), BarColumn(), MofNCompleteColumn(), _Speed(),
            TextColumn("left"), TimeRemainingColumn(),
        )  # fmt: skip
        with _Progress(*columns, console=self.console) as progress:
            task = progress.add_task(name, total=total, unit=unit)
            yield _RichBar(progress, task)
            if total is None:
                progress.update(task, total=progress.tasks[0].completed)
