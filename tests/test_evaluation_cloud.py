"""Accuracy, completeness and F-score of clouds whose error is known."""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest

from mastd3r.camera.pinhole import Camera
from mastd3r.evaluation.cloud_error import distances, evaluate_cloud, registered, seen_by_sensor, sensor_views, thinned
from mastd3r.geometry.sim3 import Sim3
from mastd3r.sources.synthetic import room_camera, synthetic_frames
from mastd3r.types import Frame, Trajectory, Truth


def wall(step: float) -> np.ndarray:
    x, y = np.meshgrid(np.arange(0, 1, step), np.arange(0, 1, step))
    return np.stack([x.ravel(), y.ravel(), np.zeros(x.size)], 1)


def test_a_wall_two_centimetres_away() -> None:
    found = distances(wall(0.01) + np.array([0, 0, 0.02]), wall(0.01))
    assert found["cloud_accuracy_m"] == pytest.approx(0.02)
    assert found["cloud_completeness_rmse_m"] == pytest.approx(0.02)
    assert found["cloud_f_score_5cm"] == 1


def test_half_a_wall_is_accurate_and_half_complete() -> None:
    whole = wall(0.01)
    found = distances(whole[whole[:, 0] < 0.5], whole)
    assert found["cloud_accuracy_m"] == 0
    assert found["cloud_recall_5cm"] == pytest.approx(0.55, abs=0.02)  # 5 cm beyond it are near enough
    assert found["cloud_completeness_m"] == pytest.approx(0.125, abs=0.01)
    assert found["cloud_f_score_5cm"] == pytest.approx(2 * 0.55 / 1.55, abs=0.02)


def test_distances_are_cut_at_half_a_metre() -> None:
    assert distances(np.full((3, 3), 9.0), wall(0.05))["cloud_accuracy_m"] == 0.5


def test_thinning_leaves_a_point_a_voxel() -> None:
    rng = np.random.default_rng(0)
    points = np.concatenate([rng.uniform(0.001, 0.009, (50, 3)), rng.uniform(0.021, 0.029, (9, 3))])
    assert len(thinned(points)) == 2
    assert len(thinned(np.zeros((0, 3)))) == 0


@cache
def room() -> tuple[list[Frame], Truth]:
    views = list(synthetic_frames(31))
    frames = [Frame(v.frame.index, v.frame.timestamp_s, v.frame.image, v.depth_m) for v in views]
    poses = np.stack([v.world_from_cam for v in views])
    return frames, Truth(np.array([f.timestamp_s for f in frames]), poses, {}, room_camera().fx_px)


def test_the_sensor_s_own_points_in_map_units_are_exact() -> None:
    frames, truth = room()
    camera = room_camera()
    sensor = sensor_views(truth, frames)
    assert len(sensor) == 7
    at = camera.rays(camera.pixel_grid()) * sensor[3].depth_m[..., None]
    points = (at @ sensor[3].world_from_cam[:3, :3].T + sensor[3].world_from_cam[:3, 3]).reshape(-1, 3)
    map_from_truth = Sim3(np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]]), np.array([3.0, 1, 2]), 0.4)
    poses = truth.world_from_cam.copy()
    poses[:, :3, :3] = map_from_truth.rotation @ poses[:, :3, :3]
    poses[:, :3, 3] = map_from_truth.apply(truth.world_from_cam[:, :3, 3])
    trajectory = Trajectory(truth.timestamps_s, poses, ("tracked",) * len(poses), np.zeros(len(poses), bool))
    found = evaluate_cloud(map_from_truth.apply(points), trajectory, truth, frames, camera)
    assert found["cloud_accuracy_m"] < 0.006
    assert found["cloud_accuracy_m_registered"] < 0.006
    assert found["cloud_registered_scale"] == pytest.approx(1, abs=0.005)
    assert found["cloud_judged_ratio"] == 1
    none = evaluate_cloud(np.zeros((0, 3)), trajectory, truth, frames, camera)
    assert none["cloud_accuracy_m"] is None and none["cloud_accuracy_m_note"]
    without = [Frame(f.index, f.timestamp_s, f.image) for f in frames]
    assert evaluate_cloud(points, trajectory, truth, without, camera) == {}


def test_registration_finds_a_scale() -> None:
    frames, truth = room()
    view = sensor_views(truth, frames)[0]
    camera = room_camera()
    points = thinned((camera.rays(camera.pixel_grid()) * view.depth_m[..., None]).reshape(-1, 3))
    moved = registered(points / 1.03 + [0.01, 0, 0], points)
    assert moved.scale == pytest.approx(1.03, abs=0.006)


def test_only_what_the_sensor_could_see_is_judged() -> None:
    frames, truth = room()
    views = sensor_views(truth, frames)[:1]
    pose, camera = views[0].world_from_cam, Camera.centred(room_camera().fx_px, 320, 240)
    depth = float(views[0].depth_m[120, 160])
    ray = camera.rays(np.array([160.0, 120.0]))
    at = np.stack([ray * depth * 0.5, ray * (depth + 0.4), ray * (depth + 0.7), -ray, [9.0, 0, 1.0]])
    seen = seen_by_sensor(at @ pose[:3, :3].T + pose[:3, 3], views, camera)
    assert seen.tolist() == [True, True, False, False, False]
