"""The Bonn RGB-D Dynamic dataset: the TUM layout, with ground truth of a frame of markers instead of the camera's.

Palazzolo et al., "ReFusion: 3D reconstruction in dynamic environments for RGB-D cameras exploiting residuals", IROS
2019; https://www.ipb.uni-bonn.de/data/rgbd-dynamic-dataset/ and the script compute_global_transformation.py offered
there, which give, for the pose T of groundtruth.txt,

    model_from_sensor = T_ros T T_ros T_m        (T_ros is its own inverse)

The linear part of T_m is 1.0593 times a rotation, the ratio of the laser model's metre to the depth sensor's. A pose
has no scale, so the rotation alone is taken; the position of the camera is the same either way.
Lists of the archives name some pictures that are not in them: those are left out, and counted in a note.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..config import SourceConfig
from ..errors import InputError
from ..geometry.se3 import nearest_rotation
from ..reading.files import is_file
from .image_files import read_rgb
from .sequence import Wants
from .tum import TumSource, file_rows

Array = NDArray[Any]
KIND = "bonn"
EXPECTED = "Bonn RGB-D Dynamic (the TUM layout, 640x480, recorded in January and February 2019)"
CALIBRATION = (542.822841, 542.576870, 315.593520, 237.756098, 0.039903, -0.099343, -0.000730, -0.000144)
SIZE = (640, 480)
RECORDED_S = (1546300800.0, 1551398400.0)  # 2019-01-01 to 2019-03-01, UTC
STEM_DECIMALS = 5  # rgb/1548266470.85761.png; the TUM benchmark writes six
MOST_ABSENT_RATIO = 0.1  # more is a truncated archive, not the dataset's own gaps
T_ROS = np.array([[-1.0, 0, 0, 0], [0, 0, 1, 0], [0, 1, 0, 0], [0, 0, 0, 1]])
T_M = np.array(
    [
        [1.0157, 0.1828, -0.2389, 0.0113],
        [0.0009, -0.8431, -0.6413, -0.0098],
        [-0.3009, 0.6147, -0.8085, 0.0111],
        [0.0, 0.0, 0.0, 1.0],
    ]
)


def looks_like(folder: Path) -> str | None:
    """What makes a TUM layout a sequence of this dataset, or None: times, names and size of its pictures."""
    if not is_file(folder / "rgb.txt"):
        return None
    try:
        first = file_rows(folder / "rgb.txt")[0]
        stem = Path(first.words[0]).stem
        fits = RECORDED_S[0] < first.timestamp_s < RECORDED_S[1] and len(stem.partition(".")[2]) == STEM_DECIMALS
        if not fits or read_rgb(folder / first.words[0]).shape[:2] != SIZE[::-1]:
            return None
    except InputError:  # the TUM loader says what is wrong with it
        return None
    return f"rgb.txt begins in early 2019 ({first.timestamp_s:.2f} s), with names of its form, 640x480"


def world_from_cam(groundtruth: Array) -> Array:
    """Poses of groundtruth.txt (n, 4, 4) as those of the colour camera, in the axes of the laser model."""
    marker_from_cam = T_M.copy()
    marker_from_cam[:3, :3] = nearest_rotation(T_M[:3, :3])
    return np.asarray(T_ROS @ groundtruth @ T_ROS @ marker_from_cam)


class BonnSource(TumSource):
    """A TUM layout whose truth is moved to the camera, and whose lists may name what is not there."""

    kind = KIND
    most_absent_ratio = MOST_ABSENT_RATIO

    def __init__(self, folder: Path, config: SourceConfig, wants: Wants, found: str = "") -> None:
        """As TumSource. Raises InputError, ConfigError."""
        super().__init__(
            folder,
            config,
            want_depth=wants.depth,
            want_semantic=wants.semantic,
            semantic_dir=wants.semantic_dir,
            published=CALIBRATION,
            lens_size=SIZE,
            found=found,
        )
        self._notes.put("markers", "groundtruth.txt is of the markers: moved to the camera by the published T_ros, T_m")
        if self.has_depth:
            self._notes.put("metre", "depth as it is stored; its metre is 1.059 of the laser model's, as T_m tells")

    def _poses(self) -> tuple[Array, Array]:
        times, poses = super()._poses()
        return times, world_from_cam(poses)
