"""SIGTERM and SIGHUP end a command as Ctrl-C does: with all that was computed, in one line."""

from __future__ import annotations

import signal
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from types import FrameType

from ..concurrency import stop_with

REASONS = {"SIGINT": "stopped by the user (Ctrl-C)", "SIGTERM": "stopped by SIGTERM", "SIGHUP": "stopped by SIGHUP"}


@contextmanager
def stopping_signals() -> Iterator[None]:
    """Within it these signals raise KeyboardInterrupt in the main thread, at once or at the end of ``undivided``.

    A signal that is ignored (``nohup``, a shell's background job) stays ignored; nothing happens in other threads,
    which signals do not reach.
    """
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    wanted = {getattr(signal, name): reason for name, reason in REASONS.items() if hasattr(signal, name)}

    def on_signal(number: int, frame: FrameType | None) -> None:
        stop_with(KeyboardInterrupt(wanted[number]))

    before = {number: signal.getsignal(number) for number in wanted}
    heeded = [number for number, handler in before.items() if handler not in (signal.SIG_IGN, None)]
    for number in heeded:
        signal.signal(number, on_signal)
    try:
        yield
    finally:
        for number in heeded:
            signal.signal(number, before[number])


def end_this_command() -> None:
    """From another thread: what SIGTERM does, also where Ctrl-C is ignored."""
    signal.raise_signal(signal.SIGTERM)
