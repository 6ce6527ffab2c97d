"""Whole files, refused by what they are and by their size before they are opened."""

from __future__ import annotations

import errno
import json
import os
import stat
from collections.abc import Callable
from pathlib import Path
from typing import Any

from ..errors import InputError, SlamError

Refusal = Callable[[str], SlamError]
MOST_TEXT_BYTES = 64 * 2**20  # of a list or a trajectory: an hour at 200 poses a second
MOST_JSON_BYTES = 32 * 2**20  # of run.json: it names every frame
MOST_BYTES = 2**30  # of a cloud or a splat
MOST_NAME_BYTES = 255  # of one part of a path, on all systems
WORDS = {
    errno.ENOENT: "no such file",
    errno.ENOTDIR: "no such file",
    errno.ELOOP: "links that lead in a circle",
    errno.ENAMETOOLONG: "a name that is too long",
}


def user_path(text: str | os.PathLike[str], where: str = "path", refusal: Refusal = InputError) -> Path:
    """A path as a user gives it, ``~`` expanded. Raises InputError for one that no file can have."""
    given = os.fspath(text)
    if "\0" in given:
        raise refusal(f"{where}: expected a path, got {short(given)!r}, which holds a zero byte")
    for part in Path(given).parts:
        size = len(os.fsencode(part)) if _encodes(part) else 0
        if not 0 < size <= MOST_NAME_BYTES:
            got = f"{short(part)!r} of {size} bytes" if size else f"{short(part)!r}, which is no text"
            raise refusal(f"{where}: expected names of at most {MOST_NAME_BYTES} bytes, got {got}")
    try:
        return Path(given).expanduser()
    except RuntimeError as e:
        raise refusal(f"{where}: expected a path, got {short(given)!r}: there is no such home folder") from e


def resolved(path: Path) -> Path:
    """The absolute path without links. Raises InputError for links that lead in a circle."""
    try:
        return path.resolve()
    except (OSError, RuntimeError) as e:
        raise InputError(f"{path}: expected a path, got links that lead in a circle, or one too long") from e


def is_file(path: Path) -> bool:
    """Whether there is a plain file; False, too, for what cannot be asked for or looked at.

    These three stand for pathlib's own, which raise where a folder on the way may not be looked into.
    """
    return os.path.isfile(path)


def is_dir(path: Path) -> bool:
    """Whether there is a folder; False as for ``is_file``."""
    return os.path.isdir(path)


def exists(path: Path) -> bool:
    """Whether there is anything; False as for ``is_file``."""
    return os.path.exists(path)


def check_plain(path: Path, expected: str, refusal: Refusal = InputError, most: int | None = None) -> int:
    """Size in bytes of a plain file of at most ``most``. Raises InputError: other kinds could block or never end."""
    try:
        info = os.stat(path)
    except (OSError, ValueError) as e:
        raise refusal(f"{path}: expected {expected}, got {why(e)}") from e
    if not stat.S_ISREG(info.st_mode):
        raise refusal(f"{path}: expected {expected}, got {_kind(info.st_mode)}")
    if most is not None and info.st_size > most:
        raise refusal(f"{path}: expected {expected} of at most {most} bytes, got {info.st_size}")
    return info.st_size


def whole_bytes(path: Path, expected: str, refusal: Refusal = InputError, most: int = MOST_BYTES) -> bytes:
    """What a plain file holds. Raises InputError."""
    check_plain(path, expected, refusal, most)
    try:
        with open(path, "rb") as file:
            return file.read(most)  # it may have grown
    except OSError as e:
        raise refusal(f"{path}: expected {expected}, got {why(e)}") from e


def first_bytes(path: Path, count: int, expected: str, refusal: Refusal = InputError) -> bytes:
    """What a plain file begins with. Raises InputError."""
    check_plain(path, expected, refusal)
    try:
        with open(path, "rb") as file:
            return file.read(count)
    except OSError as e:
        raise refusal(f"{path}: expected {expected}, got {why(e)}") from e


def is_closed(folder: Path) -> bool:
    """Whether a folder is there, and may not be looked into by this user."""
    return os.path.isdir(folder) and not os.access(folder, os.R_OK | os.X_OK)


def whole_text(path: Path, expected: str, refusal: Refusal = InputError, most: int = MOST_TEXT_BYTES) -> str:
    """The same as text, UTF-8 with or without a byte order mark. Raises InputError."""
    try:
        return whole_bytes(path, expected, refusal, most).decode("utf-8-sig")
    except UnicodeDecodeError as e:
        raise refusal(f"{path}: expected {expected}, got bytes that are no UTF-8 ({e.reason} at {e.start})") from e


def whole_json(path: Path, expected: str = "readable JSON", most: int = MOST_JSON_BYTES) -> dict[str, Any]:
    """A JSON object. Raises InputError."""
    return json_object(whole_text(path, expected, InputError, most), str(path), expected)


def json_object(text: str, where: str, expected: str = "readable JSON") -> dict[str, Any]:
    """A JSON object; ``where`` for messages. Raises InputError."""
    try:
        data = json.loads(text)
    except (ValueError, RecursionError) as e:
        raise InputError(f"{where}: expected {expected}, got {e}") from e
    if not isinstance(data, dict):
        raise InputError(f"{where}: expected a JSON object, got {type(data).__name__}")
    return data


def entries_of(folder: Path, expected: str = "a folder that can be read") -> list[Path]:
    """What is in a folder, in order of name. Raises InputError."""
    try:
        return sorted(folder.iterdir())
    except OSError as e:
        raise InputError(f"{folder}: expected {expected}, got {why(e)}") from e


def why(error: OSError | ValueError) -> str:
    """An error of the system in words."""
    if isinstance(error, OSError):
        return WORDS.get(error.errno or 0) or (error.strerror or str(error)).lower()
    return " ".join(str(error).split())


def short(value: object, most: int = 60) -> str:
    """The beginning of what is repeated in a message."""
    text = value if isinstance(value, str) else repr(value)
    return text if len(text) <= most else f"{text[:most]}…"


def _encodes(text: str) -> bool:
    try:
        os.fsencode(text)
    except UnicodeEncodeError:
        return False
    return True


def _kind(mode: int) -> str:
    kinds = {stat.S_IFDIR: "a folder", stat.S_IFIFO: "a named pipe", stat.S_IFSOCK: "a socket"}
    return kinds.get(stat.S_IFMT(mode), "a device")
