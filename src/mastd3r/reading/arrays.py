"""NumPy's files: type and size are read from the header, and compared with the file's, before there is an array."""

from __future__ import annotations

import math
import struct
import tokenize
import zipfile
import zlib
from collections.abc import Collection, Mapping
from pathlib import Path
from typing import IO, Any

import numpy as np
from numpy.lib import format as npy
from numpy.typing import NDArray

from ..errors import InputError
from .files import check_plain

MOST_BYTES = 2**30  # of one array
BROKEN = (
    *(OSError, EOFError, ValueError, KeyError, TypeError, SyntaxError, OverflowError, RecursionError, MemoryError),
    *(tokenize.TokenError, struct.error, zipfile.BadZipFile, zlib.error, NotImplementedError, RuntimeError),
)


class BrokenArray(InputError):
    """A file that is there and holds no array of numbers, or not all of it."""


def array_of(path: Path, expected: str) -> NDArray[Any]:
    """The array of numbers in a .npy file, as stored. Raises InputError, its child BrokenArray for a broken file."""
    size = check_plain(path, expected, most=MOST_BYTES)
    try:
        with open(path, "rb") as file:
            return _array(file, size)
    except BROKEN as e:
        raise BrokenArray(f"{path}: expected {expected} as .npy, got a broken file ({_words(e)})") from e


def arrays_of(
    path: Path, wanted: Mapping[str, str], expected: str, may_lack: Collection[str] = ()
) -> dict[str, NDArray[Any]]:
    """Arrays of an .npz file by name; ``wanted``: name -> type, as "<f4". Raises InputError.

    Those in ``may_lack`` need not be there.
    """
    check_plain(path, expected, most=MOST_BYTES)
    out = {}
    try:
        with zipfile.ZipFile(path) as archive:
            there = set(archive.namelist())
            for name, kind in wanted.items():
                if name in may_lack and f"{name}.npy" not in there:
                    continue
                info = archive.getinfo(f"{name}.npy")
                with archive.open(info) as file:
                    out[name] = _array(file, min(info.file_size, MOST_BYTES))
                if out[name].dtype.str != kind:
                    raise ValueError(f"{name} of type {out[name].dtype.str}, not {kind}")
    except BROKEN as e:
        raise InputError(f"{path}: expected {expected}, got {_words(e)}") from e
    return out


def _array(file: IO[bytes], size: int) -> NDArray[Any]:
    """``size``: bytes of the file that ``file`` is, header and all."""
    version = npy.read_magic(file)
    read = {(1, 0): npy.read_array_header_1_0, (2, 0): npy.read_array_header_2_0}.get(version)
    if read is None:
        raise ValueError(f"version {version[0]}.{version[1]} of the format")
    shape, by_column, dtype = read(file)
    if dtype.kind not in "iufb" or any(side < 0 for side in shape):
        raise ValueError(f"an array of {dtype} {shape}, which are no numbers")
    count = math.prod(shape)
    if count * dtype.itemsize > size:
        raise ValueError(f"{size} bytes for an array of {dtype} {shape}")
    data = file.read(count * dtype.itemsize)
    array = np.frombuffer(data, dtype, count)
    return array.reshape(shape, order="F" if by_column else "C").copy()


def _words(error: BaseException) -> str:
    return " ".join(str(error).split())[:200] or type(error).__name__
