"""Archives that were downloaded: whether they are whole, and unpacking that can do no harm.

A member lands under the folder that was named or the archive is refused: no absolute paths, no ``..``, no links, no
devices, no names that a file system or a terminal cannot take. What is unpacked is compared with the sizes and
checksums that the archive holds, and is never more than a few times what came (``dataset_types``).
"""

from __future__ import annotations

import bz2
import errno
import gzip
import lzma
import shutil
import stat
import struct
import tarfile
import zipfile
import zlib
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from pathlib import Path, PurePosixPath
from typing import IO, Any, cast

from ..errors import InputError, OutputError
from ..reading.files import check_plain, exists, short
from .dataset_types import UNPACKED_LEAST_BYTES, UNPACKED_RATIO

CHUNK_BYTES = 1 << 20
ZIP_STARTS = (b"PK\x03\x04", b"PK\x05\x06")
UNPACKERS = {b"\x1f\x8b": gzip.open, b"BZh": bz2.open, b"\xfd7zXZ\x00": lzma.open}  # first bytes of a compressed tar
DAMAGED = (  # what the readers of these formats raise for bytes that are none of theirs
    *(zipfile.BadZipFile, tarfile.TarError, zlib.error, lzma.LZMAError, EOFError, OSError, NotImplementedError),
    *(ValueError, LookupError, TypeError, OverflowError, RecursionError, struct.error, RuntimeError),
)
MOST_DEEP, MOST_NAME_BYTES, MOST_MEMBERS = 32, 200, 1_000_000  # folders in each other, a part of a path, files
MOST_AT_ONCE_BYTES = 4 * CHUNK_BYTES  # of a tar: its own headers say how much is read of them
LEFT_OUT = {"__MACOSX", ".DS_Store", "Thumbs.db"}  # what file managers leave behind

Progress = Callable[[int, int | None], None]  # (bytes of the archive that are done, bytes in all)


class Damaged(InputError):
    """An archive that is not what was published: cut short, or changed on its way or on the disk."""


@dataclass(frozen=True)
class _Member:
    name: str
    size_bytes: int
    open: Callable[[], IO[bytes]]


def most_unpacked_bytes(path: Path) -> int:
    """What an archive may hold at most."""
    return max(UNPACKED_LEAST_BYTES, UNPACKED_RATIO * path.stat().st_size)


def check_archive(path: Path) -> None:
    """Read a zip or tar (plain, gz, bz2, xz) to its end, checksums too. Raises Damaged, and InputError for links."""
    for member, _ in _bounded(path):
        if member is not None:
            with _damage(path.name), member.open() as stream:
                while stream.read(CHUNK_BYTES):
                    pass


def unpack(path: Path, into: Path, only: Iterable[str] = ("",), progress: Progress | None = None) -> int:
    """Unpack the files whose path begins with one of ``only`` under ``into``, and give their number.

    A tar is read to its end whatever is wanted of it. What was written before damage was found stays: unpack into a
    folder that can be thrown away. Raises Damaged, InputError (a member that leads out, or none that is wanted) and
    OutputError (disk).
    """
    wanted, count = tuple(only), 0
    total = path.stat().st_size
    for member, done in _bounded(path):
        if progress is not None:
            progress(min(done, total), total)
        if member is None:
            continue
        place = _place(member.name, path.name)
        if place is None:
            continue
        if place.as_posix().startswith(wanted):
            _write(member, into / place, path.name)
            count += 1
    if not count:
        looked_for = ", ".join(w for w in wanted if w) or "files"
        raise InputError(f"{path.name}: expected {looked_for} in it, got none")
    if progress is not None:
        progress(total, total)
    return count


def _bounded(path: Path) -> Iterator[tuple[_Member | None, int]]:
    """``_members``, as long as they are no more and no larger than an archive of this size may hold."""
    left = most_unpacked_bytes(path)
    for count, (member, done) in enumerate(_members(path), 1):
        left -= 0 if member is None else member.size_bytes
        if left < 0 or count > MOST_MEMBERS:
            got = f"more than {MOST_MEMBERS} files" if left >= 0 else "more"
            name = path.name.removesuffix(".part")
            raise InputError(f"{name}: expected at most {most_unpacked_bytes(path)} bytes in it, got {got}; not used")
        yield member, done


def _members(path: Path) -> Iterator[tuple[_Member | None, int]]:
    """Every file of an archive, and how many of its bytes are behind; None for what is no file. Raises InputError."""
    name = path.name.removesuffix(".part")
    check_plain(path, "a zip or tar archive")
    with _damage(name):
        with path.open("rb") as file:
            start = file.read(6)
        if start.startswith(ZIP_STARTS):
            yield from _zip_members(path, name)
        else:
            opener: Any = next((o for magic, o in UNPACKERS.items() if start.startswith(magic)), None)
            yield from _tar_members(path, name, opener)


def _zip_members(path: Path, name: str) -> Iterator[tuple[_Member | None, int]]:
    done = 0
    with zipfile.ZipFile(path) as archive:
        for info in archive.infolist():
            mode = info.external_attr >> 16
            if info.flag_bits & 1:
                raise InputError(f"{name}: expected no passwords, {short(info.filename)} in it needs one")
            if stat.S_ISLNK(mode):
                raise _leads_out(name, info.filename, "a link")
            done += info.compress_size
            if not info.is_dir():
                yield _Member(info.filename, info.file_size, partial(archive.open, info)), done


def _tar_members(path: Path, name: str, opener: Any) -> Iterator[tuple[_Member | None, int]]:
    with path.open("rb") as raw:
        stream = _Stream(opener(raw, "rb") if opener is not None else raw, most_unpacked_bytes(path), name)
        with tarfile.open(fileobj=cast(IO[bytes], stream), mode="r:") as archive:
            for info in archive:
                if info.isdir():
                    continue
                if info.sparse is not None or any(key.startswith("GNU.sparse") for key in info.pax_headers):
                    raise _leads_out(name, info.name, "a file with holes")
                if not info.isreg():
                    raise _leads_out(name, info.name, "a link" if info.issym() or info.islnk() else "a device")
                yield _Member(info.name, info.size, partial(_extracted, archive, info)), raw.tell()
            while stream.read(CHUNK_BYTES):  # the checksum of the compression stands at its end
                pass
        yield None, raw.tell()


class _Stream:
    """The bytes of a tar, no more than there may be: neither at once, as its headers could ask for, nor in all."""

    def __init__(self, inner: IO[bytes], most: int, name: str) -> None:
        self._inner, self._left, self._name = inner, 2 * most, name  # headers and padding too

    def read(self, size: int = -1) -> bytes:
        if not 0 <= size <= MOST_AT_ONCE_BYTES:
            raise Damaged(f"{self._name}: expected headers of some hundred bytes, got one of {size}")
        data = self._inner.read(size)
        self._left -= len(data)
        if self._left < 0:
            raise InputError(f"{self._name}: expected no more bytes in it than its size allows, got more; not used")
        return data

    def seek(self, offset: int, whence: int = 0) -> int:
        """Forward by reading, so that what is passed over counts."""
        ahead = offset - self._inner.tell()
        if whence or ahead < 0:
            return self._inner.seek(offset, whence)
        while ahead > 0 and (got := len(self.read(min(ahead, CHUNK_BYTES)))):
            ahead -= got
        return self._inner.tell()

    def tell(self) -> int:
        return self._inner.tell()


def _extracted(archive: tarfile.TarFile, info: tarfile.TarInfo) -> IO[bytes]:
    return cast(IO[bytes], archive.extractfile(info))  # None only for what is no file


def _place(member: str, name: str) -> PurePosixPath | None:
    """Where a member goes, relative; None for what file managers left. Raises InputError for one that leads out."""
    place = PurePosixPath(member)
    odd = "\\" in member or ":" in member or not member.isprintable()
    if len(place.parts) > MOST_DEEP or any(len(p.encode()) > MOST_NAME_BYTES for p in place.parts if not odd):
        raise _leads_out(name, short(member), "a path that is too long")
    if odd or place.is_absolute() or ".." in place.parts or not place.parts:
        raise _leads_out(name, member, "a path that leads out")
    if LEFT_OUT & set(place.parts) or place.name.startswith("._"):
        return None
    return place


def _write(member: _Member, target: Path, name: str) -> None:
    """One file. Raises InputError for another size than the archive says, OutputError for the disk."""
    with _disk(target):
        target.parent.mkdir(parents=True, exist_ok=True)
        free = shutil.disk_usage(target.parent).free
    if exists(target):
        raise InputError(f"{name}: expected every file once, got {member.name} twice")
    if member.size_bytes > free:
        raise OutputError(
            f"{target.parent}: expected {member.size_bytes} bytes of free space for {member.name}, got {free}; "
            "free some space and run the same command again"
        )
    written = 0
    with _damage(name), member.open() as stream, _disk(target), target.open("xb") as file:
        while chunk := _read(stream):
            written += file.write(chunk)
    if written != member.size_bytes:
        raise Damaged(f"{name}: expected {member.size_bytes} bytes in {member.name}, got {written}")


class _Broken(Exception):
    """An error of reading the archive, told apart from one of writing beside it."""


def _read(stream: IO[bytes]) -> bytes:
    try:
        return stream.read(CHUNK_BYTES)
    except DAMAGED as e:
        raise _Broken(str(e) or type(e).__name__) from e


@contextmanager
def _damage(name: str) -> Iterator[None]:
    try:
        yield
    except (*DAMAGED, _Broken) as e:
        raise Damaged(f"{name}: expected a whole zip or tar archive, got a damaged one ({e})") from e


@contextmanager
def _disk(path: Path) -> Iterator[None]:
    try:
        yield
    except OSError as e:
        full = e.errno in (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)
        remedy = "free some space and run the same command again" if full else "choose a folder that can be written"
        raise OutputError(f"{path}: expected to write, got {e.strerror or e}; {remedy}") from e


def _leads_out(name: str, member: str, what: str) -> InputError:
    return InputError(
        f"{name}: expected files and folders of its own, got {what} ({short(member)}); nothing of it is used"
    )
