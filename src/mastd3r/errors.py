"""One base exception, one child per cause; the command line turns them into one line and exit code 2."""

from __future__ import annotations


class SlamError(Exception):
    """Anything that a user can mend. The message says what, where, expected, got."""


class InputError(SlamError):
    """A source, or a file of one, that is missing, unreadable, truncated or of the wrong shape."""


class ConfigError(SlamError):
    """An unknown key, a value of the wrong type or out of range."""


class MissingPackage(SlamError):
    """An optional package is needed; the message carries the pip line."""


class OutputError(SlamError):
    """The run folder cannot be written (no space, no permission)."""


def reason_of(error: BaseException) -> str:
    """Why a run ended, in one line."""
    said = " ".join(str(error).split())
    if isinstance(error, SlamError):
        return said
    if isinstance(error, KeyboardInterrupt):
        return said or "stopped by the user (Ctrl-C)"
    if isinstance(error, MemoryError):
        return f"out of memory: expected more to be free, got {said or 'no more'}; use a lower width or fewer frames"
    return f"unexpected {type(error).__name__}{said and ': '}{said}"
