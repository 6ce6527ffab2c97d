"""A trajectory as a ROS 2 bag (MCAP), written without ROS by the package rosbags."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..errors import MissingPackage
from ..geometry.quaternion import quaternion_from_rotation
from ..types import Trajectory
from .files import writing

Array = NDArray[Any]
MAP, CAMERA = "map", "camera_optical_frame"
POSES, TF = "/camera/pose", "/tf"
MAP_FROM_WORLD = np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]])  # REP 103: z up; our world has gravity along +y
BAG_VERSION = 9
PACKAGE = "a ROS bag needs the package rosbags: pip install 'mastd3r-slam[ros]'"


def check_package() -> None:
    """Raise MissingPackage where rosbags is not installed."""
    try:
        import rosbags.rosbag2  # noqa: F401
    except ImportError as e:
        raise MissingPackage(PACKAGE) from e


def write_ros(folder: Path, trajectory: Trajectory) -> None:
    """Write a bag in the new ``folder``: /camera/pose (PoseStamped) and /tf, the camera's optical frame in map.

    Optical frames have OpenCV's axes (REP 103); map is our world turned so that z is up. Raises OutputError.
    """
    from rosbags.rosbag2 import StoragePlugin, Writer
    from rosbags.typesys import Stores, get_typestore

    store = get_typestore(Stores.ROS2_HUMBLE)
    kinds = {POSES: "geometry_msgs/msg/PoseStamped", TF: "tf2_msgs/msg/TFMessage"}
    with writing(folder), Writer(folder, version=BAG_VERSION, storage_plugin=StoragePlugin.MCAP) as bag:
        topics = {topic: bag.add_connection(topic, kind, typestore=store) for topic, kind in kinds.items()}
        for time_s, pose in zip(trajectory.timestamps_s, trajectory.world_from_cam, strict=True):
            time_ns = round(float(time_s) * 1e6) * 1000
            for topic, message in zip(topics, _messages(store.types, time_ns, pose), strict=True):
                bag.write(topics[topic], time_ns, store.serialize_cdr(message, kinds[topic]))


def _messages(types: Any, time_ns: int, world_from_cam: Array) -> tuple[Any, Any]:
    """The camera's place at one time as PoseStamped and as TFMessage."""
    w, x, y, z = quaternion_from_rotation(MAP_FROM_WORLD @ world_from_cam[:3, :3]).tolist()
    at = (MAP_FROM_WORLD @ world_from_cam[:3, 3]).tolist()
    time = types["builtin_interfaces/msg/Time"](*divmod(time_ns, 10**9))
    head = types["std_msgs/msg/Header"](time, MAP)
    turn = types["geometry_msgs/msg/Quaternion"](x, y, z, w)
    pose = types["geometry_msgs/msg/Pose"](types["geometry_msgs/msg/Point"](*at), turn)
    move = types["geometry_msgs/msg/Transform"](types["geometry_msgs/msg/Vector3"](*at), turn)
    placed = types["geometry_msgs/msg/TransformStamped"](head, CAMERA, move)
    return types["geometry_msgs/msg/PoseStamped"](head, pose), types["tf2_msgs/msg/TFMessage"]([placed])
