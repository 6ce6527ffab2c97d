"""The static cloud as a binary PLY that any viewer opens."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..errors import InputError
from ..types import StaticCloud
from .files import write_bytes

Array = NDArray[Any]
VERTEX = np.dtype(
    [
        ("x", "<f4"),
        ("y", "<f4"),
        ("z", "<f4"),
        ("red", "u1"),
        ("green", "u1"),
        ("blue", "u1"),
        ("confidence", "<f4"),
        ("spacing", "<f4"),
        ("keyframe", "<i4"),
    ]
)
PLY_NAME = {"<f4": "float", "|u1": "uchar", "<i4": "int"}
PLY_TYPE = {
    "char": "i1", "int8": "i1", "uchar": "u1", "uint8": "u1", "short": "<i2", "int16": "<i2",
    "ushort": "<u2", "uint16": "<u2", "int": "<i4", "int32": "<i4", "uint": "<u4", "uint32": "<u4",
    "float": "<f4", "float32": "<f4", "double": "<f8", "float64": "<f8",
}  # fmt: skip


def write_cloud(path: Path, cloud: StaticCloud) -> None:
    """Write points, colours, confidence, spacing and keyframe, little-endian. Raises OutputError."""
    rows = np.empty(len(cloud.points_world), VERTEX)
    for axis, name in enumerate("xyz"):
        rows[name] = cloud.points_world[:, axis]
    for channel, name in enumerate(("red", "green", "blue")):
        rows[name] = cloud.colors[:, channel]
    rows["confidence"], rows["spacing"], rows["keyframe"] = cloud.confidence, cloud.spacing, cloud.kf_id
    properties = [f"property {PLY_NAME[VERTEX[name].str]} {name}" for name in VERTEX.names or ()]
    header = [
        "ply",
        "format binary_little_endian 1.0",
        f"element vertex {len(rows)}",
        *properties,
        "end_header",
    ]
    write_bytes(path, ("\n".join(header) + "\n").encode() + rows.tobytes())


def read_cloud(path: Path) -> StaticCloud:
    """Read a cloud that ``write_cloud`` wrote. Raises InputError for any other or a cut-off file."""
    rows = read_vertices(path)
    missing = [name for name in VERTEX.names or () if name not in (rows.dtype.names or ())]
    if missing:
        raise InputError(f"{path}: expected vertex properties {', '.join(missing)}, got {rows.dtype.names}")
    return StaticCloud(
        _stacked(rows, "xyz"),
        vertex_colors(rows),
        rows["confidence"].copy(),
        rows["spacing"].copy(),
        rows["keyframe"].astype(np.int32),
    )


def read_points(path: Path) -> Array:
    """(n, 3) float32 points of any little-endian PLY of vertices. Raises InputError."""
    rows = read_vertices(path)
    if not set("xyz") <= set(rows.dtype.names or ()):
        raise InputError(f"{path}: expected vertex properties x, y, z, got {rows.dtype.names}")
    return _stacked(rows, "xyz")


def read_coloured_points(path: Path) -> tuple[Array, Array, Array | None]:
    """Points (n, 3) float32, colours (n, 3) uint8 and, where the file tells it, the spacing (n,) of a cloud.

    White where it has no colours. Raises InputError.
    """
    rows = read_vertices(path)
    names = set(rows.dtype.names or ())
    if not set("xyz") <= names:
        raise InputError(f"{path}: expected vertex properties x, y, z, got {rows.dtype.names}")
    return _stacked(rows, "xyz"), vertex_colors(rows), rows["spacing"].copy() if "spacing" in names else None


def vertex_colors(rows: Array) -> Array:
    """(n, 3) uint8 RGB of vertices; white where they have none."""
    if not {"red", "green", "blue"} <= set(rows.dtype.names or ()):
        return np.full((len(rows), 3), 255, np.uint8)
    return np.stack([rows[name] for name in ("red", "green", "blue")], -1).astype(np.uint8)


def _stacked(rows: Array, names: str) -> Array:
    return np.stack([rows[name] for name in names], -1).astype(np.float32)


def read_vertices(path: Path) -> Array:
    """The vertices of a little-endian PLY, (n,) structured by property name. Raises InputError."""
    elements, body = read_ply(path)
    if [e.name for e in elements] != ["vertex"]:
        raise InputError(f"{path}: expected vertices only, got {', '.join(e.name for e in elements) or 'nothing'}")
    return vertices_of(path, elements[0], body)


@dataclass(frozen=True)
class Element:
    """What a PLY header says of one kind of rows."""

    name: str
    count: int
    properties: tuple[tuple[str, ...], ...]  # words after "property"


def read_ply(path: Path) -> tuple[list[Element], bytes]:
    """The header of a little-endian PLY, and what follows it. Raises InputError."""
    try:
        data = path.read_bytes()
    except OSError as e:
        raise InputError(f"{path}: expected a readable PLY file, got {e.strerror or e}") from e
    head, mark, body = data.partition(b"end_header\n")
    lines = [line.split() for line in head.decode("ascii", "replace").splitlines()]
    if not mark or lines[:2] != [["ply"], ["format", "binary_little_endian", "1.0"]]:
        raise InputError(f"{path}: expected a binary little-endian PLY, got {data[:40]!r}")
    elements: list[Element] = []
    for words in lines[2:]:
        if words[:1] == ["element"] and len(words) == 3 and words[2].isdecimal():
            elements.append(Element(words[1], int(words[2]), ()))
        elif words[:1] == ["property"] and len(words) > 2 and elements:
            elements[-1] = replace(elements[-1], properties=(*elements[-1].properties, tuple(words[1:])))
        elif words[:1] not in (["comment"], ["obj_info"], []):
            raise InputError(f"{path}: expected elements and properties in the header, got {' '.join(words)[:60]!r}")
    return elements, body


def vertices_of(path: Path, element: Element, body: bytes) -> Array:
    """The rows of an element of plain properties that ``body`` begins with, structured. Raises InputError."""
    if any(len(p) != 2 or p[0] not in PLY_TYPE for p in element.properties):
        raise InputError(f"{path}: expected vertices with plain properties only, got {element.properties}")
    names = [name for _, name in element.properties]
    if len(set(names)) < len(names):
        raise InputError(f"{path}: expected every vertex property once, got {', '.join(names)}")
    dtype = np.dtype([(name, PLY_TYPE[kind]) for kind, name in element.properties])
    if len(body) < element.count * dtype.itemsize:
        raise InputError(f"{path}: expected {element.count * dtype.itemsize} bytes of vertices, got {len(body)}")
    return np.frombuffer(body, dtype, element.count)
