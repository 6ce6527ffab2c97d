"""The dense cloud as a binary PLY that any viewer opens."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from .files import write_bytes
from .point_cloud import PLY_NAME

Array = NDArray[Any]
POINT = np.dtype(
    [(name, "<f4") for name in ("x", "y", "z", "nx", "ny", "nz")]
    + [(name, "u1") for name in ("red", "green", "blue")]
    + [("confidence", "<f4")]
)


def write_dense_cloud(path: Path, points_world: Array, normals: Array, colors: Array, confidence: Array) -> None:
    """Points (n, 3), unit normals (n, 3), colours (n, 3) uint8, confidence (n,), little-endian. Raises OutputError."""
    rows = np.empty(len(points_world), POINT)
    for axis, name in enumerate("xyz"):
        rows[name], rows["n" + name] = points_world[:, axis], normals[:, axis]
    for channel, name in enumerate(("red", "green", "blue")):
        rows[name] = colors[:, channel]
    rows["confidence"] = confidence
    properties = [f"property {PLY_NAME[POINT[name].str]} {name}" for name in POINT.names or ()]
    header = ["ply", "format binary_little_endian 1.0", f"element vertex {len(rows)}", *properties, "end_header"]
    write_bytes(path, ("\n".join(header) + "\n").encode() + rows.tobytes())
