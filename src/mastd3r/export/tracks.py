"""Tracks of a run: static points, and where frames were measured to see them; ``tracks.npz`` of a run folder."""

from __future__ import annotations

import io
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..errors import InputError
from ..reading.arrays import arrays_of
from .files import write_bytes

Array = NDArray[Any]


FIELDS: dict[str, tuple[str, tuple[Any, ...]]] = {  # name -> type, shape
    "points_world": ("<f4", ("n", 3)),
    "colors": ("|u1", ("n", 3)),
    "timestamps_s": ("<f8", ("f",)),
    "point": ("<i4", ("m",)),
    "frame": ("<i4", ("m",)),
    "px": ("<f4", ("m", 2)),
}


@dataclass(frozen=True)
class Tracks:
    """n points seen m times in f frames. Observations of a point stand together, in order of time."""

    points_world: Array  # (n, 3) float32, map units
    colors: Array  # (n, 3) uint8 RGB
    timestamps_s: Array  # (f,) float64, ascending
    point: Array  # (m,) int32 row of points_world
    frame: Array  # (m,) int32 row of timestamps_s
    px: Array  # (m, 2) float32 where the frame was measured to see the point; pixels of the full-size photograph

    def in_lengths(self, factor: float) -> Tracks:
        """The same with lengths times ``factor``."""
        return replace(self, points_world=self.points_world * np.float32(factor))

    def seen(self, keep: Array) -> Tracks:
        """The observations in ``keep`` (m,) bool, and the points that at least two frames still see."""
        count = np.bincount(self.point[keep], minlength=len(self.points_world))
        keep = keep & (count[self.point] > 1)
        number = np.cumsum(count > 1) - 1
        return Tracks(
            self.points_world[count > 1],
            self.colors[count > 1],
            self.timestamps_s,
            number[self.point[keep]].astype(np.int32),
            self.frame[keep],
            self.px[keep],
        )


def write_tracks(path: Path, tracks: Tracks) -> None:
    """Write all fields, compressed. Raises OutputError."""
    packed = io.BytesIO()
    np.savez_compressed(packed, **vars(tracks))
    write_bytes(path, packed.getvalue())


def read_tracks(path: Path) -> Tracks:
    """Read what ``write_tracks`` wrote. Raises InputError for any other file."""
    tracks = Tracks(**arrays_of(path, {name: kind for name, (kind, _) in FIELDS.items()}, "the tracks of a run"))
    points, frames, seen = len(tracks.points_world), len(tracks.timestamps_s), len(tracks.point)
    for name, (_, shape) in FIELDS.items():
        wanted = tuple({"n": points, "f": frames, "m": seen}.get(side, side) for side in shape)
        if getattr(tracks, name).shape != wanted:
            raise InputError(f"{path} {name}: expected shape {wanted}, got {getattr(tracks, name).shape}")
    for name, most in (("point", points), ("frame", frames)):
        rows = getattr(tracks, name)
        if seen and not (rows.min() >= 0 and rows.max() < most):
            raise InputError(f"{path} {name}: expected rows below {most}, got {rows.min()} to {rows.max()}")
    if not all(np.isfinite(a).all() for a in (tracks.points_world, tracks.timestamps_s, tracks.px)):
        raise InputError(f"{path}: expected finite numbers, got some that are not")
    return tracks
