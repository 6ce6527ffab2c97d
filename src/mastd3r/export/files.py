"""Writing files so that a reader never sees half of one, and a full disk is one clear line."""

from __future__ import annotations

import errno
import json
import math
import os
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

import numpy as np

from ..errors import OutputError
from ..reading.files import exists, is_dir, is_file

REMEDY = {
    errno.ENOSPC: "free some space or choose another folder with --out",
    errno.EDQUOT: "the quota is used up: free some space or choose another folder with --out",
    errno.EACCES: "allow writing there or choose another folder with --out",
    errno.EPERM: "allow writing there or choose another folder with --out",
    errno.EROFS: "the file system is read-only: choose another folder with --out",
}


@contextmanager
def writing(path: Path) -> Iterator[None]:
    """Turn an OSError of the body into an OutputError that says the path and what to do."""
    try:
        yield
    except OSError as e:
        remedy = REMEDY.get(e.errno or 0, "choose another folder with --out")
        raise OutputError(f"{path}: expected to write, got {e.strerror or e}; {remedy}") from e


def write_bytes(path: Path, data: bytes) -> None:
    """Write a file whole or not at all: a temporary beside it, then a rename. Raises OutputError."""
    with replacing(path) as temporary, open(temporary, "wb") as file:
        file.write(data)


@contextmanager
def replacing(path: Path, suffix: str = "") -> Iterator[Path]:
    """A temporary beside ``path`` for the body to write; it takes the place of ``path`` only once the body is done.

    ``suffix``: what its name must end with, where a writer goes by that. Raises OutputError, also for a device or a
    pipe, which would be gone.
    """
    if path.name in ("", ".."):
        raise OutputError(f"{path}: expected a file with a name of its own to write, got a folder")
    if exists(path) and not (is_file(path) or is_dir(path)):
        raise OutputError(f"{path}: expected to write a file of its own, got a device or a pipe of that name")
    temporary = path.with_name(f"{path.name}.part{suffix}")
    with writing(path):
        try:
            yield temporary
            os.replace(temporary, path)
        except BaseException:
            with suppress(OSError):
                temporary.unlink()
            raise


def write_text(path: Path, text: str) -> None:
    """``write_bytes`` in UTF-8; names that are none are written as the bytes that they are."""
    try:
        data = text.encode("utf-8", "surrogateescape")
    except UnicodeEncodeError:
        data = text.encode("utf-8", "backslashreplace")
    write_bytes(path, data)


def write_json(path: Path, data: dict[str, Any]) -> None:
    """``write_text`` of indented JSON; numpy values become plain ones, non-finite numbers become null."""
    write_text(path, json.dumps(plain(data), indent=2, allow_nan=False) + "\n")


def plain(value: Any) -> Any:
    """The same value in JSON's own types."""
    if isinstance(value, dict):
        return {str(k): plain(v) for k, v in value.items()}
    if isinstance(value, list | tuple | np.ndarray):
        return [plain(v) for v in value]
    if isinstance(value, np.generic):
        return plain(value.item())
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return str(value) if isinstance(value, Path) else value
