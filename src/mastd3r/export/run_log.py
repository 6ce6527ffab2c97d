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


class RunLog:
    """Takes what the package logs from ``open`` to ``close``, at the level that the application has chosen."""

    def __init__(self, path: Path) -> None:
        self.path, self._handler = path, None  # type: Path, logging.Handler | None

    def begin(self, record: Mapping[str, Any]) -> None:
        """The first lines: what was asked for, where."""
        words = [f"{key}: {record[key]}" for key in ("started", "command", "machine")]
        self._write("".join(f"{line}\n" for line in words))

    def open(self) -> None:
        """From now on."""
        if self._handler is None:
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
            self._handler = None

    def _write(self, text: str) -> None:
        with suppress(OSError), open(self.path, "a", encoding="utf-8", errors="backslashreplace") as file:
            file.write(text)
