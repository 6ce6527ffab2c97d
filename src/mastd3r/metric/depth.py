"""Metres from a depth sensor: its images of some frames, registered to the photographs."""

from __future__ import annotations

import logging
import os
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from ..errors import InputError
from ..export.formats import evenly
from ..export.run_folder import stamp
from ..reading.files import entries_of, is_file, whole_json
from ..sources.image_files import MAP_SUFFIXES, BrokenFile, read_depth_m
from ..sources.semantic_maps import nearest_time
from ..sources.tum import TUM_DEPTH_SCALE, file_rows
from .estimate import Scale, biweight, jackknifed, scale_of
from .material import Material

Array = NDArray[Any]
log = logging.getLogger(__name__)
WHERE = "--scale depth"
MOST_FRAMES = 100  # that are read; of more, evenly spaced ones
LEAST_FRAMES, LEAST_POINTS = 3, 10
SAME_ASPECT = 0.01  # relative: a registered depth image may be smaller than the photograph, not another piece of it
NO_DEPTH_M = 1e9
EDGE_RATIO = 0.05  # depth that differs more between neighbours is an edge, where a pixel's error is a wrong depth


@dataclass(frozen=True)
class SensorDepth:
    """The files of a folder, before anything of them is compared."""

    folder: Path
    times_s: Array  # (n,) ascending, of the files whose times are known; else empty
    paths: tuple[Path, ...]  # of these times
    by_stem: dict[str, Path]  # by their names, where no list says their times
    units_per_metre: float


def sensor_depth(folder: Path, units_per_metre: float | None) -> SensorDepth:
    """The depth files of a folder in the TUM layout (depth.txt), or of one that holds depth images alone.

    Their unit is what is said, else depth_scale of info.json in the folder or above it, else that of TUM where there
    is a depth.txt. Raises InputError for a folder without them, or whose unit nobody says.
    """
    if not os.path.isdir(folder):
        raise InputError(f"{WHERE}: expected a folder of depth images, got {folder}")
    listed = os.path.lexists(folder / "depth.txt")
    if listed:
        rows = sorted(file_rows(folder / "depth.txt"), key=lambda r: r.timestamp_s)
        files = [folder / r.words[0] for r in rows]
        times = np.array([r.timestamp_s for r in rows])
        absent = [p for p in files if not is_file(p)]
        if absent:
            raise InputError(f"{folder / 'depth.txt'}: expected files beside it, got no {absent[0].name}")
    else:
        files = [p for p in entries_of(folder) if p.suffix.lower() in MAP_SUFFIXES and not p.name.startswith(".")]
        times = _times_of(files)
        files = [files[n] for n in np.argsort(times, kind="stable")] if len(times) else files
        times = np.sort(times)
    if not files:
        raise InputError(f"{WHERE}: expected depth images ({', '.join(MAP_SUFFIXES)}) in {folder}, got none")
    units = units_per_metre if units_per_metre is not None else _units(folder, files[0])
    first, _ = read_depth_m(files[0], units)
    if first.ndim != 2:
        raise InputError(f"{files[0]}: expected one depth a pixel, got shape {first.shape}")
    return SensorDepth(folder, times, tuple(files), {} if listed else {p.stem: p for p in files}, units)


def scale_from_depth(sensor: SensorDepth, map_: Material) -> Scale:
    """Per frame the robust mean of sensor depth over map depth at static points, then over frames.

    The sigma holds the spread over frames and what the focal length leaves open; an error of the sensor that all its
    images share is not known here. Raises InputError where too few frames have both.
    """
    map_.needed_tracks(WHERE)
    tracked = map_.trajectory.tracked()
    files = _files_of(sensor, tracked.timestamps_s, map_)
    chosen = [list(files)[n] for n in evenly(len(files), MOST_FRAMES)]
    logs, broken = [], 0
    for row in chosen:
        px, z = map_.observed(float(tracked.timestamps_s[row]))
        try:
            depth_m, _ = read_depth_m(files[row], sensor.units_per_metre)
        except BrokenFile as e:
            broken += 1
            log.warning("%s; it is left out", e)
            continue
        at = depth_at(depth_m, px, map_, files[row])
        good = at > 0
        if good.sum() >= LEAST_POINTS:
            logs.append(biweight(np.log(at[good] / z[good])))
    if len(logs) < LEAST_FRAMES:
        raise InputError(
            f"{WHERE}: expected sensor depth at {LEAST_POINTS} static points of {LEAST_FRAMES} or more frames, got "
            f"{len(logs)} of {len(files)} frames that {len(sensor.paths)} depth images belong to, {broken} broken"
        )
    values = np.array(logs)
    found, sigma = jackknifed(lambda rows: biweight(values[rows]), len(values))
    return scale_of(found, float(np.hypot(sigma, map_.focal_sigma_ratio)), len(logs), "frames with sensor depth", WHERE)


def depth_at(depth_m: Array, px: Array, map_: Material, path: Path) -> Array:
    """(m,) metres at (m, 2) pixels of the photograph; 0 = none, and at edges of the depth. Raises InputError."""
    lens, (height, width) = map_.lens, depth_m.shape
    if lens is None or abs(width * lens.height / (height * lens.width) - 1) > SAME_ASPECT:
        size = "that of the photographs" if lens is None else f"that of {lens.width}x{lens.height}"
        raise InputError(f"{path}: expected depth registered to the photographs, shape {size}, got {width}x{height}")
    around = np.ones((3, 3), np.uint8)
    farthest = cv2.dilate(depth_m, around)
    nearest = cv2.erode(np.where(depth_m > 0, depth_m, NO_DEPTH_M).astype(np.float32), around)
    smooth = (farthest > 0) & (farthest - nearest < EDGE_RATIO * nearest)
    known = np.where(depth_m > 0, depth_m, 0.5 * (farthest + nearest))  # a laser hits few pixels, next to most of them
    at = np.rint((px + 0.5) * np.array([width / lens.width, height / lens.height]) - 0.5).astype(int)
    inside = ((at >= 0) & (at < [width, height])).all(1)
    x, y = np.where(inside[:, None], at, 0).T
    return np.where(inside & smooth[y, x], known[y, x], 0).astype(float)


def _files_of(sensor: SensorDepth, times_s: Array, map_: Material) -> dict[int, Path]:
    """Row of the tracked frames -> its file, by the frame's name, else by time."""
    named = {}
    for row, time_s in enumerate(times_s):
        file = map_.names.get(stamp(float(time_s)))
        if file is not None and (path := sensor.by_stem.get(Path(file).stem)) is not None:
            named[row] = path
    if named or not len(sensor.times_s):
        return named
    at = nearest_time(sensor.times_s, times_s)
    return {row: sensor.paths[k] for row, k in enumerate(at) if k >= 0}


def _times_of(files: list[Path]) -> Array:
    """(n,) times that the names say; empty where one says none."""
    try:
        times = np.array([float(p.stem) for p in files])
    except ValueError:
        return np.zeros(0)
    return times if np.isfinite(times).all() else np.zeros(0)


def _units(folder: Path, first: Path) -> float:
    """Units a metre of integer depth files. Raises InputError."""
    for info in (folder / "info.json", folder.parent / "info.json"):
        if os.path.lexists(info) and "depth_scale" in (facts := whole_json(info)):
            said = facts["depth_scale"]
            if isinstance(said, bool) or not isinstance(said, int | float) or not 0 < said < 1e9:
                raise InputError(f"{info}: expected depth_scale above 0, got {said!r}")
            return float(said)
    if os.path.lexists(folder / "depth.txt"):
        log.warning("%s tells no depth_scale in info.json: %g units a metre assumed, as TUM's", folder, TUM_DEPTH_SCALE)
        return TUM_DEPTH_SCALE
    if first.suffix.lower() == ".npy":
        return 1.0  # of integers; floats are metres anyway
    raise InputError(
        f"{WHERE}: expected the units a metre of {folder}, as depth_scale in its info.json or as depth:FOLDER=1000, "
        "got neither"
    )
