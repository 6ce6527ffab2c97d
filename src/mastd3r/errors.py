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
