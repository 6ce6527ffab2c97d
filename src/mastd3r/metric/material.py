"""What a map gives to measure it by."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import PurePosixPath
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..camera.opencv_lens import OpenCvLens
from ..camera.pinhole import Camera
from ..errors import InputError
from ..export.run_folder import stamp
from ..export.tracks import Tracks
from ..geometry.se3 import inverse, transform
from ..reading.files import short
from ..types import Trajectory

Array = NDArray[Any]


@dataclass(frozen=True)
class Material:
    """Poses, lens and static points of a map; lengths are its units."""

    name: str  # for messages
    trajectory: Trajectory
    tracks: Tracks | None  # None: the run was stopped before them, or is of an older version
    lens: Camera | OpenCvLens | None
    focal_sigma_ratio: float = 0.0  # relative 1 sigma of the focal length; 0 for a lens that was given
    down_sigma_rad: float | None = None  # how well its +y is known to be down; None: it is not
    names: Mapping[str, str] = field(default_factory=dict)  # time, as run folders write it -> file of the frame

    def needed_tracks(self, where: str) -> Tracks:
        """The static points. Raises InputError where there are none."""
        if self.tracks is None or not len(self.tracks.point):
            raise InputError(f"{where}: expected static points with their observations (tracks.npz), got none")
        return self.tracks

    def observed(self, time_s: float) -> tuple[Array, Array]:
        """(m, 2) pixels of the photograph at which a frame was measured to see static points, and their (m,) depths."""
        tracks = self.needed_tracks(self.name)
        frame, row = _nearest(tracks.timestamps_s, time_s), _nearest(self.trajectory.timestamps_s, time_s)
        if frame is None or row is None:
            return np.zeros((0, 2)), np.zeros(0)
        chosen = tracks.frame == frame
        points_world = tracks.points_world[tracks.point[chosen]].astype(float)
        z = transform(inverse(self.trajectory.world_from_cam[row]), points_world)[:, 2]
        return tracks.px[chosen][z > 0].astype(float), z[z > 0]

    def time_of(self, frame: str, where: str) -> float:
        """The time of a frame by its file's name, with or without the ending, or its number from 0 in this run.

        Raises InputError for one that has no pose.
        """
        for time_s in self.trajectory.timestamps_s:
            file = self.names.get(stamp(float(time_s)))
            if file is not None and frame in (file, PurePosixPath(file).name, PurePosixPath(file).stem):
                return float(time_s)
        count = len(self.trajectory.timestamps_s)
        if not (frame.isdecimal() and len(frame) < 10 and int(frame) < count):
            known = (
                f"the name of a frame's file, or a number below {count}" if self.names else f"a number below {count}"
            )
            raise InputError(f"{where}: expected {known}, got {short(repr(frame))}")
        return float(self.trajectory.timestamps_s[int(frame)])


def _nearest(times_s: Array, time_s: float) -> int | None:
    """The row of this time, as files write it."""
    if not len(times_s):
        return None
    row = int(np.argmin(np.abs(times_s - time_s)))
    return row if abs(times_s[row] - time_s) < 1e-6 else None
