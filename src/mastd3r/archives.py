"""Archives that were downloaded: whether they are whole."""

from __future__ import annotations

import bz2
import gzip
import lzma
import tarfile
import zipfile
import zlib
from pathlib import Path
from typing import Any

from .errors import InputError

CHUNK_BYTES = 1 << 20
ZIP_STARTS = (b"PK\x03\x04", b"PK\x05\x06")
UNPACKERS = {b"\x1f\x8b": gzip.open, b"BZh": bz2.open, b"\xfd7zXZ\x00": lzma.open}  # first bytes of a compressed tar
DAMAGED = (
    zipfile.BadZipFile, tarfile.TarError, zlib.error, lzma.LZMAError, EOFError, OSError, NotImplementedError,
)  # fmt: skip


def check_archive(path: Path) -> None:
    """Read a zip or tar (plain, gz, bz2, xz) to its end, checksums included. Raises InputError for a damaged one."""
    name = path.name.removesuffix(".part")
    try:
        with path.open("rb") as file:
            start = file.read(6)
        if start.startswith(ZIP_STARTS):
            with zipfile.ZipFile(path) as archive:
                if (bad := archive.testzip()) is not None:
                    raise InputError(f"{name}: expected a sound archive, {bad} in it is damaged")
            return
        unpack: Any = next((opener for magic, opener in UNPACKERS.items() if start.startswith(magic)), open)
        with unpack(path, "rb") as stream, tarfile.open(fileobj=stream, mode="r:") as archive:
            for _ in archive:
                pass
            while stream.read(CHUNK_BYTES):  # the checksum of the compression stands at its end
                pass
    except DAMAGED as e:
        raise InputError(f"{name}: expected a whole zip or tar archive, got a damaged one ({e})") from e
