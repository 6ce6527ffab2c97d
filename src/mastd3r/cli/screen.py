"""Where a command prints: what users, servers and files say never reaches the terminal as control characters."""

from __future__ import annotations

import os
from contextlib import suppress
from typing import Any

from rich.console import Console, ConsoleOptions, ConsoleRenderable, RenderHook, RenderResult
from rich.segment import Segment


def plain(text: str, keep: str = "\n") -> str:
    """The same with every character that is not printable written out as \\x1b, but for those to ``keep``."""
    if text.isprintable():
        return text
    return "".join(
        c if c.isprintable() or c in keep else c.encode("unicode_escape", "surrogatepass").decode() for c in text
    )


class _Plain:
    """What another renderable shows, its text plain; colours and moves of the cursor are rich's own, and stay."""

    def __init__(self, inner: Any) -> None:
        self.inner = inner

    def __rich_console__(self, console: Console, options: ConsoleOptions) -> RenderResult:
        for part in console.render(self.inner, options):
            yield part if part.control else Segment(plain(part.text), part.style)


class _Hook(RenderHook):
    def process_renderables(self, renderables: list[ConsoleRenderable]) -> list[ConsoleRenderable]:
        return [_Plain(r) for r in renderables]


class _Screen(Console):
    def on_broken_pipe(self) -> None:
        """Nobody reads any more (``| head``): nothing more is shown, and the work goes on."""
        self.quiet = True
        with suppress(OSError, ValueError):
            os.dup2(os.open(os.devnull, os.O_WRONLY), self.file.fileno())


def screen(*, stderr: bool = False) -> Console:
    """A console for results, or with ``stderr`` for all that is said on the way."""
    console = _Screen(stderr=stderr)
    console.push_render_hook(_Hook())
    return console
