"""A saved map on disk, docs/maps.md: JSON, NPZ of plain numbers and PLY; nothing in it is ever run."""

from __future__ import annotations

import io
import math
import os
from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..camera.opencv_lens import OpenCvLens
from ..camera.pinhole import Camera
from ..errors import InputError
from ..reading.arrays import arrays_of
from ..reading.files import is_dir, is_file, short, whole_json, whole_text
from ..reading.pictures import MOST_PIXELS
from ..reading.yaml_text import MOST_YAML_BYTES
from .export_folder import FolderKind, export_folder
from .files import write_bytes, write_json
from .run_record import checked_camera, number, text

Array = NDArray[Any]
MAP = FolderKind("map.json", "mastd3r save", "an earlier map")
VERSION = 1
KEYFRAMES, LENS, CONFIG, SPLAT = "keyframes", "camera.json", "config.yaml", "gaussians.ply"
MOST_KEYFRAMES = 100_000
UNITS = ("m", "map units")
LENGTH_OFF = 1e-6  # largest entry of R^T R - 1 of a pose


@dataclass(frozen=True)
class MapKeyframe:
    """One keyframe, at working size (h, w), with p points: the chosen pixel of every cell, row by row."""

    timestamp_s: float
    world_from_cam: Array  # (4, 4) float64
    gray: Array  # (h, w) uint8
    moving: Array  # (h, w) uint8, 255 x P(moving)
    px: Array  # (p, 2) float64
    texture: Array  # (p,) float32 in 0..1, how well the pixel can be matched
    inv_depth: Array  # (p,) float64, above 0
    depth_info: Array  # (p,) float64, 1/variance of it in units of a pixel's noise; 0: its depth is not known
    feature_px: Array  # (f, 2) float32; f = 0 where no features are kept
    descriptors: Array  # (f, c) float16, of unit length
    color: Array  # (p, 3) uint8 RGB of the points; (0, 3) where they are not kept


@dataclass(frozen=True)
class MapRecord:
    """Everything in a saved map but the splat, which is a file of its own."""

    size: tuple[int, int]  # (width, height) of the working images
    grid: tuple[int, int]  # (rows, cols) of cells
    lens: Camera | OpenCvLens  # of the photographs
    features: str  # the part that described the keyframes; empty: none did
    config: str  # YAML, options of the run
    keyframes: tuple[MapKeyframe, ...]
    source: str = ""  # the run that it was saved from
    unit: str = UNITS[1]  # of all lengths, one of UNITS


ARRAYS = {  # type, shape
    "gray": ("|u1", ("h", "w")),
    "moving": ("|u1", ("h", "w")),
    "px": ("<f8", ("p", 2)),
    "texture": ("<f4", ("p",)),
    "inv_depth": ("<f8", ("p",)),
    "depth_info": ("<f8", ("p",)),
    "feature_px": ("<f4", ("f", 2)),
    "descriptors": ("<f2", ("f", "c")),
    "color": ("|u1", ("q", 3)),
}
LATER = {"color": np.zeros((0, 3), np.uint8)}  # what maps lack that were saved before it was kept


def write_map(out: Path, record: MapRecord, write_splat: Callable[[Path], None] | None, inputs: Sequence[Path]) -> None:
    """Write a map to the folder ``out``, whole or not at all; an earlier map there is replaced.

    ``write_splat`` writes gaussians.ply, in the unit of the map. ``inputs``: what was read.
    Raises OutputError as ``export_folder`` does.
    """
    facts = {
        "version": VERSION,
        "size": record.size,
        "grid": record.grid,
        "features": record.features,
        "source": record.source,
        "unit": record.unit,
        "keyframes": [
            {"timestamp_s": kf.timestamp_s, "world_from_cam": kf.world_from_cam.tolist()} for kf in record.keyframes
        ],
    }
    with export_folder(out, facts, inputs, MAP) as staged:
        (staged / KEYFRAMES).mkdir()
        for n, kf in enumerate(record.keyframes):
            packed = io.BytesIO()
            np.savez_compressed(packed, **{name: getattr(kf, name) for name in ARRAYS})
            write_bytes(staged / _name(n), packed.getvalue())
        lens = record.lens
        camera = lens.radial if isinstance(lens, OpenCvLens) else lens
        terms = lens.distortion if isinstance(lens, OpenCvLens) else (lens.k1, lens.k2, 0.0, 0.0, lens.k3)
        own = {f.name: getattr(camera, f.name) for f in fields(camera)}
        write_json(staged / LENS, {**own, "distortion": list(terms)})
        write_bytes(staged / CONFIG, record.config.encode())
        if write_splat is not None:
            write_splat(staged / SPLAT)


def read_map(folder: Path) -> MapRecord:
    """Read what ``write_map`` wrote. Raises InputError for another folder, another version, and what is damaged."""
    path = folder / MAP.record
    if not is_file(path):
        raise InputError(f"{folder}: expected a saved map (mastd3r save), got {_what_is_in(folder)}")
    facts = whole_json(path)
    if facts.get("made_by") != MAP.made_by:
        raise InputError(f"{path}: expected a map of mastd3r save, got one of {short(repr(facts.get('made_by')))}")
    if facts.get("version") != VERSION:
        got = short(repr(facts.get("version")))
        raise InputError(f"{path}: expected version {VERSION} of a saved map, got {got}; save it from its run again")
    size, grid = (_pair(facts.get(key), path, key) for key in ("size", "grid"))
    if size[0] * size[1] > MOST_PIXELS or grid[0] > size[1] or grid[1] > size[0]:
        raise InputError(f"{path}: expected cells of a working image, got {grid} of {size}")
    for key in ("features", "source"):
        if not text(facts.get(key)):
            raise InputError(f"{path} {key}: expected text, got {short(repr(facts[key]))}")
    unit = facts.get("unit", UNITS[1])
    if unit not in UNITS:
        raise InputError(f"{path} unit: expected {' or '.join(UNITS)}, got {short(repr(unit))}")
    rows = facts.get("keyframes")
    if not isinstance(rows, list) or not 0 < len(rows) <= MOST_KEYFRAMES:
        raise InputError(f"{path} keyframes: expected a list of 1 to {MOST_KEYFRAMES}, got {short(repr(rows))}")
    return MapRecord(
        size,
        grid,
        _lens(folder / LENS),
        facts.get("features") or "",
        whole_text(folder / CONFIG, "readable YAML", most=MOST_YAML_BYTES),
        tuple(_keyframe(folder, n, row, size, grid) for n, row in enumerate(rows)),
        facts.get("source") or "",
        unit,
    )


def _name(n: int) -> str:
    return f"{KEYFRAMES}/{n:06d}.npz"


def _what_is_in(folder: Path) -> str:
    if not is_dir(folder):
        return "no such folder" if not os.path.lexists(folder) else "a file"
    if is_file(folder / "run.json"):
        return f"a run folder; mastd3r save {folder} --map MAP makes a map of it"
    return f"a folder without {MAP.record}"


def _pair(value: Any, path: Path, key: str) -> tuple[int, int]:
    fits = isinstance(value, list) and len(value) == 2 and all(type(v) is int and 0 < v < 2**16 for v in value)
    if not fits:
        raise InputError(f"{path} {key}: expected two whole numbers above 0, got {short(repr(value))}")
    return value[0], value[1]


def _lens(path: Path) -> Camera | OpenCvLens:
    camera, terms = checked_camera(path)
    if not any(terms[2:4] + terms[5:]):
        return camera
    return OpenCvLens(camera.fx_px, camera.fy_px, camera.cx_px, camera.cy_px, camera.width, camera.height, terms)


def _keyframe(folder: Path, n: int, row: Any, size: tuple[int, int], grid: tuple[int, int]) -> MapKeyframe:
    where = f"{folder / MAP.record} keyframes[{n}]"
    if not isinstance(row, dict) or not number(row.get("timestamp_s")):
        raise InputError(f"{where}: expected timestamp_s and world_from_cam, got {short(repr(row))}")
    pose = _pose(row.get("world_from_cam"), where)
    path = folder / _name(n)
    kinds = {name: kind for name, (kind, _) in ARRAYS.items()}
    found = LATER | arrays_of(path, kinds, "a keyframe of a saved map", LATER)
    sides: dict[str, int] = {"w": size[0], "h": size[1], "p": math.prod(grid)}
    for name, (_, shape) in ARRAYS.items():
        got = found[name].shape
        wanted = tuple(
            sides.setdefault(s, got[i]) if isinstance(s, str) and i < len(got) else s for i, s in enumerate(shape)
        )
        if got != wanted:
            raise InputError(f"{path} {name}: expected shape {wanted}, got {got}")
    if sides["q"] not in (0, sides["p"]):
        raise InputError(f"{path} color: expected one of each of {sides['p']} points, got {sides['q']}")
    if not all(np.isfinite(a).all() for a in found.values()):
        raise InputError(f"{path}: expected finite numbers, got some that are not")
    inside = (found["px"] >= -0.5).all() and (found["px"] <= np.array(size) - 0.5).all()
    if not inside or not (found["inv_depth"] > 0).all() or not (found["depth_info"] >= 0).all():
        raise InputError(f"{path}: expected points before the camera and within the image, got others")
    if not ((found["texture"] >= 0) & (found["texture"] <= 1)).all():
        raise InputError(f"{path} texture: expected shares in 0..1, got others")
    return MapKeyframe(float(row["timestamp_s"]), pose, **found)


def _pose(value: Any, where: str) -> Array:
    is_matrix = isinstance(value, list) and len(value) == 4
    is_matrix = is_matrix and all(isinstance(r, list) and len(r) == 4 and all(map(number, r)) for r in value)
    pose = np.array(value, float) if is_matrix else np.zeros((4, 4))
    turn = pose[:3, :3]
    sound = np.abs(pose).max() < 1e9 and np.abs(turn.T @ turn - np.eye(3)).max() < LENGTH_OFF
    if not (sound and np.linalg.det(turn) > 0 and (pose[3] == [0, 0, 0, 1]).all()):
        raise InputError(f"{where} world_from_cam: expected a rotation and a position, got {short(repr(value))}")
    return pose
