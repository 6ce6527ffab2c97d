"""The one reader of PLY, binary little endian, as all our files are: vertices of plain numbers, and what follows."""

from __future__ import annotations

from dataclasses import dataclass, replace
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


@dataclass(frozen=True)
class Element:
    """What a PLY header says of one kind of rows."""

    name: str
    count: int
    properties: tuple[tuple[str, ...], ...]  # words after "property"


def read_ply(path: Path) -> tuple[list[Element], bytes]:
    """The header of a little-endian PLY, and what follows it. Raises InputError."""
    data = whole_bytes(path, "a readable PLY file")
    end = data.find(END, 0, MOST_HEADER_BYTES)
    lines = [line.split() for line in data[: max(end, 0)].decode("ascii", "replace").splitlines()]
    lines = [line for line in lines if line[:1] not in ([], ["comment"], ["obj_info"])]
    if end < 0 or lines[:2] != [["ply"], ["format", "binary_little_endian", "1.0"]]:
        raise InputError(f"{path}: expected a binary little-endian PLY, got {data[:40]!r}")
    elements: list[Element] = []
    for words in lines[2:]:
        is_count = len(words) == 3 and words[2].isascii() and words[2].isdecimal() and len(words[2]) < 12
        if words[0] == "element" and is_count:
            elements.append(Element(words[1], int(words[2]), ()))
        elif words[0] == "property" and len(words) > 2 and elements:
            elements[-1] = replace(elements[-1], properties=(*elements[-1].properties, tuple(words[1:])))
        else:
            raise InputError(f"{path}: expected elements and properties in the header, got {short(' '.join(words))!r}")
    return elements, data[end + len(END) :]


def vertices_of(path: Path, element: Element, body: bytes) -> NDArray[Any]:
    """The rows of an element of plain properties that ``body`` begins with, structured. Raises InputError."""
    for words in element.properties:
        if len(words) != 2 or words[0] not in TYPES:
            raise InputError(f"{path}: expected plain properties of vertices only, got {short(' '.join(words))!r}")
    names = [name for _, name in element.properties]
    if not names or len(set(names)) != len(names):
        raise InputError(f"{path}: expected properties with names of their own, got {short(', '.join(names))!r}")
    dtype = np.dtype([(name, TYPES[kind]) for kind, name in element.properties])
    if element.count * dtype.itemsize > len(body):
        raise InputError(
            f"{path}: expected {element.count} vertices of {dtype.itemsize} bytes, got {len(body)} bytes of them"
        )
    return np.frombuffer(body, dtype, element.count)


def read_vertices(path: Path) -> NDArray[Any]:
    """The vertices of a PLY that has nothing else, (n,) structured by property name.

    Raises InputError for another layout, and where there are more or fewer bytes than the header says.
    """
    elements, body = read_ply(path)
    if [e.name for e in elements] != ["vertex"]:
        found = ", ".join(e.name for e in elements) or "nothing"
        raise InputError(f"{path}: expected vertices alone in the header, got {short(found)!r}")
    rows = vertices_of(path, elements[0], body)
    if rows.nbytes != len(body):
        raise InputError(f"{path}: expected {rows.nbytes} bytes of vertices, got {len(body)} bytes of them")
    return rows
