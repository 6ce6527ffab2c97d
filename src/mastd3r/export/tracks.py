"""Tracks of a run: static points, and where frames were measured to see them; ``tracks.npz`` of a run folder."""

from __future__ import annotations

import io
import zipfile
import zlib
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..errors import InputError
from .files import write_bytes

Array = NDArray[Any]


@dataclass(frozen=True)
class Tracks:
    """n points seen m times in f frames. Observations of a point stand together, in order of time."""

    points_world: Array  # (n, 3) float32, map units
    colors: Array  # (n, 3) uint8 RGB
    timestamps_s: Array  # (f,) float64, ascending
    point: Array  # (m,) int32 row of points_world
    frame: Array  # (m,) int32 row of timestamps_s
    px: Array  # (m, 2) float32 where the frame was measured to see the point; pixels of the full-size photograph

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
    try:
        with np.load(path, allow_pickle=False) as packed:
            return Tracks(**{name: packed[name] for name in Tracks.__dataclass_fields__})
    except (OSError, EOFError, KeyError, ValueError, zipfile.BadZipFile, zlib.error) as e:
        raise InputError(f"{path}: expected the tracks of a run, got {e}") from e
