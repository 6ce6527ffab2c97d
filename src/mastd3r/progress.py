"""Progress of a run or a download: where stages say how far they are. Bars on a terminal: ``cli/terminal.py``."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, ExitStack, contextmanager
from typing import Protocol


class Bar(Protocol):
    """One stage's progress."""

    def advance(self, steps: int = 1) -> None:
        """So many more are done."""
        ...

    def say(self, text: str) -> None:
        """What is known of the stage now, in one line; it replaces what was said before."""
        ...


class Reporter(Protocol):
    """Where stages say how far they are."""

    def stage(self, name: str, total: int | None, unit: str) -> AbstractContextManager[Bar]:
        """A context whose value is the stage's Bar."""
        ...


class _Nothing:
    def advance(self, steps: int = 1) -> None:
        pass

    def say(self, text: str) -> None:
        pass


class Silent:
    """Reports nothing."""

    @contextmanager
    def stage(self, name: str, total: int | None, unit: str) -> Iterator[Bar]:
        yield _Nothing()


class FileBars:
    """One bar a file, in units that people read, opened when the first bytes are there."""

    def __init__(self, reporter: Reporter) -> None:
        self._reporter, self._stack = reporter, ExitStack()
        self._bar: Bar | None = None
        self._unit, self._shown = 10**6, 0

    def __enter__(self) -> FileBars:
        return self

    def __exit__(self, *error: object) -> None:
        self._stack.close()

    def watch(self, name: str) -> Callable[[int, int | None], None]:
        """Where ``fetch`` tells how far the file of that name is."""
        self._stack.close()
        self._bar = None

        def tell(done: int, total: int | None) -> None:
            if self._bar is None:
                self._unit, unit = (10**3, "kB") if total is not None and total < 10**7 else (10**6, "MB")
                steps = -(-total // self._unit) if total is not None else None
                self._bar, self._shown = self._stack.enter_context(self._reporter.stage(name, steps, unit)), 0
            steps_done = -(-done // self._unit)
            self._bar.advance(steps_done - self._shown)
            self._shown = steps_done

        return tell
