"""Metres from known positions of the camera: GPS, or another trajectory of the same camera, robustly aligned."""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..errors import InputError
from ..geometry.sim3 import Sim3, procrustes
from ..reading.files import short, whole_text
from ..types import MEASURED, Trajectory
from .estimate import Scale, jackknifed, scale_of, tukey
from .material import Material

Array = NDArray[Any]
WHERE = "--scale positions"
LEAST_POSITIONS = 6  # a Sim(3) has seven degrees of freedom, each position says three
EXACT_S, MOST_GAP_S = 0.02, 0.5  # a position belongs to a frame so near, or between two tracked ones so far apart
DRAWS = 60  # of three positions, to start from
ROUNDS = 20  # of reweighting
LEAST_AGREE = 0.5  # share of the positions that the found alignment must explain
NAMES = {  # of columns, in lower case and without units
    "time": ("timestamp", "time", "t", "timestamp_s", "time_s", "seconds", "stamp"),
    "x": ("x", "tx", "p_x", "p_rs_r_x", "px", "pos_x", "x_m"),
    "y": ("y", "ty", "p_y", "p_rs_r_y", "py", "pos_y", "y_m"),
    "z": ("z", "tz", "p_z", "p_rs_r_z", "pz", "pos_z", "z_m"),
    "lat": ("lat", "latitude", "lat_deg"),
    "lon": ("lon", "lng", "long", "longitude", "lon_deg"),
    "alt": ("alt", "altitude", "ele", "elevation", "height", "alt_m"),
}
WGS84_M, WGS84_E2 = 6378137.0, 6.69437999014e-3  # half the longer axis, first eccentricity squared
FARTHEST_M = 1e9


@dataclass(frozen=True)
class Positions:
    """Where a camera was."""

    path: Path
    times_s: Array  # (n,) ascending
    metres: Array  # (n, 3), any right-handed axes


def read_positions(path: Path) -> Positions:
    """Rows 'timestamp x y z …' (TUM), or a CSV whose header names the columns: time, and x y z or lat lon alt.

    Latitude and longitude are degrees on WGS84; a time named [ns] or ..._ns is nanoseconds. What follows the position
    in a row is not read. Raises InputError for a line that is none, and for fewer than six positions.
    """
    text = whole_text(path, "readable positions")
    rows: list[list[float]] = []
    columns: _Columns | None = None
    for number, line in enumerate(text.splitlines(), 1):
        words = _words(line.strip().lstrip("#"))
        heading = columns is None and not rows and words and not _is_number(words[0])
        if heading:
            columns = _columns(words)
        if heading or not words or line.lstrip().startswith("#"):
            continue
        rows.append(_row(words, columns, f"{path} line {number}"))
    if len(rows) < LEAST_POSITIONS:
        raise InputError(f"{path}: expected at least {LEAST_POSITIONS} positions of the camera, got {len(rows)}")
    values = np.array(rows)
    order = np.argsort(values[:, 0], kind="stable")
    values = values[order[np.append(True, np.diff(values[order, 0]) > 0)]]
    metres = values[:, 1:] if columns is None or not columns.degrees else earth_fixed_m(values[:, 1:])
    return Positions(path, values[:, 0], metres)


def scale_from_positions(known: Positions, map_: Material) -> Scale:
    """The Sim(3) that brings tracked frames to the known positions, robustly; interpolated frames are never used.

    Raises InputError where too few belong together in time, or most contradict one another.
    """
    where = f"{WHERE}: {known.path}"
    ours, theirs = paired(known, map_.trajectory)
    if len(ours) < LEAST_POSITIONS:
        spans = [_span(t) for t in (map_.trajectory.tracked().timestamps_s, known.times_s)]
        raise InputError(
            f"{where}: expected at least {LEAST_POSITIONS} positions at times of tracked frames ({spans[0]}), got "
            f"{len(ours)} of {len(known.times_s)} ({spans[1]})"
        )
    if min(np.ptp(ours, 0).max(), np.ptp(theirs, 0).max()) <= 0:
        raise InputError(f"{where}: expected a camera that changes its place, got one that stays")
    ours, theirs = ours - ours.mean(0), theirs - theirs.mean(0)
    first, _ = aligned(ours, theirs, _start(ours, theirs))
    best, agree = aligned(ours, theirs, first)
    if best.scale <= 0 or agree < LEAST_AGREE:
        raise InputError(f"{where}: expected positions along the camera's path, got {agree:.0%} that can be aligned")

    def log_scale(rows: Array) -> float:
        return math.log(max(aligned(ours[rows], theirs[rows], best)[0].scale, 1e-300))

    found, sigma = jackknifed(log_scale, len(ours))
    return scale_of(found, sigma, len(ours), "known positions", where)


def paired(known: Positions, trajectory: Trajectory) -> tuple[Array, Array]:
    """(k, 3) camera positions of the map at the times of known ones, and those, (k, 3).

    Between two tracked frames that follow one another the camera moves evenly.
    """
    tracked = np.array([s in MEASURED for s in trajectory.states], bool)
    times, places = trajectory.timestamps_s, trajectory.world_from_cam[:, :3, 3]
    if not tracked.any():
        return np.zeros((0, 3)), np.zeros((0, 3))
    after = np.clip(np.searchsorted(times, known.times_s), 0, len(times) - 1)
    before = np.maximum(after - 1, 0)
    gap = times[after] - times[before]
    ratio = np.where(gap > 0, (known.times_s - times[before]) / np.where(gap > 0, gap, 1), 1.0)
    between = (gap <= MOST_GAP_S) & (ratio >= 0) & (ratio <= 1) & tracked[before] & tracked[after]
    near = np.where(np.abs(times[after] - known.times_s) < np.abs(times[before] - known.times_s), after, before)
    exact = (np.abs(times[near] - known.times_s) <= EXACT_S) & tracked[near]
    ours = np.where(between[:, None], places[before] + ratio[:, None] * (places[after] - places[before]), places[near])
    used = between | exact
    return ours[used], known.metres[used]


def aligned(ours: Array, theirs: Array, start: Sim3) -> tuple[Sim3, float]:
    """theirs_from_ours of (n, 3) points by Tukey's biweight from ``start``, and the share of them that it explains."""
    best, floor = start, 1e-9 * float(np.linalg.norm(theirs, axis=1).max())
    weight = np.ones(len(ours))
    for _ in range(ROUNDS):
        residual = np.linalg.norm(theirs - best.apply(ours), axis=1)
        sigma = max(float(np.median(residual)) / 1.538, floor)  # the median length of three normal errors
        weight = tukey(residual / (sigma * math.sqrt(3)))
        if (weight > 0).sum() < 3:
            break
        before, best = best, procrustes(theirs, ours, weight, with_scale=True)
        if abs(best.scale - before.scale) < 1e-7 * abs(best.scale):
            break
    return best, float((weight > 0).mean())


def _start(ours: Array, theirs: Array) -> Sim3:
    """The best of many alignments of three positions, by the median error; that of all where they lie on a line."""
    random = np.random.default_rng(0)
    best = procrustes(theirs, ours, np.ones(len(ours)), with_scale=True)
    least = float(np.median(np.linalg.norm(theirs - best.apply(ours), axis=1)))
    for _ in range(DRAWS):
        rows = random.choice(len(ours), 3, replace=False)
        tried = procrustes(theirs[rows], ours[rows], np.ones(3), with_scale=True)
        error = float(np.median(np.linalg.norm(theirs - tried.apply(ours), axis=1)))
        if error < least and 0 < tried.scale < 1e12:
            best, least = tried, error
    return best


def earth_fixed_m(degrees: Array) -> Array:
    """(n, 3) metres from the first of (n, 3) latitude, longitude [deg] and altitude [m], axes of the whole earth."""
    lat, lon, alt = np.radians(degrees[:, 0]), np.radians(degrees[:, 1]), degrees[:, 2]
    normal = WGS84_M / np.sqrt(1 - WGS84_E2 * np.sin(lat) ** 2)
    xyz = np.stack(
        [
            (normal + alt) * np.cos(lat) * np.cos(lon),
            (normal + alt) * np.cos(lat) * np.sin(lon),
            (normal * (1 - WGS84_E2) + alt) * np.sin(lat),
        ],
        1,
    )
    return np.asarray(xyz - xyz[0])


@dataclass(frozen=True)
class _Columns:
    time: int
    place: tuple[int, ...]
    degrees: bool
    per_second: float


def _columns(words: Sequence[str]) -> _Columns | None:
    """What a heading says; None for one that names nothing: columns are then those of TUM."""
    plain = [re.sub(r"[\[(].*?[\])]", "", w).strip().lower() for w in words]
    nanoseconds = {n for n, w in enumerate(words) if "[ns]" in w.lower() or plain[n].endswith("_ns")}
    plain = [p.removesuffix("_ns") for p in plain]
    at = {key: next((n for n, p in enumerate(plain) if p in names), None) for key, names in NAMES.items()}
    for degrees, keys in ((False, ("x", "y", "z")), (True, ("lat", "lon", "alt"))):
        place = [at[k] for k in keys]
        if at["time"] is not None and all(p is not None for p in place):
            per_second = 1e9 if at["time"] in nanoseconds else 1.0
            return _Columns(at["time"], tuple(p for p in place if p is not None), degrees, per_second)
    return None


def _row(words: Sequence[str], columns: _Columns | None, where: str) -> list[float]:
    c = columns or _Columns(0, (1, 2, 3), False, 1.0)
    try:
        values = [float(words[n]) for n in (c.time, *c.place)]
    except (ValueError, IndexError) as e:
        wanted = "time lat lon alt" if c.degrees else "time x y z"
        raise InputError(f"{where}: expected numbers '{wanted}', got {short(' '.join(words))!r}") from e
    limits = (90, 180, 1e7) if c.degrees else (FARTHEST_M,) * 3
    if not all(abs(v) < 1e300 for v in values[:1]) or not all(
        abs(v) <= m for v, m in zip(values[1:], limits, strict=True)
    ):
        raise InputError(f"{where}: expected a time and a place, got {short(' '.join(words))!r}")
    return [values[0] / c.per_second, *values[1:]]


def _words(line: str) -> list[str]:
    if "," in line or ";" in line:
        return [w.strip().strip('"') for w in line.split("," if "," in line else ";")]
    return line.split()


def _is_number(word: str) -> bool:
    try:
        float(word)
    except ValueError:
        return False
    return True


def _span(times_s: Array) -> str:
    return f"{times_s[0]:.3f} to {times_s[-1]:.3f} s" if len(times_s) else "none"
