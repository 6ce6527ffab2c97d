"""One command in a process of its own: begun, watched, ended, and what it cost."""

from __future__ import annotations

import os
import subprocess
import sys
import time
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

from ..export.files import writing

LOG_END_BYTES = 2**16  # of what a command has said, its last line is looked for in
END_S = 20.0  # for a run to save what it has, once it is told to stop
POLL_S = 0.1
STOPPED = 130  # exit code of a command that was told to stop


@dataclass(frozen=True)
class Ended:
    """What came of one attempt."""

    exit_code: int | None  # below 0: ended by that signal; None: whoever watched it is gone, with it or without
    said: str  # the end of its log, or why nobody knows its exit code
    wall_s: float
    processor_s: float | None = None  # of it and all that it started; None where the system does not say
    peak_mib: float | None = None
    node: str = ""  # of a cluster

    @property
    def killed(self) -> bool:
        """True where it did not end by itself, so that the same command may well succeed."""
        return self.exit_code is None or self.exit_code < 0 or self.exit_code == STOPPED

    @property
    def reason(self) -> str:
        """Why it has no result, in one line."""
        if self.exit_code is None:
            return self.said
        if self.exit_code < 0:
            perhaps = ", perhaps for want of memory" if self.exit_code == -9 else ""
            return f"ended by signal {-self.exit_code}{perhaps}"
        lines = self.said.strip().splitlines()
        return lines[-1].removeprefix("mastd3r: ") if lines else f"exit code {self.exit_code} and no message"


class Child:
    """A process that ends, as on Ctrl-C, when this one does: its standard input closes then."""

    def __init__(
        self, argv: Sequence[str], log: Path, *, cores: tuple[int, ...] = (), inherits: tuple[int, ...] = ()
    ) -> None:
        """``log`` gets what it says; ``cores`` it may run on, any where empty; ``inherits``: open files it keeps.

        Raises OutputError.
        """
        self.log, self._began_s = log, time.monotonic()
        with writing(log), open(log, "wb") as file:
            self.process = subprocess.Popen(
                list(argv), stdin=subprocess.PIPE, stdout=subprocess.DEVNULL, stderr=file, pass_fds=inherits
            )
        if cores:
            with suppress(ProcessLookupError):  # it has ended already: its exit code will tell
                os.sched_setaffinity(self.process.pid, cores)

    def ended(self) -> Ended | None:
        """What came of it; None while it goes on."""
        usage = None
        if self.process.returncode is None and hasattr(os, "wait4"):
            pid, status, usage = os.wait4(self.process.pid, os.WNOHANG)
            if pid:
                self.process.returncode = os.waitstatus_to_exitcode(status)
        if self.process.poll() is None:
            return None
        if self.process.stdin is not None:
            self.process.stdin.close()
        processor_s = None if usage is None else usage.ru_utime + usage.ru_stime
        peak_mib = None if usage is None else usage.ru_maxrss / (2**20 if sys.platform == "darwin" else 2**10)
        wall_s = time.monotonic() - self._began_s
        return Ended(self.process.returncode, _end_of(self.log), wall_s, processor_s, peak_mib)

    def ask_to_stop(self) -> None:
        """As Ctrl-C does; where a signal would end it at once (Windows), by closing its standard input."""
        with suppress(ProcessLookupError):
            if os.name == "nt" and self.process.stdin is not None:
                self.process.stdin.close()
            else:
                self.process.terminate()

    def wait_or_kill(self, end_s: float) -> None:
        """Wait until ``end_s`` of the monotonic clock, then make it end."""
        try:
            self.process.wait(max(0.1, end_s - time.monotonic()))
        except subprocess.TimeoutExpired:
            self.process.kill()
            self.process.wait()


def _end_of(log: Path) -> str:
    with log.open("rb") as file:
        file.seek(max(0, log.stat().st_size - LOG_END_BYTES))
        return file.read().decode("utf-8", "replace")
