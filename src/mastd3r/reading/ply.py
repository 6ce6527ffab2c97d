"""The one reader of PLY: vertices of plain numbers, binary little endian, as all our files are."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..errors import InputError
from .files import short, whole_bytes

FARTHEST = 1e9  # map units; a number beyond is no position
MOST_HEADER_BYTES = 2**16
TYPES = {
    "char": "i1", "int8": "i1", "uchar": "u1", "uint8": "u1", "short": "<i2", "int16": "<i2",
    "ushort": "<u2", "uint16": "<u2", "int": "<i4", "int32": "<i4", "uint": "<u4", "uint32": "<u4",
    "float": "<f4", "float32": "<f4", "double": "<f8", "float64": "<f8",
}  # fmt: skip
END = b"end_header\n"


def read_vertices(path: Path) -> NDArray[Any]:
    """The vertices of a PLY, (n,) structured by property name.

    Raises InputError for another layout, and where there are more or fewer bytes than the header says.
    """
    data = whole_bytes(path, "a readable PLY file")
    end = data.find(END, 0, MOST_HEADER_BYTES)
    lines = [line.split() for line in data[: max(end, 0)].decode("ascii", "replace").splitlines()]
    lines = [line for line in lines if line[:1] not in ([], ["comment"], ["obj_info"])]
    if end < 0 or lines[:2] != [["ply"], ["format", "binary_little_endian", "1.0"]]:
        raise InputError(f"{path}: expected a binary little-endian PLY, got {data[:40]!r}")
    element, properties = [*lines[2:3], []][0], lines[3:]
    if element[:2] != ["element", "vertex"] or len(element) != 3:
        raise InputError(f"{path}: expected vertices first in the header, got {short(' '.join(element))!r}")
    for line in properties:
        if len(line) != 3 or line[0] != "property" or line[1] not in TYPES:
            raise InputError(f"{path}: expected plain properties of vertices only, got {short(' '.join(line))!r}")
    names = [name for _, _, name in properties]
    if not names or len(set(names)) != len(names):
        raise InputError(f"{path}: expected properties with names of their own, got {short(', '.join(names))!r}")
    dtype = np.dtype([(name, TYPES[kind]) for _, kind, name in properties])
    count, size = element[2], len(data) - end - len(END)
    if not (count.isascii() and count.isdecimal() and len(count) < 12) or int(count) * dtype.itemsize != size:
        raise InputError(
            f"{path}: expected {short(count)} vertices of {dtype.itemsize} bytes, got {size} bytes of them"
        )
    return np.frombuffer(data, dtype, int(count), end + len(END))
