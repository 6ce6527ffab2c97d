"""The static cloud as a binary PLY that any viewer opens."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..errors import InputError
from ..reading.ply import FARTHEST, read_vertices
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
    unlike = [name for name in VERTEX.names or () if rows.dtype[name].kind != VERTEX[name].kind]
    if unlike:
        raise InputError(f"{path}: expected {unlike[0]} of type {PLY_NAME[VERTEX[unlike[0]].str]}, got another type")
    return StaticCloud(
        finite_points(rows, path),
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
    return finite_points(rows, path)


def read_coloured_points(path: Path) -> tuple[Array, Array, Array | None]:
    """Points (n, 3) float32, colours (n, 3) uint8 and, where the file tells it, the spacing (n,) of a cloud.

    White where it has no colours. Raises InputError.
    """
    rows = read_vertices(path)
    names = set(rows.dtype.names or ())
    if not set("xyz") <= names:
        raise InputError(f"{path}: expected vertex properties x, y, z, got {rows.dtype.names}")
    return finite_points(rows, path), vertex_colors(rows), rows["spacing"].copy() if "spacing" in names else None


def vertex_colors(rows: Array) -> Array:
    """(n, 3) uint8 RGB of vertices; white where they have none."""
    if not {"red", "green", "blue"} <= set(rows.dtype.names or ()):
        return np.full((len(rows), 3), 255, np.uint8)
    return np.stack([rows[name] for name in ("red", "green", "blue")], -1).astype(np.uint8)


def finite_points(rows: Array, path: Path) -> Array:
    """(n, 3) float32 positions of vertices. Raises InputError for one that is none."""
    points = np.stack([rows[name] for name in "xyz"], -1)
    wrong = np.flatnonzero(~(np.abs(points) < FARTHEST).all(-1))
    if len(wrong):
        raise InputError(f"{path} vertex {wrong[0]}: expected a position, got {points[wrong[0]].tolist()}")
    return points.astype(np.float32)
