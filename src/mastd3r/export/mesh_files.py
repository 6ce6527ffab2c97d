"""A coloured triangle mesh as binary PLY or as GLB (glTF 2.0, Khronos Group)."""

from __future__ import annotations

import json
import struct
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..errors import InputError
from ..reading.files import check_plain, first_bytes
from ..reading.ply import read_ply, vertices_of
from .files import write_bytes
from .point_cloud import finite_points, vertex_colors

Array = NDArray[Any]
VERTEX = np.dtype([(n, "<f4") for n in "xyz"] + [(n, "u1") for n in ("red", "green", "blue")])
FACE = np.dtype([("count", "u1"), ("vertices", "<i4", 3)])
FACE_LISTS = tuple(("list", count, index) for count in ("uchar", "uint8") for index in ("int", "int32"))
GLTF_FROM_WORLD = np.array([1.0, -1.0, -1.0])  # glTF: +y up, the camera looks along -z; a half turn about x
FLOAT, USHORT, UINT = 5126, 5123, 5125  # glTF's component types
ARRAY_BUFFER, INDEX_BUFFER = 34962, 34963
JSON_CHUNK, BINARY_CHUNK = 0x4E4F534A, 0x004E4942


def write_mesh(path: Path, vertices_world: Array, faces: Array, colors: Array) -> None:
    """Vertices (n, 3), triangles (m, 3), colours (n, 3) uint8 RGB, to a .ply or .glb. Raises OutputError."""
    encode = glb_bytes if path.suffix.lower() == ".glb" else ply_bytes
    write_bytes(path, encode(vertices_world, faces, colors))


def ply_bytes(vertices_world: Array, faces: Array, colors: Array) -> bytes:
    """A little-endian PLY, in map units and OpenCV axes, as the clouds are."""
    rows, triangles = np.empty(len(vertices_world), VERTEX), np.empty(len(faces), FACE)
    for axis, name in enumerate("xyz"):
        rows[name] = vertices_world[:, axis]
    for channel, name in enumerate(("red", "green", "blue")):
        rows[name] = colors[:, channel]
    triangles["count"], triangles["vertices"] = 3, faces
    head = [
        "ply",
        "format binary_little_endian 1.0",
        f"element vertex {len(rows)}",
        *(f"property float {n}" for n in "xyz"),
        *(f"property uchar {n}" for n in ("red", "green", "blue")),
        f"element face {len(triangles)}",
        "property list uchar int vertex_indices",
        "end_header",
    ]
    return ("\n".join(head) + "\n").encode() + rows.tobytes() + triangles.tobytes()


def is_glb(path: Path) -> bool:
    """Whether a file is a binary glTF, by its first bytes. Raises InputError for one that is cut or cannot be read."""
    size = check_plain(path, "a readable cloud or mesh")
    head = first_bytes(path, 12, "a readable cloud or mesh")
    if head[:4] != b"glTF":
        return False
    if len(head) < 12 or struct.unpack("<I", head[8:])[0] != size:
        raise InputError(f"{path}: expected a whole .glb file, got one whose length is not what its head says")
    return True


def has_faces(path: Path) -> bool:
    """Whether a PLY is a mesh. Raises InputError."""
    return any(element.name == "face" for element in read_ply(path)[0])


def read_mesh(path: Path) -> tuple[Array, Array, Array]:
    """Vertices (n, 3) float32, triangles (m, 3) int32, colours (n, 3) uint8 of a little-endian PLY of triangles.

    White where it has no colours. Raises InputError.
    """
    elements, body = read_ply(path)
    if [e.name for e in elements] != ["vertex", "face"]:
        raise InputError(f"{path}: expected vertices and faces, got {', '.join(e.name for e in elements)}")
    rows = vertices_of(path, elements[0], body)
    listed = elements[1].properties
    if not set("xyz") <= set(rows.dtype.names or ()) or len(listed) != 1 or listed[0][:3] not in FACE_LISTS:
        raise InputError(f"{path}: expected x, y, z and faces as lists of int, got {listed}")
    rest = body[rows.nbytes :]
    if len(rest) != elements[1].count * FACE.itemsize:
        raise InputError(f"{path}: expected {elements[1].count} triangles, got {len(rest)} bytes of faces")
    faces = np.frombuffer(rest, FACE)
    triangles = faces["vertices"]
    if (faces["count"] != 3).any() or (len(faces) and not 0 <= triangles.min() <= triangles.max() < len(rows)):
        raise InputError(f"{path}: expected triangles of its {len(rows)} vertices, got other faces")
    return finite_points(rows, path), triangles, vertex_colors(rows)


def glb_bytes(vertices_world: Array, faces: Array, colors: Array) -> bytes:
    """A binary glTF with the axes of glTF, colours as light (linear, as COLOR_0 is defined), without shading."""
    places = (np.asarray(vertices_world) * GLTF_FROM_WORLD).astype("<f4")
    light = np.full((len(colors), 4), 65535, "<u2")
    light[:, :3] = np.rint(65535 * linear(np.asarray(colors) / 255))
    parts = [(places, ARRAY_BUFFER), (light, ARRAY_BUFFER), (np.asarray(faces, "<u4"), INDEX_BUFFER)]
    blob, buffers = b"", []
    for array, target in parts:  # each a multiple of 4 bytes long
        buffers.append({"buffer": 0, "byteOffset": len(blob), "byteLength": array.nbytes, "target": target})
        blob += array.tobytes()
    low, high = (places.min(0).tolist(), places.max(0).tolist()) if len(places) else ([0.0] * 3, [0.0] * 3)
    material = {"pbrMetallicRoughness": {"metallicFactor": 0}, "doubleSided": True}
    primitive = {"attributes": {"POSITION": 0, "COLOR_0": 1}, "indices": 2, "material": 0}
    tree = {
        "asset": {"version": "2.0", "generator": "mastd3r"},
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0}],
        "meshes": [{"primitives": [primitive]}],
        "materials": [{**material, "extensions": {"KHR_materials_unlit": {}}}],
        "extensionsUsed": ["KHR_materials_unlit"],
        "buffers": [{"byteLength": len(blob)}],
        "bufferViews": buffers,
        "accessors": [
            {"bufferView": 0, "componentType": FLOAT, "count": len(places), "type": "VEC3", "min": low, "max": high},
            {"bufferView": 1, "componentType": USHORT, "normalized": True, "count": len(light), "type": "VEC4"},
            {"bufferView": 2, "componentType": UINT, "count": 3 * len(faces), "type": "SCALAR"},
        ],
    }
    text = json.dumps(tree, separators=(",", ":")).encode()
    text += b" " * (-len(text) % 4)
    chunks = struct.pack("<II", len(text), JSON_CHUNK) + text + struct.pack("<II", len(blob), BINARY_CHUNK) + blob
    return struct.pack("<4sII", b"glTF", 2, 12 + len(chunks)) + chunks


def linear(srgb: Array) -> Array:
    """Light in 0..1 of sRGB values in 0..1 (IEC 61966-2-1)."""
    return np.asarray(np.where(srgb <= 0.04045, srgb / 12.92, ((srgb + 0.055) / 1.055) ** 2.4))
