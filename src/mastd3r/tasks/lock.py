"""A folder that many runs are written in, held against a second command that would write there too."""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from ..errors import OutputError
from ..export.claim import LOCK
from ..export.files import writing
from ..reading.files import check_plain

LOCK_WAIT_S = 15.0  # tasks of a command that was killed end by themselves within seconds


@contextmanager
def alone_in(folder: Path, what: str) -> Iterator[int | None]:
    """Hold a folder; gives the lock's open file, which tasks inherit and so hold too.

    None on a system without such locks. Raises OutputError where another ``what`` keeps it.
    """
    try:
        import fcntl
    except ImportError:  # not a POSIX system: no such lock
        yield None
        return
    with writing(folder):
        (folder / LOCK).touch()
        check_plain(folder / LOCK, "a file for its lock", OutputError)
        file = open(folder / LOCK)  # noqa: SIM115  it is closed below, its errors are of writing
    with file:
        end = time.monotonic() + LOCK_WAIT_S
        while True:
            try:
                fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
                break
            except OSError as e:
                if time.monotonic() > end:
                    raise OutputError(f"{folder}: expected no other {what} at work in it, got one") from e
                time.sleep(0.2)
        yield file.fileno()
