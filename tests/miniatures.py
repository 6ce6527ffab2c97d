"""The public datasets in miniature: a few small frames in the files and folders that their archives hold.

Written from the datasets' own descriptions, with none of the loaders' code; each returns the folder that a user names
and what a loader must give back.
"""

from __future__ import annotations

import json
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image
from scipy.spatial.transform import Rotation

from helpers import blobs

Array = NDArray[Any]
FR1 = (517.306408, 516.469215, 318.643040, 255.313989, 0.262383, -0.953104, -0.005358, 0.002628, 1.163314)


@dataclass
class Miniature:
    """A folder, and what is true of it."""

    folder: Path
    images: list[Array]  # (h, w, 3) uint8
    times_s: Array  # (n,)
    truth_times_s: Array  # (m,)
    world_from_cam: Array  # (m, 4, 4)
    calibration: tuple[float, ...] = ()
    depth_m: list[Array] = field(default_factory=list)  # (h, w), 0 = none


def random_poses(count: int, seed: int, spread_m: float = 1.0) -> Array:
    """(n, 4, 4) poses that have nothing special about them."""
    rng = np.random.default_rng(seed)
    poses = np.tile(np.eye(4), (count, 1, 1))
    poses[:, :3, :3] = Rotation.random(count, random_state=rng).as_matrix()
    poses[:, :3, 3] = rng.normal(0, spread_m, (count, 3))
    return poses


def write_image(path: Path, image: Array) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    Image.fromarray(image).save(path, compress_level=1)


def words(values: Any) -> str:
    """Numbers as text from which they can be read back exactly."""
    return " ".join(repr(float(v)) for v in np.ravel(values))


def depth_units(count: int, width: int, height: int, seed: int) -> list[Array]:
    """uint16 depth images with holes of 0."""
    rng = np.random.default_rng(seed)
    units = rng.integers(500, 30000, (count, height, width)).astype(np.uint16)
    units[:, : height // 3, : width // 4] = 0
    return list(units)


def enlarged(images: list[Array], size: tuple[int, int]) -> list[Array]:
    """Small pictures at the size of the dataset's, each pixel a block: quick to write and to read."""
    factor = size[0] // images[0].shape[1]
    return [np.repeat(np.repeat(image, factor, 0), factor, 1) for image in images]


# -- TUM RGB-D and Bonn ----------------------------------------------------------------------------------------------


def tum_lists(folder: Path, name: str, stamps: list[str], poses: Array, pose_stamps: list[str], head: str) -> None:
    """The three lists, with the head that the archives have."""
    for what, title in (("rgb", "color images"), ("depth", "depth maps")):
        rows = [f"{t} {what}/{t}.png" for t in stamps]
        (folder / f"{what}.txt").write_text(f"# {title}\n{head}# timestamp filename\n" + "\n".join(rows) + "\n")
    rows = []
    for stamp, pose in zip(pose_stamps, poses, strict=True):
        quaternion = Rotation.from_matrix(pose[:3, :3]).as_quat()
        rows.append(f"{stamp} {words(pose[:3, 3])} {words(quaternion)}")
    title = f"# ground truth trajectory\n{head}# timestamp tx ty tz qx qy qz qw\n"
    (folder / "groundtruth.txt").write_text(title + "\n".join(rows) + "\n")


def tum_rgbd(root: Path, camera: str = "freiburg1", count: int = 3, size: tuple[int, int] = (640, 480)) -> Miniature:
    """A recording of the benchmark, by default of its first camera: poses at 100 Hz beside frames at 30."""
    name = f"rgbd_dataset_{camera}_xyz"
    folder = root / name
    images, units = enlarged(blobs(count), size), enlarged(depth_units(count, 64, 48, seed=1), size)
    stamps = [f"{1305031102.175304 + i / 30:.6f}" for i in range(count)]
    for stamp, image, depth in zip(stamps, images, units, strict=True):
        write_image(folder / "rgb" / f"{stamp}.png", image)
        write_image(folder / "depth" / f"{stamp}.png", depth)
    poses = random_poses(4 * count, seed=2)
    pose_stamps = [f"{1305031102.1758 + i / 100:.4f}" for i in range(4 * count)]
    tum_lists(folder, name, stamps, poses, pose_stamps, f"# file: '{name}.bag'\n")
    (folder / "accelerometer.txt").write_text("# accelerometer data\n# timestamp ax ay az\n1305031102.1 0 0 9.8\n")
    return Miniature(
        folder,
        images,
        np.array(stamps, float),
        np.array(pose_stamps, float),
        poses,
        FR1 if camera == "freiburg1" else (),
        [u / np.float32(5000) for u in units],
    )


def bonn(root: Path, count: int = 12) -> Miniature:
    """A sequence whose depth.txt names a file that is not there, as the archives' do; truth is of the markers."""
    folder = root / "rgbd_bonn_balloon"
    images, units = enlarged(blobs(count), (640, 480)), enlarged(depth_units(count, 64, 48, seed=3), (640, 480))
    stamps = [f"{1548266469.85761 + i / 30:.5f}" for i in range(count)]
    for stamp, image, depth in zip(stamps, images, units, strict=True):
        write_image(folder / "rgb" / f"{stamp}.png", image)
        write_image(folder / "depth" / f"{stamp}.png", depth)
    cameras = random_poses(count, seed=4)
    tum_lists(folder, folder.name, stamps, markers_of(cameras), stamps, "")
    (folder / "depth" / f"{stamps[2]}.png").unlink()
    times = np.array(stamps, float)
    lens = (542.822841, 542.576870, 315.593520, 237.756098, 0.039903, -0.099343, -0.000730, -0.000144)
    return Miniature(folder, images, times, times, cameras, lens, [u / np.float32(5000) for u in units])


def markers_of(cameras: Array) -> Array:
    """The poses that groundtruth.txt must have for these cameras: T = T_ros C inv(T_m) T_ros, T_ros = inv(T_ros).

    The rotation of T_m is found by scipy, from its two published columns and their product.
    """
    t_ros = np.array([[-1, 0, 0, 0], [0, 0, 1, 0], [0, 1, 0, 0], [0, 0, 0, 1.0]])
    published = np.array([[1.0157, 0.1828, -0.2389], [0.0009, -0.8431, -0.6413], [-0.3009, 0.6147, -0.8085]])
    rotation, _ = Rotation.align_vectors(published.T, np.eye(3))
    t_m = np.eye(4)
    t_m[:3, :3], t_m[:3, 3] = rotation.as_matrix(), [0.0113, -0.0098, 0.0111]
    return np.asarray(t_ros @ cameras @ np.linalg.inv(t_m) @ t_ros)


# -- KITTI -----------------------------------------------------------------------------------------------------------

K_02 = np.array([[721.5377, 0, 609.5593], [0, 721.5377, 172.854], [0, 0, 1]])
P_02 = np.hstack([K_02, [[44.85728], [0.2163791], [0.002745884]]])  # as published for 2011_09_26
IMU_TO_VELO = np.array(
    [
        [9.999976e-01, 7.553071e-04, -2.035826e-03, -8.086759e-01],
        [-7.854027e-04, 9.998898e-01, -1.482298e-02, 3.195559e-01],
        [2.024406e-03, 1.482454e-02, 9.998881e-01, -7.997231e-01],
    ]
)
VELO_TO_CAM = np.array(
    [
        [7.533745e-03, -9.999714e-01, -6.166020e-04, -4.069766e-03],
        [1.480249e-02, 7.280733e-04, -9.998902e-01, -7.631618e-02],
        [9.998621e-01, 7.523790e-03, 1.480755e-02, -2.717806e-01],
    ]
)
R_RECT = np.array(
    [
        [9.999239e-01, 9.837760e-03, -7.445048e-03],
        [-9.869795e-03, 9.999421e-01, -4.278459e-03],
        [7.402527e-03, 4.351614e-03, 9.999631e-01],
    ]
)


def square(matrix: Array) -> Array:
    """(3, 3) or (3, 4) to (4, 4)."""
    full = np.eye(4)
    full[:3, : matrix.shape[1]] = matrix
    return full


def kitti_raw(root: Path, count: int = 4) -> Miniature:
    """A drive with both left cameras. The car drives a known arc; its latitudes and longitudes are made from that."""
    day = root / "2011_09_26"
    folder = day / "2011_09_26_drive_0001_sync"
    images = enlarged(blobs(count, 414, 125), (1242, 375))
    clock = [f"2011-09-26 13:02:{25.964389445 + 0.1 * i:012.9f}" for i in range(count)]
    for camera in ("00", "02"):
        for i, image in enumerate(images):
            write_image(
                folder / f"image_{camera}" / "data" / f"{i:010d}.png", image if camera == "02" else image[..., 0]
            )
        (folder / f"image_{camera}" / "timestamps.txt").write_text("\n".join(clock) + "\n")
    world_from_imu = kitti_oxts(folder / "oxts", clock)
    calibration = {
        "calib_imu_to_velo.txt": f"R: {words(IMU_TO_VELO[:, :3])}\nT: {words(IMU_TO_VELO[:, 3])}\n",
        "calib_velo_to_cam.txt": f"R: {words(VELO_TO_CAM[:, :3])}\nT: {words(VELO_TO_CAM[:, 3])}\n"
        "delta_f: 0.000000e+00 0.000000e+00\n",
        "calib_cam_to_cam.txt": "corner_dist: 9.950000e-02\nS_rect_02: 1.242000e+03 3.750000e+02\n"
        f"R_rect_00: {words(R_RECT)}\nP_rect_02: {words(P_02)}\n",
    }
    for name, text in calibration.items():
        (day / name).write_text("calib_time: 09-Jan-2012 13:57:47\n" + text)
    offset = np.eye(4)
    offset[:3, 3] = np.linalg.inv(K_02) @ P_02[:, 3]
    cam_from_imu = offset @ square(R_RECT) @ square(VELO_TO_CAM) @ square(IMU_TO_VELO)
    midnight_s = 1316995200.0  # 2011-09-26 00:00 UTC
    times = midnight_s + 13 * 3600 + 2 * 60 + 25.964389445 + 0.1 * np.arange(count)
    poses = world_from_imu @ np.linalg.inv(cam_from_imu)
    lens = (721.5377, 721.5377, 609.5593, 172.854)
    return Miniature(folder, images, times, times, poses, lens)


def kitti_oxts(folder: Path, clock: list[str]) -> Array:
    """Packets of 30 numbers on an arc that is given in metres east, north and up; the poses relative to the first."""
    count = len(clock)
    s = 3.0 * np.arange(count)
    east_north_up = np.stack([s, 0.05 * s**2, 0.02 * s], 1)
    angles = np.stack([0.01 * s, -0.02 * s, 0.3 + 0.04 * s], 1)  # roll, pitch, yaw
    lat0, lon0, alt0, radius = 49.015, 8.434, 116.4, 6378137.0
    scale = np.cos(np.deg2rad(lat0))
    lon = lon0 + np.rad2deg(east_north_up[:, 0] / (scale * radius))
    north0 = np.arctanh(np.sin(np.deg2rad(lat0)))  # the Mercator ordinate, in another form than the development kit's
    lat = np.rad2deg(np.arcsin(np.tanh(north0 + east_north_up[:, 1] / (scale * radius))))
    (folder / "data").mkdir(parents=True)
    poses = np.tile(np.eye(4), (count, 1, 1))
    for i, (roll, pitch, yaw) in enumerate(angles):
        packet = [lat[i], lon[i], alt0 + east_north_up[i, 2], roll, pitch, yaw, *np.zeros(19)]
        (folder / "data" / f"{i:010d}.txt").write_text(f"{words(packet)} 4 11 6 6 6\n")
        turn = [[0, 0, 1], [0, 1, 0], [1, 0, 0]]
        rotation = np.eye(3)
        for axis, angle in zip(turn, (yaw, pitch, roll), strict=True):
            rotation = rotation @ Rotation.from_rotvec(np.array(axis) * angle).as_matrix()
        poses[i, :3, :3], poses[i, :3, 3] = rotation, east_north_up[i]
    (folder / "timestamps.txt").write_text("\n".join(clock) + "\n")
    return np.asarray(np.linalg.inv(poses[0]) @ poses)


def kitti_odometry(root: Path, count: int = 4, camera: int = 2) -> Miniature:
    """Sequence 03 as the three archives unpack: images and times, calibration, poses of the left grey camera."""
    folder = root / "dataset" / "sequences" / "03"
    images = blobs(count, 62, 19)
    for i, image in enumerate(images):
        write_image(folder / f"image_{camera}" / f"{i:06d}.png", image if camera == 2 else image[..., 0])
    if camera == 0:
        images = [np.repeat(image[..., :1], 3, 2) for image in images]
    times = np.array([float(f"{0.1037 * i:e}") for i in range(count)])
    (folder / "times.txt").write_text("".join(f"{t:e}\n" for t in times))
    projections = {0: np.hstack([K_02, np.zeros((3, 1))]), 1: P_02 - 386.1448, 2: P_02, 3: P_02 - 339.5242}
    text = "".join(f"P{n}: {words(p)}\n" for n, p in projections.items())
    (folder / "calib.txt").write_text(text + f"Tr: {words(VELO_TO_CAM)}\n")
    grey = random_poses(count, seed=5, spread_m=30)
    poses = root / "dataset" / "poses"
    poses.mkdir(parents=True)
    (poses / "03.txt").write_text("".join(words(p[:3]) + "\n" for p in grey))
    offset = np.eye(4)
    offset[:3, 3] = np.linalg.inv(K_02) @ projections[camera][:, 3]
    lens = (721.5377, 721.5377, 609.5593, 172.854)
    return Miniature(folder, images, times, times, grey @ np.linalg.inv(offset), lens)


# -- 7-Scenes, EuRoC, Replica ----------------------------------------------------------------------------------------


def seven_scenes(root: Path, count: int = 3) -> Miniature:
    """A sequence of the scene chess; 65535 in depth is none."""
    folder = root / "chess" / "seq-01"
    images, units, poses = blobs(count), depth_units(count, 64, 48, seed=6), random_poses(count, seed=7)
    for i, (image, depth, pose) in enumerate(zip(images, units, poses, strict=True)):
        write_image(folder / f"frame-{i:06d}.color.png", image)
        holes = np.where(depth == 0, 65535, depth).astype(np.uint16)
        write_image(folder / f"frame-{i:06d}.depth.png", holes)
        rows = "".join("\t ".join(repr(float(v)) for v in row) + "\t \n" for row in pose)
        (folder / f"frame-{i:06d}.pose.txt").write_text(rows)
    times = np.arange(count) / 30
    return Miniature(folder, images, times, times, poses, (), [u / np.float32(1000) for u in units])


EUROC_SENSOR = """# General sensor definitions.
sensor_type: camera
comment: VI-Sensor cam0 (MT9M034)

# Sensor extrinsics wrt. the body-frame.
T_BS:
  cols: 4
  rows: 4
  data: [0.0148655429818, -0.999880929698, 0.00414029679422, -0.0216401454975,
         0.999557249008, 0.0149672133247, 0.025715529948, -0.064676986768,
        -0.0257744366974, 0.00375618835797, 0.999660727178, 0.00981073058949,
         0.0, 0.0, 0.0, 1.0]

# Camera specific definitions.
rate_hz: 20
resolution: [752, 480]
camera_model: pinhole
intrinsics: [458.654, 457.296, 367.215, 248.375] #fu, fv, cu, cv
distortion_model: radial-tangential
distortion_coefficients: [-0.28340811, 0.07395907, 0.00019359, 1.76187114e-05]
"""
T_BS = np.array(
    [
        [0.0148655429818, -0.999880929698, 0.00414029679422, -0.0216401454975],
        [0.999557249008, 0.0149672133247, 0.025715529948, -0.064676986768],
        [-0.0257744366974, 0.00375618835797, 0.999660727178, 0.00981073058949],
        [0, 0, 0, 1],
    ]
)


def euroc(root: Path, count: int = 3) -> Miniature:
    """MH_01_easy, left camera alone: grey, 20 Hz; ground truth of the body at 200 Hz; lines end as on Windows."""
    folder = root / "MH_01_easy"
    cam = folder / "mav0" / "cam0"
    images = [np.repeat(image[..., :1], 3, 2) for image in enlarged(blobs(count, 47, 30), (752, 480))]
    stamps = [1403636579763555584 + 50_000_000 * i for i in range(count)]
    for stamp, image in zip(stamps, images, strict=True):
        write_image(cam / "data" / f"{stamp}.png", image[..., 0])
    rows = "".join(f"{s},{s}.png\r\n" for s in stamps)
    (cam / "data.csv").write_bytes(f"#timestamp [ns],filename\r\n{rows}".encode())
    (cam / "sensor.yaml").write_text(EUROC_SENSOR)
    bodies = random_poses(10 * count, seed=8)
    body_stamps = [stamps[0] + 5_000_000 * i - 2_000_128 for i in range(10 * count)]
    (folder / "mav0" / "state_groundtruth_estimate0").mkdir()
    lines = ["#timestamp, p_RS_R_x [m], p_RS_R_y [m], p_RS_R_z [m], q_RS_w [], q_RS_x [], q_RS_y [], q_RS_z [], v"]
    for stamp, body in zip(body_stamps, bodies, strict=True):
        x, y, z, w = Rotation.from_matrix(body[:3, :3]).as_quat()
        lines.append(",".join([str(stamp), *(repr(float(v)) for v in (*body[:3, 3], w, x, y, z, *np.zeros(9)))]))
    truth = folder / "mav0" / "state_groundtruth_estimate0" / "data.csv"
    truth.write_bytes(("\r\n".join(lines) + "\r\n").encode())
    return Miniature(
        folder,
        images,
        np.array(stamps) / 1e9,
        np.array(body_stamps) / 1e9,
        bodies @ T_BS,
        (458.654, 457.296, 367.215, 248.375, -0.28340811, 0.07395907, 0.00019359, 1.76187114e-05),
    )


def replica(root: Path, count: int = 3) -> Miniature:
    """The scene room0; the camera's file stands beside the scenes."""
    folder = root / "Replica" / "room0"
    size, poses = (1200, 680), random_poses(count, seed=10)
    images, units = enlarged(blobs(count, 60, 34), size), enlarged(depth_units(count, 60, 34, seed=9), size)
    for i, (image, depth) in enumerate(zip(images, units, strict=True)):
        write_image(folder / "results" / f"frame{i:06d}.jpg", image)
        write_image(folder / "results" / f"depth{i:06d}.png", depth)
        images[i] = np.asarray(Image.open(folder / "results" / f"frame{i:06d}.jpg"))  # JPEG changes it
    (folder / "traj.txt").write_text("".join(" ".join(f"{v:.18e}" for v in p.ravel()) + "\n" for p in poses))
    camera = {"w": 1200, "h": 680, "fx": 600.0, "fy": 600.0, "cx": 599.5, "cy": 339.5, "scale": 6553.5}
    (folder.parent / "cam_params.json").write_text(json.dumps({"camera": camera}, indent=4))
    times = np.arange(count) / 30
    depth = [u.astype(np.float32) / np.float32(6553.5) for u in units]
    return Miniature(folder, images, times, times, poses, (600.0, 600.0, 599.5, 339.5), depth)


ALL = {
    "tum": tum_rgbd,
    "bonn": bonn,
    "kitti-raw": kitti_raw,
    "kitti-odometry": kitti_odometry,
    "7scenes": seven_scenes,
    "euroc": euroc,
    "replica": replica,
}
