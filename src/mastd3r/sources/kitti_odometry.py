"""KITTI odometry: a folder sequences/NN with times.txt, calib.txt and image_2 or image_0; poses in poses/NN.txt.

Geiger, Lenz, Urtasun, "Are we ready for autonomous driving?", CVPR 2012, and the development kit's readme: a line of
poses/NN.txt is the (3, 4) matrix that maps points of the left grey camera (image_0) of that frame to those of the first
one. calib.txt: Pn projects points of camera 0, rectified, to image n; its last column is the offset of camera n times
its intrinsics. Sequences 11 to 21 have no published poses.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..errors import InputError
from ..geometry.se3 import inverse
from ..reading.files import is_dir, is_file
from .sequence import Listed, Sequenced, numbered, read_keyed, read_numbers, rigid_all, truth_or_note, without_gaps

Array = NDArray[Any]
KIND = "kitti-odometry"
EXPECTED = "KITTI odometry (times.txt, calib.txt and image_2 or image_0 with 000000.png ...)"
CAMERAS = ((2, "left colour"), (0, "left grey"))  # the first that is there


def looks_like(folder: Path) -> str | None:
    """What makes a folder a sequence of KITTI odometry, or None."""
    if not is_file(folder / "times.txt"):
        return None
    images = [f"image_{n}" for n, _ in CAMERAS if is_dir(folder / f"image_{n}")]
    return f"times.txt and {images[0]} are there" if images else None


def find(folder: Path) -> Sequenced:
    """Frames, times, poses and intrinsics of the left colour camera, else the left grey one. Raises InputError."""
    chosen = next(((n, what) for n, what in CAMERAS if is_dir(folder / f"image_{n}")), None)
    if chosen is None:
        raise InputError(f"{folder}: expected image_2 or image_0, got neither")
    camera, what = chosen
    times = read_numbers(folder / "times.txt", 1, "a time in seconds")[:, 0]
    images = without_gaps(numbered(folder / f"image_{camera}", "", ".png", "images"), len(times), "images", folder)
    projection = read_keyed(folder / "calib.txt", {f"P{camera}": 12})[f"P{camera}"].reshape(3, 4)
    notes: list[str] = []
    true_times, poses = truth_or_note(lambda: _truth(folder, times, projection, camera, notes), notes)
    return Sequenced(
        KIND,
        folder.resolve().name,
        [Listed(float(t), image) for t, image in zip(times, images, strict=True)],
        f"image_{camera} ({what}), times.txt; lens of P{camera} in calib.txt",
        true_times,
        poses,
        intrinsics_of(projection),
        notes=notes,
    )


def _truth(folder: Path, times: Array, projection: Array, camera: int, notes: list[str]) -> tuple[Array, Array]:
    file = _pose_file(folder)
    if file is None:
        notes.append(f"no poses: {folder.resolve().name}.txt is neither in ../../poses nor in the folder")
        return np.empty(0), np.empty((0, 4, 4))
    world_from_grey = rigid_all(read_numbers(file, 12, "a (3, 4) matrix"), file)
    if len(world_from_grey) != len(times):
        raise InputError(f"{file}: expected {len(times)} poses as times.txt has times, got {len(world_from_grey)}")
    notes.append(f"poses of {file.name}, moved from the left grey camera to image_{camera}")
    return times, world_from_grey @ inverse(camera_from_rectified(projection))


def camera_from_rectified(projection: Array) -> Array:
    """(4, 4) from the rectified camera 0 to the camera of a (3, 4) projection: inv(K) times its last column."""
    offset = np.eye(4)
    offset[:3, 3] = np.linalg.solve(projection[:, :3], projection[:, 3])
    return offset


def intrinsics_of(projection: Array) -> tuple[float, ...]:
    """fx, fy, cx, cy of a (3, 4) projection; rectified images have no distortion."""
    return tuple(float(projection[i, j]) for i, j in ((0, 0), (1, 1), (0, 2), (1, 2)))


def _pose_file(folder: Path) -> Path | None:
    """poses/NN.txt beside sequences/, as the archives unpack; or in the sequence's own folder."""
    here = folder.resolve()
    places = (here.parent.parent / "poses" / f"{here.name}.txt", here / f"{here.name}.txt", here / "poses.txt")
    return next((p for p in places if is_file(p)), None)
