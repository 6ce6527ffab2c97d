"""run.log: what a run said, with times, and where an unexpected error came from."""

from __future__ import annotations

import logging
import traceback
from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any

from ..errors import SlamError

PACKAGE = __name__.split(".")[0]
FORMAT = "%(asctime)s %(levelname)s %(name)s: %(message)s"


class _Handler(logging.FileHandler):
    """A full disk does not stop a run for want of its log."""

    def handleError(self, record: logging.LogRecord) -> None:
        """Say nothing."""


def _locked(path: Path) -> Any:
    """The file at ``path``, open and locked; None where another one holds it, or locks are not to be had."""
    try:
        import fcntl
    except ImportError:  # Windows
        return None
    try:
        file = open(path, "ab")  # noqa: SIM115  it is kept open
    except OSError:
        return None
    try:
        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError:
        file.close()
        return None
    return file


def is_held(path: Path) -> bool:
    """Whether a process that is alive writes this log."""
    try:
        import fcntl

        with open(path, "rb") as file:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        return True
    except (ImportError, OSError):
        return False
    return False


class RunLog:
    """Takes what the package logs from ``open`` to ``close``, at the level that the application has chosen."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self._handler: logging.Handler | None = None
        self._held: Any = None  # the open file whose lock says that a process writes here

    def begin(self, record: Mapping[str, Any]) -> None:
        """The first lines: what was asked for, where."""
        words = [f"{key}: {record[key]}" for key in ("started", "command", "machine")]
        self._write("".join(f"{line}\n" for line in words))

    def open(self) -> None:
        """From now on; until ``close``, or the end of the process however it comes, ``is_held`` is true of the file."""
        if self._handler is None:
            self._held = _locked(self.path)
            self._handler = _Handler(self.path, encoding="utf-8", errors="backslashreplace", delay=True)
            self._handler.setFormatter(logging.Formatter(FORMAT))
            logging.getLogger(PACKAGE).addHandler(self._handler)

    def ended_by(self, error: BaseException) -> None:
        """What stopped the run; a fault of ours with its traceback, and a note at the error that says where it is."""
        if isinstance(error, SlamError | KeyboardInterrupt | MemoryError):
            self._write(f"ended: {type(error).__name__}: {error}\n")
            return
        self._write("ended by an error that is not the user's:\n" + "".join(traceback.format_exception(error)))
        error.add_note(f"{self.path} holds the traceback: please report it with that file")

    def close(self) -> None:
        """No more."""
        if self._handler is not None:
            logging.getLogger(PACKAGE).removeHandler(self._handler)
            with suppress(OSError):
                self._handler.close()
                if self._held is not None:
                    self._held.close()
            self._handler = self._held = None

    def _write(self, text: str) -> None:
        with suppress(OSError), open(self.path, "a", encoding="utf-8", errors="backslashreplace") as file:
            file.write(text)
