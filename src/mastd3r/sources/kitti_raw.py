"""KITTI raw, synced and rectified: a drive such as 2011_09_26/2011_09_26_drive_0001_sync, calibration in its parent.

Geiger, Lenz, Stiller, Urtasun, "Vision meets robotics: the KITTI dataset", IJRR 2013, and the development kit's readme
and convertOxtsToPose: position by the Mercator projection with the scale of the first latitude, altitude as it is,
rotation Rz(yaw) Ry(pitch) Rx(roll). Image point = P_rect_02 R_rect_00 (R|T)_velo_to_cam (R|T)_imu_to_velo X_imu.
The world is the first packet's IMU frame (x forward, y left, z up). Packet i of a synced drive belongs to image i.
"""

from __future__ import annotations

from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from ..errors import InputError
from ..geometry.se3 import inverse
from ..reading.files import is_dir, is_file
from .kitti_odometry import camera_from_rectified, intrinsics_of
from .sequence import (
    Listed,
    Sequenced,
    numbered,
    read_keyed,
    read_lines,
    read_numbers,
    rigid,
    truth_or_note,
    without_gaps,
)

Array = NDArray[Any]
KIND = "kitti-raw"
EXPECTED = "KITTI raw (a drive with image_02 or image_00: data/0000000000.png ..., timestamps.txt)"
CAMERAS = (("02", "left colour"), ("00", "left grey"))  # the first that is there
CALIBRATION = ("calib_cam_to_cam.txt", "calib_velo_to_cam.txt", "calib_imu_to_velo.txt")
EARTH_RADIUS_M = 6378137.0
POSE_NUMBERS = 6  # lat lon alt roll pitch yaw, then velocities and more: 30 in all


def looks_like(folder: Path) -> str | None:
    """What makes a folder a drive of KITTI raw, or None."""
    for camera, _ in CAMERAS:
        images = folder / f"image_{camera}"
        if is_dir(images / "data") and is_file(images / "timestamps.txt"):
            return f"image_{camera}/data and image_{camera}/timestamps.txt are there"
    return None


def find(folder: Path) -> Sequenced:
    """Frames, times, poses of the camera from OXTS, and intrinsics. Raises InputError."""
    chosen = next(((c, what) for c, what in CAMERAS if is_dir(folder / f"image_{c}" / "data")), None)
    if chosen is None:
        raise InputError(f"{folder}: expected image_02/data or image_00/data, got neither")
    camera, what = chosen
    images = folder / f"image_{camera}"
    times = read_times(images / "timestamps.txt")
    files = without_gaps(numbered(images / "data", "", ".png", "images"), len(times), "images", images / "data")
    frames = [Listed(float(t), file) for t, file in zip(times, files, strict=True)]
    found = f"image_{camera} ({what}), timestamps.txt"
    calibration = _calibration_folder(folder)
    if calibration is None:
        line = f"no calibration: {CALIBRATION[0]} is neither beside the drive nor in it; so neither poses nor lens"
        return Sequenced(KIND, folder.resolve().name, frames, found, notes=[line])
    projection, cam_from_imu, size = _cam_from_imu(calibration, camera)
    notes: list[str] = []
    true_times, poses = truth_or_note(lambda: _truth(folder / "oxts" / "data", times, cam_from_imu, notes), notes)
    return Sequenced(
        KIND,
        folder.resolve().name,
        frames,
        f"{found}; lens of P_rect_{camera} in {CALIBRATION[0]}",
        true_times,
        poses,
        intrinsics_of(projection),
        size,
        notes=notes,
    )


def _truth(packets: Path, times: Array, cam_from_imu: Array, notes: list[str]) -> tuple[Array, Array]:
    if not is_dir(packets):
        notes.append("no oxts/data: no poses")
        return np.empty(0), np.empty((0, 4, 4))
    files = without_gaps(numbered(packets, "", ".txt", "packets"), len(times), "packets", packets)
    poses = world_from_imu(_packets(files)) @ np.linalg.inv(cam_from_imu)  # of printed rotations: not their transpose
    if not np.isfinite(poses).all():
        raise InputError(f"{packets}: expected latitudes and angles, got numbers that are none")
    notes.append(f"poses from {len(poses)} packets of oxts through {', '.join(CALIBRATION)}")
    return times, poses


def read_times(path: Path) -> Array:
    """(n,) seconds since 1970 of lines such as 2011-09-26 13:02:25.964389445, taken as UTC. Raises InputError."""
    times = []
    for number, line in read_lines(path):
        whole, _, fraction = line.partition(".")
        try:
            moment = datetime.strptime(whole, "%Y-%m-%d %H:%M:%S").replace(tzinfo=UTC)
            times.append(moment.timestamp() + float(f"0.{fraction or 0}"))
        except ValueError as e:
            raise InputError(f"{path} line {number}: expected 'YYYY-MM-DD hh:mm:ss.fraction', got {line!r}") from e
    if not times:
        raise InputError(f"{path}: expected a time a line, got none")
    return np.array(times)


def world_from_imu(packets: Array) -> Array:
    """(n, 6) lat lon (degrees) alt (metres) roll pitch yaw (radians) to (n, 4, 4) float64, the first the identity."""
    lat, lon, alt, roll, pitch, yaw = packets.T
    scale = np.cos(np.radians(lat[0]))
    x = scale * EARTH_RADIUS_M * np.radians(lon)
    y = scale * EARTH_RADIUS_M * np.log(np.tan(np.radians(90 + lat) / 2))
    poses = np.tile(np.eye(4), (len(packets), 1, 1))
    poses[:, :3, :3] = Rotation.from_euler("ZYX", np.stack([yaw, pitch, roll], 1)).as_matrix()
    poses[:, :3, 3] = np.stack([x, y, alt], 1) - np.array([x[0], y[0], alt[0]])
    return np.asarray(inverse(poses[0]) @ poses)


def _packets(files: list[Path]) -> Array:
    """(n, 6) the first numbers of each packet."""
    rows = [read_numbers(f, POSE_NUMBERS, "lat lon alt roll pitch yaw ...", at_least=True) for f in files]
    return np.stack([row[0] for row in rows])


def _calibration_folder(folder: Path) -> Path | None:
    here = folder.resolve()
    return next((p for p in (here.parent, here) if is_file(p / CALIBRATION[0])), None)


def _cam_from_imu(folder: Path, camera: str) -> tuple[Array, Array, tuple[int, int]]:
    """The (3, 4) projection of a rectified camera, (4, 4) from the IMU to it, its size. Raises InputError."""
    keys = {"R_rect_00": 9, f"P_rect_{camera}": 12, f"S_rect_{camera}": 2}
    cams = read_keyed(folder / CALIBRATION[0], keys)
    projection = cams[f"P_rect_{camera}"].reshape(3, 4)
    rectified = np.hstack([cams["R_rect_00"].reshape(3, 3), np.zeros((3, 1))])
    chain = camera_from_rectified(projection) @ rigid(rectified, f"{folder / CALIBRATION[0]} R_rect_00")
    for name in CALIBRATION[1:]:
        found = read_keyed(folder / name, {"R": 9, "T": 3})
        step = np.hstack([found["R"].reshape(3, 3), found["T"].reshape(3, 1)])
        chain = chain @ rigid(step, str(folder / name))
    width, height = cams[f"S_rect_{camera}"]
    return projection, chain, (int(width), int(height))
