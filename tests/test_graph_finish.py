"""After the last frame: final poses, lost frames, the static cloud."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from mastd3r.alignment.reproject import StaticMatches, solve_pose
from mastd3r.camera.pinhole import Camera
from mastd3r.config import CameraConfig, Config, GraphConfig
from mastd3r.errors import InputError
from mastd3r.geometry.se3 import interpolate, inverse, se3_exp, se3_log, transform
from mastd3r.graph.intrinsics import intrinsics_for
from mastd3r.graph.keyframe_graph import FrameRecord, KeyframeGraph
from mastd3r.offline import final_solve
from mastd3r.offline.final_solve import final_frames, finish_graph, trajectory_of
from mastd3r.offline.reweighting import MaskReweighting
from mastd3r.offline.smoothing import SmoothedMasks
from mastd3r.offline.static_cloud import static_cloud
from mastd3r.types import View

Array = NDArray[Any]
KEYFRAMES = (0, 6, 12)


def world_from(scene: Any, k: int) -> Array:
    return scene.cam_from_world[0] @ inverse(scene.cam_from_world[k])


def tracked_graph(scene: Any, lost: set[int], noise_px: float = 0.2, count: int = 13) -> KeyframeGraph:
    """Frames 0 … count - 1 of the scene; 0, 6, 12 are keyframes with true depths; guesses are a little off."""
    size = (scene.width, scene.height)
    graph = KeyframeGraph(GraphConfig(), intrinsics_for(CameraConfig(), *size, size))
    graph.intrinsics.values = scene.lens.copy()
    graph.started.add(0)
    p, rng = len(scene.px), np.random.default_rng(0)
    nothing_moves = np.zeros((scene.height, scene.width))
    for k in range(count):
        work = scene.work_frame(k)
        if k in KEYFRAMES:
            kf = graph.add_keyframe(
                work, np.ones(p), nothing_moves, inverse(world_from(scene, k)), 1 / scene.depth(k), np.ones(p)
            )
            graph.variables[kf.id].depth_info = np.full(p, 1e6)
            graph.record(work, kf.id, np.eye(4), "tracked", None, np.zeros(0))
            graph.replace_last_by_keyframe(kf)
            continue
        kf_id = graph.latest.id
        if k in lost:
            graph.record(work, kf_id, np.eye(4), "lost", None, np.zeros(0))
            continue
        m = scene.matches(KEYFRAMES[kf_id], k, noise_px)
        guess = se3_exp(rng.normal(0, 0.01, 6)) @ scene.j_from_i(KEYFRAMES[kf_id], k)
        graph.record(work, kf_id, guess, "tracked", m, m.weight)
    return graph


@pytest.fixture(scope="module")
def scene(exact_scene: Callable[..., Any]) -> Any:
    return exact_scene(13, step=0.05)


def test_every_frame_is_refined_from_its_own_matches(scene: Any) -> None:
    frames = final_frames(tracked_graph(scene, set()))
    assert [f.state for f in frames] == ["tracked"] * 13
    for k, f in enumerate(frames):
        assert np.linalg.norm(se3_log(f.world_from_cam @ inverse(world_from(scene, k)))) < 0.005
    trajectory = trajectory_of(frames)
    assert trajectory.is_keyframe.tolist() == [k in KEYFRAMES for k in range(13)]
    np.testing.assert_allclose(trajectory.timestamps_s, np.arange(13) / 30)
    assert trajectory.keyframes().world_from_cam.shape == (3, 4, 4)


def test_lost_frames_are_bridged_between_tracked_ones(scene: Any) -> None:
    frames = final_frames(tracked_graph(scene, {3, 4, 5, 8}))
    assert [n for n, f in enumerate(frames) if f.state == "interpolated"] == [3, 4, 5, 8]
    a, b = frames[2].world_from_cam, frames[6].world_from_cam
    for n in (3, 4, 5):
        np.testing.assert_allclose(frames[n].world_from_cam, interpolate(a, b, (n - 2) / 4), atol=1e-9)
    middle = 0.5 * (frames[7].world_from_cam[:3, 3] + frames[9].world_from_cam[:3, 3])
    np.testing.assert_allclose(frames[8].world_from_cam[:3, 3], middle, atol=1e-9)


def test_a_frame_that_next_to_no_match_agrees_with_lies_between_others(scene: Any, caplog: Any) -> None:
    """Its matches were found at what moves: most disagree with any pose, and too few are left."""
    graph = tracked_graph(scene, set())
    record = graph.records[5]
    off = np.random.default_rng(0).uniform(10, 60, record.target.shape).astype(np.float32)
    off[:10] = 0
    record.target = record.target + off
    with caplog.at_level("INFO"):
        frames = final_frames(graph)
    assert [n for n, f in enumerate(frames) if f.state == "interpolated"] == [5] and "frame 5:" in caplog.text
    np.testing.assert_allclose(
        frames[5].world_from_cam, interpolate(frames[4].world_from_cam, frames[6].world_from_cam, 0.5), atol=1e-9
    )
    graph = tracked_graph(scene, set())
    for r in graph.records:  # all have few: that is what this video has, and they agree
        r.points, r.target, r.weight = r.points[:30], r.target[:30], r.weight[:30] * np.float32(0.5)
    assert all(f.state == "tracked" for f in final_frames(graph))


def test_frames_lost_at_the_ends_stand_still(scene: Any) -> None:
    frames = final_frames(tracked_graph(scene, {10, 11}, count=12))
    assert [f.state for f in frames[-3:]] == ["tracked", "interpolated", "interpolated"]
    for f in frames[-2:]:
        np.testing.assert_array_equal(f.world_from_cam, frames[9].world_from_cam)
    graph = tracked_graph(scene, set())
    for r in graph.records[:2]:
        r.state, r.is_keyframe = "lost", False
    first = final_frames(graph)
    np.testing.assert_array_equal(first[0].world_from_cam, first[2].world_from_cam)
    assert np.isfinite(trajectory_of(first).world_from_cam).all()


def test_a_run_that_never_saw_anything_has_no_pose(scene: Any) -> None:
    graph = tracked_graph(scene, set(), count=3)
    for r in graph.records:
        r.state, r.is_keyframe = "lost", False
    frames = final_frames(graph)
    assert all(f.state == "lost" and np.isnan(f.world_from_cam).all() for f in frames)
    assert trajectory_of([]).world_from_cam.shape == (0, 4, 4)


def test_late_masks_take_what_moves_out_of_the_poses(scene: Any) -> None:
    """A third of the picture slides, 1 px a frame: a robust kernel gives way to that, the mask does not."""
    graph = tracked_graph(scene, set())
    moving = np.zeros((scene.height, scene.width), np.float32)
    moving[:, : scene.width // 3] = 1.0
    slides = scene.px[:, 0] < scene.width // 3 - 20
    for r in graph.records:
        if len(r.points):
            r.target = r.target - np.float32(slides[r.points][:, None] * [r.index - KEYFRAMES[r.kf_id], 0])
    truth = np.stack([world_from(scene, k) for k in range(13)])

    def worst(frames: list[Any]) -> float:
        return max(np.linalg.norm(se3_log(inverse(t) @ f.world_from_cam)) for t, f in zip(truth, frames, strict=True))

    before = worst(final_frames(graph))
    keyframes = {k: b.cam_from_world.copy() for k, b in graph.variables.items()}
    late = MaskReweighting()
    for r in graph.records:
        late.see(graph, r, moving)
    after = worst(late.poses(graph))
    assert after < 0.5 * before and after < 0.01
    assert all((graph.variables[k].cam_from_world == pose).all() for k, pose in keyframes.items())
    on_it = np.concatenate([r.weight[slides[r.points]] for r in graph.records])
    off_it = np.concatenate([r.weight[scene.px[r.points, 0] > scene.width / 3 + 20] for r in graph.records])
    assert on_it.max() < 0.03 and off_it.min() > 0.9


def test_views_and_holdout_take_the_new_poses(scene: Any) -> None:
    graph = tracked_graph(scene, set())
    old = final_frames(graph)
    new = [replace(f, world_from_cam=f.world_from_cam @ se3_exp(np.full(6, 0.01 * n))) for n, f in enumerate(old)]
    blank = np.ones((4, 4), np.float32)
    views = [
        View(f.record.timestamp_s, blank, blank, f.world_from_cam, graph.camera(), f.record.kf_id) for f in old[1:5]
    ]
    seen = SmoothedMasks(views=views, holdout=[old[8], old[0]]).with_poses(new)
    assert [v.timestamp_s for v in seen.views] == [v.timestamp_s for v in views]
    for got, wanted in zip([*seen.views, *seen.holdout], [*new[1:5], new[8], new[0]], strict=True):
        assert (got.world_from_cam == wanted.world_from_cam).all()


def test_without_masks_the_matches_keep_their_weight(scene: Any) -> None:
    graph = tracked_graph(scene, {4})
    before = [r.weight.copy() for r in graph.records]
    MaskReweighting().weigh(graph)
    assert all((r.weight == w).all() for r, w in zip(graph.records, before, strict=True))


def test_a_camera_that_never_moves_is_refused(scene: Any) -> None:
    size = (scene.width, scene.height)
    graph = KeyframeGraph(GraphConfig(), intrinsics_for(CameraConfig(), *size, size))
    p = len(scene.px)
    graph.add_keyframe(scene.work_frame(0), np.ones(p), np.zeros((240, 320)), np.eye(4), np.ones(p), np.ones(p))
    with pytest.raises(InputError, match=r"camera never moves enough: expected .* 5% .*, got 1 view"):
        finish_graph(graph, Config())


def cloud_inputs(graph: KeyframeGraph, scene: Any) -> tuple[dict[int, Array], dict[int, Array]]:
    rng = np.random.default_rng(0)
    p = len(scene.px)
    colors = {k: rng.integers(0, 255, (p, 3)).astype(np.uint8) for k in graph.variables}
    return colors, {k: np.zeros(p) for k in graph.variables}


def test_the_cloud_lies_on_the_surface(scene: Any) -> None:
    graph = tracked_graph(scene, set())
    colors, moving = cloud_inputs(graph, scene)
    cloud = static_cloud(graph, colors, moving)
    p = len(scene.px)
    assert len(cloud.points_world) == 3 * p
    truth = np.concatenate(
        [scene.points(k) @ world_from(scene, k)[:3, :3].T + world_from(scene, k)[:3, 3] for k in KEYFRAMES]
    )
    np.testing.assert_allclose(cloud.points_world, truth, rtol=0.01, atol=0.01)
    np.testing.assert_array_equal(cloud.colors, np.concatenate([colors[k] for k in range(3)]))
    np.testing.assert_array_equal(cloud.kf_id, np.repeat([0, 1, 2], p))
    depth = np.concatenate([scene.depth(k) for k in KEYFRAMES])
    np.testing.assert_allclose(cloud.spacing, depth * 16 / scene.focal_px, rtol=0.02)
    assert cloud.confidence.min() > 0.9


def test_moving_points_are_pruned_and_doubtful_ones_count_less(scene: Any) -> None:
    graph = tracked_graph(scene, set())
    colors, moving = cloud_inputs(graph, scene)
    whole = static_cloud(graph, colors, moving)
    p = len(scene.px)
    moving[1][: p // 3] = 0.9
    moving[2][:] = 0.3
    cloud = static_cloud(graph, colors, moving)
    assert (cloud.kf_id == 1).sum() == p - p // 3 and (cloud.kf_id == 0).sum() == p
    np.testing.assert_array_equal(cloud.colors[cloud.kf_id == 1], colors[1][p // 3 :])
    np.testing.assert_allclose(cloud.confidence[cloud.kf_id == 2], 0.7 * whole.confidence[whole.kf_id == 2], rtol=1e-4)


def test_points_nobody_has_measured_are_pruned(scene: Any) -> None:
    graph = tracked_graph(scene, set())
    for b in graph.variables.values():
        b.depth_info, b.prior_info = np.zeros(len(b.px)), np.full(len(b.px), 1e-6)
    colors, moving = cloud_inputs(graph, scene)
    assert len(static_cloud(graph, colors, moving).points_world) == 0
    empty = static_cloud(graph, {}, {})
    assert empty.points_world.shape == (0, 3) and empty.kf_id.dtype == np.int32


def test_finishing_improves_disturbed_keyframes(scene: Any) -> None:
    graph = tracked_graph(scene, set())
    for i, a in enumerate(KEYFRAMES):
        for j, b in enumerate(KEYFRAMES):
            if i != j:
                graph.connect(i, j, scene.matches(a, b, 0.2), np.ones(len(scene.px)))
    rng = np.random.default_rng(1)
    for k in (1, 2):
        graph.variables[k].cam_from_world = se3_exp(rng.normal(0, 0.02, 6)) @ graph.variables[k].cam_from_world
    for b in graph.variables.values():
        b.depth_info = np.zeros(0)
        b.prior_info = np.full(len(b.px), 1e-2)
    config = replace(Config(), graph=replace(GraphConfig(), final_iterations=30))
    finish_graph(graph, config)
    report = graph.last_report
    assert report is not None and report.cost_last <= report.cost_first
    turn = se3_log(graph.world_from_cam(2) @ inverse(world_from(scene, 12)))[3:]
    assert np.linalg.norm(turn) < 0.01
    np.testing.assert_allclose(graph.world_from_cam(0), np.eye(4), atol=1e-12)


def beside_a_moving_thing(seed: int) -> tuple[StaticMatches, Array]:
    """Matches (320,) of a scene about a unit away and of something that moves, of whose depths nothing is known; pose.

    Along an epipolar line whatever moves is a point of some depth, so it draws the lines its own way.
    """
    rng, camera = np.random.default_rng(seed), Camera(226.0, 226.0, 119.5, 89.5, 240, 180)
    px, inv_depth = rng.uniform([10, 10], [230, 170], (320, 2)), rng.uniform(0.98, 1.2, 320)
    pose = se3_exp(np.r_[rng.normal(0, 0.012, 3) * [1, 1, 0.5], rng.normal(0, 0.006, 3)])
    relative = np.exp(rng.uniform(np.log(0.01), np.log(0.1), 320))
    count, moved_px = int(rng.integers(16, 50)), rng.uniform(8, 20)
    middle = rng.uniform([30, 30], [210, 150])
    thing, angle = np.argsort(np.linalg.norm(px - middle, axis=1))[:count], rng.uniform(0, 6.28)
    target = camera.project(transform(pose, camera.unproject(px, inv_depth))) + rng.normal(0, 0.05, (320, 2))
    target[thing] += moved_px * np.array([np.cos(angle), np.sin(angle)])
    target[thing] += 0.06 * (px[thing] - middle) @ rng.normal(0, 1, (2, 2))
    known = inv_depth * (1 + rng.normal(0, 1, 320) * relative)
    relative[thing] = 26.0
    weight = np.where(np.isin(np.arange(320), thing), 0.7, 0.8)
    lens = np.array([np.log(226.0), 0, 119.5, 89.5, 0, 0])
    return StaticMatches(px, known, 1 / (relative * inv_depth) ** 2, target, weight, lens), pose


@pytest.mark.parametrize("seed", [2731, 2777, 2778, 3994, 4803, 4998])
def test_a_frame_beside_something_that_moves_takes_the_minimum_that_fits_most(
    seed: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """One way down ends several times as far from the truth as the better of two."""
    matches, truth = beside_a_moving_thing(seed)
    monkeypatch.setattr(final_solve, "kept_matches", lambda *_: matches)
    record = FrameRecord(0, 0.0, 0, np.eye(4), "tracked", np.arange(320), matches.target, matches.weight)
    graph = KeyframeGraph(GraphConfig(), intrinsics_for(CameraConfig(), 240, 180, (240, 180)))
    found = final_solve._refined(graph, record, np.eye(4))
    one_way = np.eye(4)
    for kernel_px in (3.0, 1.0):
        one_way = solve_pose(matches, one_way, kernel_px=kernel_px).new_from_ref
    error, error_one_way = (float(np.linalg.norm((p - truth)[:3, 3])) for p in (found, one_way))
    assert error < 0.005 < error_one_way and error < 0.3 * error_one_way


@pytest.mark.parametrize("to", [20.0, 500.0])
def test_a_pose_that_no_camera_can_have_come_to_is_lost(exact_scene: Callable[..., Any], to: float) -> None:
    """Two frames out and back: 20 depths is far, 500 is where nothing that is matched can put them."""
    scene = exact_scene(13)
    graph = tracked_graph(scene, lost=set())
    depth = 1 / float(np.median([graph.median_inv_depth(k) for k in graph.variables]))
    frames = final_frames(graph)
    for n in (7, 8):
        pose = frames[n].world_from_cam.copy()
        pose[:3, 3] += [0.0, to * depth, 0.1 * n]
        frames[n] = replace(frames[n], world_from_cam=pose)
    out = final_solve._without_leaps(graph, frames)
    assert [n for n, f in enumerate(out) if f.state == "lost"] == ([7, 8] if to > 100 else [])
    tail = [
        replace(f, world_from_cam=f.world_from_cam + np.pad([[9e3 * depth]] * 3, ((0, 1), (3, 0)))) for f in frames[9:]
    ]
    both = final_solve._without_leaps(graph, [*out[:9], *tail])
    assert {n for n, f in enumerate(both) if f.state == "lost"} >= {9, 10, 11, 12}
