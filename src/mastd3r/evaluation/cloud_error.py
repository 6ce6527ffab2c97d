"""How far a cloud is from what a depth sensor saw: accuracy, completeness and F-score.

Accuracy is the distance from a point of the cloud to the nearest of the sensor's, completeness the other way; means and
RMSE in metres. As the 7-Scenes tables have it: SLAM3R (Liu et al., CVPR 2025) prints means after a Sim(3) and ICP,
MASt3R-SLAM (Murai et al., CVPR 2025) RMSE, both of distances up to 0.5 m. The F-score is that of Knapitsch et al.,
"Tanks and Temples", SIGGRAPH 2017.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from ..camera.pinhole import Camera
from ..geometry.se3 import inverse
from ..geometry.sim3 import Sim3
from ..types import Frame, Trajectory, Truth
from .trajectory_error import ASSOCIATION_S, associate, ate_rmse, umeyama

Array = NDArray[Any]
EVERY = 5  # depth image that is used
VOXEL_M = 0.01  # both clouds are thinned to one point a voxel, so that surface counts and not how often it was seen
MAX_M = 0.5  # distances are cut there; a point further behind all that the sensor saw is not judged
F_SCORE_M = 0.05
ICP_ROUNDS, ICP_POINTS, ICP_REACH_M = 30, 40_000, 0.1


@dataclass(frozen=True)
class SensorView:
    """One depth image with its true place."""

    depth_m: Array  # (h, w) float32, 0 = none
    world_from_cam: Array  # (4, 4)


def evaluate_cloud(
    points_world: Array, trajectory: Trajectory, truth: Truth | None, frames: Iterable[Frame], lens: Camera
) -> dict[str, Any]:
    """Flat figures of a cloud (n, 3) in map units, by the depth images of the frames; empty where there are none.

    The cloud is brought to metres by the trajectory's Sim(3). ``…_registered``: after a Sim(3) ICP of the clouds as
    well, which takes out what the sensor's own scale and place differ from the true poses'. ``lens``: of the run;
    where truth knows the focal length, a centred pinhole of that is the sensor's.
    """
    sensor = sensor_views(truth, frames)
    if truth is None or not sensor:
        return {}
    ate = ate_rmse(trajectory, truth)
    if ate.truth_from_map is None or not len(points_world):
        why = ate.reason or "the cloud has no points"
        return {"cloud_accuracy_m": None, "cloud_accuracy_m_note": why}
    camera = lens.pinhole if truth.focal_px is None else Camera.centred(truth.focal_px, lens.width, lens.height)
    reference = thinned(np.concatenate([_points(view, camera) for view in sensor]))
    points = ate.truth_from_map.apply(np.asarray(points_world, float))
    points = thinned(points)
    cloud = points[seen_by_sensor(points, sensor, camera)]
    if not len(cloud):
        return {"cloud_accuracy_m": None, "cloud_accuracy_m_note": "no point lies where the sensor looked"}
    moved = registered(cloud, reference)
    return {
        **distances(cloud, reference),
        **{f"{key}_registered": value for key, value in distances(moved.apply(cloud), reference).items()},
        "cloud_registered_scale": moved.scale,
        "cloud_judged_ratio": len(cloud) / len(points),
    }


def sensor_views(truth: Truth | None, frames: Iterable[Frame]) -> list[SensorView]:
    """Every fifth frame that has a depth image and a true pose."""
    with_depth = [(f.timestamp_s, f.depth_m) for f in frames if f.depth_m is not None and f.index % EVERY == 0]
    if truth is None or not with_depth:
        return []
    rows, truth_rows = associate(np.array([t for t, _ in with_depth]), truth.timestamps_s, ASSOCIATION_S)
    return [
        SensorView(np.asarray(with_depth[r][1]), truth.world_from_cam[q]) for r, q in zip(rows, truth_rows, strict=True)
    ]


def distances(cloud: Array, reference: Array) -> dict[str, float]:
    """Accuracy and completeness, mean and RMSE, and the F-score of two clouds (n, 3), (m, 3) in metres."""
    to_reference = np.minimum(cKDTree(reference).query(cloud, distance_upper_bound=MAX_M)[0], MAX_M)
    to_cloud = np.minimum(cKDTree(cloud).query(reference, distance_upper_bound=MAX_M)[0], MAX_M)
    precision, recall = float((to_reference < F_SCORE_M).mean()), float((to_cloud < F_SCORE_M).mean())
    return {
        "cloud_accuracy_m": float(to_reference.mean()),
        "cloud_completeness_m": float(to_cloud.mean()),
        "cloud_accuracy_median_m": float(np.median(to_reference)),
        "cloud_completeness_median_m": float(np.median(to_cloud)),
        "cloud_accuracy_rmse_m": float(np.sqrt((to_reference**2).mean())),
        "cloud_completeness_rmse_m": float(np.sqrt((to_cloud**2).mean())),
        "cloud_recall_5cm": recall,
        "cloud_f_score_5cm": 2 * precision * recall / max(precision + recall, 1e-12),
    }


def registered(cloud: Array, reference: Array) -> Sim3:
    """reference_from_cloud: Sim(3) ICP, point to nearest point within 10 cm; from where the cloud is."""
    some = cloud[np.linspace(0, len(cloud) - 1, min(len(cloud), ICP_POINTS)).astype(int)]
    tree, out = cKDTree(reference), Sim3.identity()
    for _ in range(ICP_ROUNDS):
        away, found = tree.query(out.apply(some), distance_upper_bound=ICP_REACH_M)
        near, at = np.isfinite(away), np.asarray(found)
        if near.sum() < 10:
            return out
        out = umeyama(some[near], reference[at[near]])
    return out


def seen_by_sensor(points: Array, sensor: list[SensorView], camera: Camera) -> Array:
    """(n,) bool: falls on a measured pixel of some depth image, not more than 0.5 m behind it."""
    seen = np.zeros(len(points), bool)
    for view in sensor:
        rows = np.flatnonzero(~seen)
        cam_from_world = inverse(view.world_from_cam)
        at = points[rows] @ cam_from_world[:3, :3].T + cam_from_world[:3, 3]
        front = at[:, 2] > 1e-3
        px = np.rint(camera.project(np.where(front[:, None], at, [0, 0, 1.0]))).astype(int)
        inside = front & (px >= 0).all(1) & (px < [camera.width, camera.height]).all(1)
        depth = view.depth_m[px[inside, 1], px[inside, 0]]
        seen[rows[inside]] = (depth > 0) & (at[inside, 2] < depth + MAX_M)
    return seen


def thinned(points: Array) -> Array:
    """(m, 3) means of the points (n, 3) of every voxel of 1 cm."""
    if not len(points):
        return points
    cell = np.floor(points / VOXEL_M).astype(np.int64)
    cell -= cell.min(0)
    size = cell.max(0) + 1
    number = (cell[:, 0] * size[1] + cell[:, 1]) * size[2] + cell[:, 2]
    _, at, count = np.unique(number, return_inverse=True, return_counts=True)
    return np.stack([np.bincount(at, points[:, axis]) / count for axis in range(3)], 1)


def _points(view: SensorView, camera: Camera) -> Array:
    known = view.depth_m > 0
    known[1::2], known[:, 1::2] = False, False  # every other row and column is still finer than the voxels
    at = camera.rays(camera.pixel_grid()[known]) * view.depth_m[known][:, None]
    return np.asarray(at @ view.world_from_cam[:3, :3].T + view.world_from_cam[:3, 3])
