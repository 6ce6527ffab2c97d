"""Which way is down in a world that a camera was carried through.

People hold a camera level on average, so its right-hand axes lie in the horizon: gravity is what all of them are
perpendicular to. That tells nothing of the pitch where the camera never turned about; there, its own down axis is the
better guess, though cameras look up and down more than they roll. Both are weighed by how much people do either.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from .se3 import so3_exp

Array = NDArray[Any]
ROLL_RAD = np.radians(3.0)  # 1 sigma of the mean roll of a clip
PITCH_RAD = np.radians(20.0)  # 1 sigma of its mean pitch
TOLD_RAD = np.radians(8.0)  # 1 sigma below which the video is said to tell


def down(world_from_cam: Array) -> tuple[Array, float]:
    """(3,) unit vector of gravity in the world of some poses (n, 4, 4; OpenCV axes), and its 1-sigma in radians.

    The maximum of: mean of (right_i . d)^2 over ROLL_RAD^2, and |d - mean down axis|^2 over PITCH_RAD^2.
    """
    right, own = world_from_cam[:, :3, 0], world_from_cam[:, :3, 1]
    mean = own.mean(0)
    mean = mean / max(float(np.linalg.norm(mean)), 1e-9)
    information = right.T @ right / len(right) / ROLL_RAD**2 + np.eye(3) / PITCH_RAD**2
    found = np.linalg.solve(information, mean / PITCH_RAD**2)
    found /= np.linalg.norm(found)
    across = np.linalg.svd(found[None])[2][1:]  # two directions that gravity may still turn in
    weakest = float(np.linalg.eigvalsh(across @ information @ across.T)[0])
    return found, float(weakest**-0.5)


def turn_upright(direction: Array) -> Array:
    """(3, 3) the least rotation that brings a unit vector to (0, 1, 0): down, in OpenCV's axes."""
    axis = np.cross(direction, [0.0, 1.0, 0.0])
    sine, cosine = float(np.linalg.norm(axis)), float(direction[1])
    if sine < 1e-12:
        return np.eye(3) if cosine > 0 else np.diag([1.0, -1.0, -1.0])
    return so3_exp(axis / sine * np.arctan2(sine, cosine))
