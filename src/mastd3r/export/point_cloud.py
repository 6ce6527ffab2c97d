"""The static cloud as a binary PLY that any viewer opens."""

from __future__ import annotations

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
    points = np.stack([rows[name] for name in "xyz"], -1).astype(np.float32)
    colors = np.stack([rows[name] for name in ("red", "green", "blue")], -1)
    return StaticCloud(
        points, colors, rows["confidence"].copy(), rows["spacing"].copy(), rows["keyframe"].astype(np.int32)
    )


def read_points(path: Path) -> Array:
    """(n, 3) float32 points of any little-endian PLY of vertices. Raises InputError."""
    rows = read_vertices(path)
    if not set("xyz") <= set(rows.dtype.names or ()):
        raise InputError(f"{path}: expected vertex properties x, y, z, got {rows.dtype.names}")
    return np.stack([rows[name] for name in "xyz"], -1).astype(np.float32)


def read_vertices(path: Path) -> Array:
    """The vertices of a little-endian PLY, (n,) structured by property name. Raises InputError."""
    try:
        data = path.read_bytes()
    except OSError as e:
        raise InputError(f"{path}: expected a readable PLY file, got {e.strerror or e}") from e
    head, mark, body = data.partition(b"end_header\n")
    lines = [line.split() for line in head.decode("ascii", "replace").splitlines()]
    if not mark or lines[:2] != [["ply"], ["format", "binary_little_endian", "1.0"]]:
        raise InputError(f"{path}: expected a binary little-endian PLY, got {data[:40]!r}")
    elements = [line for line in lines if line[:1] == ["element"]]
    properties = [line for line in lines if line[:1] == ["property"]]
    if [e[1] for e in elements] != ["vertex"] or any(len(p) != 3 or p[1] not in PLY_TYPE for p in properties):
        raise InputError(f"{path}: expected vertices with plain properties only, got {elements}")
    dtype = np.dtype([(name, PLY_TYPE[kind]) for _, kind, name in properties])
    count = int(elements[0][2])
    if len(body) < count * dtype.itemsize:
        raise InputError(f"{path}: expected {count * dtype.itemsize} bytes of vertices, got {len(body)}")
    return np.frombuffer(body, dtype, count)
