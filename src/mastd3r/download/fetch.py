"""Getting one file, from the net or from the disk: resumed, checked, and there whole or not at all.

A download grows in ``NAME.part``; ``NAME.part.json`` says which file of the server it is the beginning of (RFC 9110,
sections 13 and 14: ETag, Last-Modified, Range, If-Range). A dropped connection, or a command that is run again, goes on
from there; a file that has changed on the server begins again.
"""

from __future__ import annotations

import errno
import hashlib
import http.client
import json
import os
import re
import shutil
import time
import urllib.error
import urllib.request
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any, BinaryIO

from ..errors import InputError, OutputError
from ..reading.files import check_plain, is_file, short, user_path, whole_json, why
from .http import OPENER, whole_number

CHUNK_BYTES = 1 << 20
AGENT = "mastd3r-slam"
TRANSIENT = {408, 425, 429, 500, 502, 503, 504}  # HTTP answers worth another try
MAX_PAUSE_S = 30.0
SLOWEST_BYTES_S = 1000.0  # over as long as an answer may take to begin; a connection that is slower counts as cut
TOO_SLOW = f"slower than {SLOWEST_BYTES_S:.0f} bytes a second"
MOST_NOTE_BYTES = 2**16  # of what is kept beside a part

Progress = Callable[[int, int | None], None]  # (bytes that are there, bytes in all or None where unknown)


class Unreachable(InputError):
    """The server did not answer at all."""


class Interrupted(InputError):
    """The server answered, but never to the end. What has arrived is kept."""


class _Again(Exception):
    """This answer cannot be used; the next request begins at the first byte."""


@dataclass(frozen=True)
class Fetched:
    """A file that has arrived."""

    path: Path
    size_bytes: int
    sha256: str
    resumed_bytes: int  # taken over from an earlier, interrupted command


@dataclass(frozen=True)
class Wanted:
    """What is known of a file before it is fetched."""

    sha256: str | None = None  # hexadecimal
    size_bytes: int | None = None
    most_bytes: int | None = None  # where only a bound is known
    md5: str | None = None  # hexadecimal; for servers that publish no better one
    check: Callable[[Path], None] | None = None  # raises SlamError for a file whose content is no good


ANYTHING = Wanted()


def fetch(
    source: str | Path,
    target: Path,
    want: Wanted = ANYTHING,
    *,
    progress: Progress | None = None,
    attempts: int = 6,
    pause_s: float = 1.0,
    timeout_s: float = 30.0,
) -> Fetched:
    """Bring ``source`` (http, https or file URL, or a path) to ``target``, which appears only when whole and right.

    A target with the wanted checksum is left alone. After ``attempts`` failures in a row without a new byte it gives
    up (two, if the server never answered), waiting ``pause_s``, doubled each time, in between.
    Raises Unreachable, Interrupted, OutputError (these leave the part), and InputError: refused, or of the wrong
    length, checksum or content, with the part removed.
    """
    user_path(_beside(target, ".part.json"), str(short(str(source))))  # the longest name of them
    if want.sha256 and is_file(target) and sha256_of(target) == want.sha256:
        return Fetched(target, target.stat().st_size, want.sha256, 0)
    with _writing(target):
        target.parent.mkdir(parents=True, exist_ok=True)
    part, report = _beside(target, ".part"), progress or _no_progress
    local = local_path(source)
    if local is not None:
        _copy(local, part, want, report)
        return _finish(str(source), part, target, want, 0)
    transfer = _Transfer(str(source), part, want, report, timeout_s)
    transfer.run(target, attempts, pause_s)
    resumed = transfer.resumed_bytes
    try:
        return _finish(str(source), part, target, want, resumed)
    except InputError:
        if not resumed:
            raise
    # The old part was of another file than its note says, or was damaged on the disk: once more from the first byte.
    transfer.run(target, attempts, pause_s)
    return _finish(str(source), part, target, want, 0)


def local_path(source: str | Path) -> Path | None:
    """The file that a path or a file URL names; None for a URL of the net. Raises InputError for other schemes."""
    if isinstance(source, Path) or "://" not in source:
        return user_path(source)
    scheme, _, rest = source.partition("://")
    if scheme.lower() in ("http", "https"):
        return None
    if scheme.lower() == "file" and rest.startswith(("/", "localhost/")):
        return Path(urllib.request.url2pathname(rest.removeprefix("localhost")))
    raise InputError(f"{source}: expected a http, https or file URL of this machine, or a path")


def sha256_of(path: Path) -> str:
    """Hexadecimal SHA-256 of a file. Raises InputError."""
    return _digest(path, "sha256")


def md5_of(path: Path) -> str:
    """Hexadecimal MD5 of a file: tells damage, not malice. Raises InputError."""
    return _digest(path, "md5")


def _digest(path: Path, kind: str) -> str:
    check_plain(path, "a readable file")
    try:
        with path.open("rb") as file:
            return hashlib.file_digest(file, kind).hexdigest()
    except OSError as e:
        raise InputError(f"{path}: expected a readable file, got {e.strerror or e}") from e


def human_bytes(count: int | None) -> str:
    """ "2.75 GB" for people; decimal units."""
    if count is None:
        return "unknown size"
    for unit, size in (("GB", 10**9), ("MB", 10**6), ("kB", 10**3)):
        if count >= size:
            return f"{count / size:.3g} {unit}"
    return f"{count} bytes"


class _Transfer:
    """One file of a server and its part on the disk."""

    def __init__(self, url: str, part: Path, want: Wanted, progress: Progress, timeout_s: float) -> None:
        self.url, self.part, self.want, self.progress, self.timeout_s = url, part, want, progress, timeout_s
        self.note_path = _beside(part, ".json")
        self.total: int | None = want.size_bytes
        self.answered = False
        self.resumed_bytes = self.have()
        self.wait_s = 0.0  # that the server has asked for

    def have(self) -> int:
        return self.part.stat().st_size if is_file(self.part) else 0

    def forget(self) -> None:
        """Begin again with the next request."""
        self.resumed_bytes = 0
        remove_part(self.part)

    def run(self, target: Path, attempts: int, pause_s: float) -> None:
        """Try until the part is whole. Raises Unreachable, Interrupted, InputError, OutputError."""
        best, failures = self.have(), 0
        while True:
            reason = self._try()
            if reason is None:
                return
            failures += 1
            if (have := self.have()) > best and reason != TOO_SLOW:
                best, failures = have, 1
            if failures >= (attempts if self.answered else min(attempts, 2)):
                raise self._gave_up(target, reason)
            time.sleep(min(MAX_PAUSE_S, max(self.wait_s, pause_s * 2 ** (failures - 1))))

    def _gave_up(self, target: Path, reason: str) -> InputError:
        if not self.answered:
            what = f"{target.name} ({human_bytes(self.total)})" if self.total else target.name
            return Unreachable(f"{self.url}: cannot be reached ({reason}); without a network, place {what} as {target}")
        text = f"{self.url}: expected the whole file, got {human_bytes(self.have())} of {human_bytes(self.total)}"
        return Interrupted(f"{text} ({reason}); the same command again goes on from there")

    def _try(self) -> str | None:
        """One request. None when the part is whole, else why it is not."""
        self.wait_s = 0.0
        try:
            self._request()
        except urllib.error.HTTPError as e:
            self.answered = True
            e.close()
            if e.code == http.HTTPStatus.REQUESTED_RANGE_NOT_SATISFIABLE:
                return self._past_the_end(e)
            if e.code not in TRANSIENT:
                raise InputError(
                    f"{self.url}: expected a file to download, got HTTP {e.code} {short(str(e.reason))}"
                ) from e
            self.wait_s = float(whole_number(e.headers.get("Retry-After")) or 0)
            return f"HTTP {e.code}"
        except _Again as e:
            self.forget()
            return str(e)
        except ValueError as e:  # urllib and http.client say so for what is no URL
            raise InputError(f"{self.url}: expected a URL, got {e}") from e
        except (OSError, http.client.HTTPException) as e:
            cause = e.reason if isinstance(e, urllib.error.URLError) else e
            return " ".join(str(getattr(cause, "strerror", None) or cause or type(cause).__name__).split())
        return None

    def _past_the_end(self, answer: urllib.error.HTTPError) -> str | None:
        """HTTP 416: the server has nothing behind what is there."""
        length = re.fullmatch(r"bytes \*/([0-9]{1,18})", answer.headers.get("Content-Range", ""))
        expected = self.want.size_bytes or (self._note() or {}).get("total")
        if length and int(length[1]) == self.have() == expected:
            self.total = expected
            return None
        self.forget()
        return "the file has changed on the server"

    def _request(self) -> None:
        note = self._note()
        have = self.have() if note is not None else 0
        headers = {"User-Agent": AGENT, "Accept-Encoding": "identity"}
        if have and note is not None:
            headers["Range"] = f"bytes={have}-"
            if validator := _strong(note):
                headers["If-Range"] = validator
        request = urllib.request.Request(self.url, headers=headers)
        with OPENER.open(request, timeout=self.timeout_s) as answer:
            self.answered = True
            start = self._start(answer, have, note)
            with _writing(self.part), self.part.open("r+b" if start else "wb", buffering=0) as file:
                file.seek(start)
                self._receive(answer, file, start)
        if self.total is not None and self.have() != self.total:
            raise ConnectionError("the connection was closed")

    def _start(self, answer: Any, have: int, note: dict[str, Any] | None) -> int:
        """Where this answer begins in the file; 0 begins again. Raises _Again, InputError, OutputError."""
        if answer.headers.get("Content-Encoding", "identity") != "identity":
            raise InputError(f"{self.url}: expected the file as it is, got it encoded by the server")
        start, total = 0, whole_number(answer.headers.get("Content-Length"))
        if answer.status == http.HTTPStatus.PARTIAL_CONTENT:
            span = re.fullmatch(
                r"bytes ([0-9]{1,18})-[0-9]{1,18}/([0-9]{1,18}|\*)", answer.headers.get("Content-Range", "")
            )
            if span is None or int(span[1]) != have or note is None:
                raise _Again("the server sent another range than asked for")
            start, total = have, int(span[2]) if span[2] != "*" else None
            if _identity(answer.headers, total) != {k: note.get(k) for k in ("etag", "modified", "total")}:
                raise _Again("the file has changed on the server")
        if total is not None and self.want.size_bytes not in (None, total):
            self.forget()
            raise InputError(f"{self.url}: expected {self.want.size_bytes} bytes, the server offers {total}")
        self.total = total if total is not None else self.want.size_bytes
        if start == 0:
            self.resumed_bytes = 0
            self._write_note({"url": self.url, **_identity(answer.headers, total)})
        _check_space(self.part, (self.total or 0) - start)
        return start

    def _receive(self, answer: Any, file: BinaryIO, start: int) -> None:
        done = checked = start
        began = time.monotonic()
        self.progress(done, self.total)
        while chunk := _network(answer.read1, CHUNK_BYTES):
            file.write(chunk)
            done += len(chunk)
            self.progress(done, self.total)
            if done > (self.want.most_bytes or done):
                raise InputError(f"{self.url}: expected at most {human_bytes(self.want.most_bytes)}, got more")
            if (waited_s := time.monotonic() - began) > self.timeout_s:
                if done - checked < SLOWEST_BYTES_S * waited_s:
                    raise _NetworkTrouble(TOO_SLOW)
                began, checked = time.monotonic(), done

    def _note(self) -> dict[str, Any] | None:
        """What the part is the beginning of; None where that is not known, or is another URL."""
        try:
            note = whole_json(self.note_path, most=MOST_NOTE_BYTES)
        except InputError:
            return None
        known = all(note.get(k) is None or isinstance(note[k], str) for k in ("etag", "modified"))
        return note if known and note.get("url") == self.url else None

    def _write_note(self, note: dict[str, Any]) -> None:
        with _writing(self.note_path):
            self.note_path.write_text(json.dumps(note), encoding="utf-8")


class _NetworkTrouble(ConnectionError):
    """An OSError of the connection, told apart from one of the disk."""


def _network(read: Callable[[int], bytes], count: int) -> bytes:
    try:
        return read(count)
    except OSError as e:
        raise _NetworkTrouble(str(e.strerror or e or type(e).__name__)) from e


@contextmanager
def _writing(path: Path) -> Iterator[None]:
    """Turn an OSError of the disk into an OutputError that says the path and what to do."""
    try:
        yield
    except _NetworkTrouble:
        raise
    except OSError as e:
        full = e.errno in (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)
        remedy = "free some space and run the same command again" if full else "choose a folder that can be written"
        raise OutputError(f"{path}: expected to write, got {e.strerror or e}; {remedy}") from e


def _identity(headers: Any, total: int | None) -> dict[str, Any]:
    return {"etag": headers.get("ETag"), "modified": headers.get("Last-Modified"), "total": total}


def _strong(note: dict[str, Any]) -> str | None:
    """The validator that If-Range may carry: a strong ETag, else the date."""
    etag = note.get("etag")
    return etag if etag and not etag.startswith("W/") else note.get("modified")


def _check_space(path: Path, needed: int) -> None:
    free = shutil.disk_usage(path.parent).free
    if needed > free:
        text = f"{path.parent}: expected {human_bytes(needed)} of free space, got {human_bytes(free)}"
        raise OutputError(f"{text}; free some space and run the same command again")


def _copy(source: Path, part: Path, want: Wanted, progress: Progress) -> None:
    """A local file to the part. Raises InputError, OutputError."""
    total, done = check_plain(source, "a file"), 0
    try:
        file = source.open("rb")
    except OSError as e:
        raise InputError(f"{source}: expected a file, got {why(e)}") from e
    with file:
        if want.size_bytes not in (None, total):
            raise InputError(f"{source}: expected {want.size_bytes} bytes, got {total}")
        _check_space(part, total)
        progress(0, total)
        with _writing(part), part.open("wb", buffering=0) as out:
            while chunk := file.read(CHUNK_BYTES):
                out.write(chunk)
                done += len(chunk)
                progress(done, total)


def _finish(source: str, part: Path, target: Path, want: Wanted, resumed: int) -> Fetched:
    """Check the part and give it its name. Raises InputError (the part is removed), OutputError."""
    try:
        size, found = part.stat().st_size, sha256_of(part)
        if want.size_bytes not in (None, size):
            raise InputError(f"{source}: expected {want.size_bytes} bytes, got {size}; what had arrived was removed")
        if want.sha256 not in (None, found):
            text = f"{source}: expected sha256 {want.sha256}, got {found}"
            raise InputError(f"{text}; damaged or another file, what had arrived was removed")
        if want.md5 is not None and (md5 := md5_of(part)) != want.md5:
            text = f"{source}: expected md5 {want.md5}, got {md5}"
            raise InputError(f"{text}; damaged or another file, what had arrived was removed")
        if want.check is not None:
            want.check(part)
    except InputError:
        remove_part(part)
        raise
    with _writing(target):
        os.replace(part, target)
    remove_part(part)
    return Fetched(target, size, found, resumed)


def remove_part(part: Path) -> None:
    """Remove a ``.part`` file and its note, where they are."""
    for path in (part, _beside(part, ".json")):
        with suppress(FileNotFoundError):
            path.unlink()


def _beside(path: Path, ending: str) -> Path:
    return path.with_name(path.name + ending)


def _no_progress(done: int, total: int | None) -> None:
    pass
