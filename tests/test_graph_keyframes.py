"""The keyframe graph: start from nothing, scale, lens, dense depths, what sees the same place."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from mastd3r.camera.pinhole import Camera
from mastd3r.config import CameraConfig, GraphConfig
from mastd3r.geometry.anchor_matches import AnchorMatches
from mastd3r.geometry.reprojection_kernels import anchor_cost
from mastd3r.geometry.se3 import inverse, se3_exp
from mastd3r.graph.covisibility import covisible, nearest_keyframe, overlap
from mastd3r.graph.depth import carried, depth_confidence, inpainted, upsampled
from mastd3r.graph.intrinsics import intrinsics_for
from mastd3r.graph.keyframe_graph import KeyframeGraph
from mastd3r.graph.place_recognition import PlaceRecognition, build_thumbnail
from mastd3r.graph.prediction import rigid_flow
from mastd3r.sources.synthetic import SyntheticView
from mastd3r.types import Matches

Array = NDArray[Any]


def graph_of(
    scene: Any, views: int, *, noise_px: float = 0.0, solved: bool = False, camera: CameraConfig | None = None
) -> KeyframeGraph:
    """A graph with matches between all views; ``solved``: with true poses and depths, otherwise with none."""
    camera = camera or CameraConfig()
    size = (scene.width, scene.height)
    graph = KeyframeGraph(GraphConfig(), intrinsics_for(camera, *size, size))
    p = len(scene.px)
    nothing_moves = np.zeros((scene.height, scene.width))
    for k in range(views):
        pose = scene.cam_from_world[k] @ inverse(scene.cam_from_world[0]) if solved else np.eye(4)
        depth = 1 / scene.depth(k) if solved else np.ones(p)
        graph.add_keyframe(scene.work_frame(k), np.ones(p), nothing_moves, pose, depth, np.full(p, 1e-2))
    for i in range(views):
        for j in range(views):
            if i != j:
                graph.connect(i, j, scene.matches(i, j, noise_px), np.ones(p))
    if solved:
        graph.intrinsics.values = scene.lens.copy()
        graph.started.add(0)
        for k in range(views):
            graph.variables[k].depth_info = np.full(p, 1e4)
    return graph


def costs(graph: KeyframeGraph) -> Array:
    out = []
    for e in graph.edges:
        a, b = graph.variables[e.i], graph.variables[e.j]
        j_from_i = (b.cam_from_world @ inverse(a.cam_from_world))[None]
        matches = AnchorMatches.of([e.target], [e.weight])
        out.append(anchor_cost(a.px, a.inv_depth, matches, j_from_i, graph.intrinsics.values, 1.0)[0])
    return np.array(out)


def test_a_window_moves_only_what_it_may(exact_scene: Callable[..., Any]) -> None:
    scene = exact_scene(6, step=0.12)
    graph = graph_of(scene, 6, noise_px=0.2, solved=True)
    graph.config = replace(graph.config, window=3)
    rng = np.random.default_rng(0)
    for k in (4, 5):
        graph.variables[k].cam_from_world = se3_exp(rng.normal(0, 0.01, 6)) @ graph.variables[k].cam_from_world
    before = {k: b.cam_from_world.copy() for k, b in graph.variables.items()}
    disturbed = costs(graph).sum()
    graph.solve_window()
    for k in range(4):
        assert (graph.variables[k].cam_from_world == before[k]).all()
    assert costs(graph).sum() < 0.5 * disturbed


def test_normalise_changes_the_unit_and_nothing_else(exact_scene: Callable[..., Any]) -> None:
    scene = exact_scene(4, step=0.2)
    graph = graph_of(scene, 4, noise_px=0.3, solved=True)
    frame = scene.work_frame(3)
    motion = se3_exp(np.array([0.1, 0.2, 0.3, 0.1, 0, 0]))
    graph.record(frame, 3, motion, "tracked", scene.matches(2, 3), np.ones(len(scene.px)))
    before, depth, info = costs(graph), graph.variables[1].inv_depth, graph.depth_info(1)
    graph.normalise()
    np.testing.assert_allclose(costs(graph), before, rtol=1e-9)
    ratio = depth[0] / graph.variables[1].inv_depth[0]
    assert ratio != pytest.approx(1.0, abs=0.01)
    np.testing.assert_allclose(graph.variables[1].inv_depth * ratio, depth)
    np.testing.assert_allclose(graph.depth_info(1), info * ratio**2)
    np.testing.assert_allclose(graph.records[0].cam_from_kf[:3, 3], ratio * motion[:3, 3])
    np.testing.assert_allclose(graph.records[0].cam_from_kf[:3, :3], motion[:3, :3])
    np.testing.assert_allclose(np.median([graph.median_inv_depth(k) for k in range(3)]), 1.0)
    again = graph.variables[1].inv_depth.copy()
    graph.normalise()
    np.testing.assert_allclose(graph.variables[1].inv_depth, again)


def test_measured_depths_keep_their_unit(exact_scene: Callable[..., Any]) -> None:
    scene = exact_scene(4, step=0.2)
    graph = graph_of(scene, 4, solved=True)
    for b in graph.variables.values():
        b.prior_info = 1 / (0.02 * b.inv_depth) ** 2
    depth = graph.variables[0].inv_depth.copy()
    graph.normalise()
    np.testing.assert_array_equal(graph.variables[0].inv_depth, depth)


def test_few_matches_make_no_edge(exact_scene: Callable[..., Any]) -> None:
    scene = exact_scene(2, step=0.2)
    graph = graph_of(scene, 2)
    m = scene.matches(0, 1)
    assert graph.connect(0, 1, m, np.ones(len(scene.px)))
    kept = len(graph.edges)
    few = replace(m, weight=m.weight * (np.arange(len(scene.px)) < 15))
    assert not graph.connect(0, 1, few, np.ones(len(scene.px)))
    assert not graph.connect(0, 1, m, np.zeros(len(scene.px)))  # everything there moves
    assert len(graph.edges) == kept


def test_the_way_that_was_tracked_is_an_edge_with_few_matches(exact_scene: Callable[..., Any]) -> None:
    """A tenth of the matches is too few for a pair that may be wrong, and enough to hold a chain together."""
    scene = exact_scene(2, step=0.2)
    graph = graph_of(scene, 2)
    graph.edges.clear()
    graph.config = GraphConfig(min_match_ratio=0.2)
    m, p = scene.matches(0, 1), len(scene.px)
    few = replace(m, weight=np.where(np.arange(p) < 0.1 * p, 1.0, 0.0))
    assert not graph.connect(0, 1, few, np.ones(p)) and not graph.edges
    assert graph.connect(0, 1, few, np.ones(p), followed=True) and graph.connected(0, 1)
    none = replace(m, weight=np.where(np.arange(p) < 15, 1.0, 0.0))
    assert not graph.connect(0, 1, none, np.ones(p), followed=True)


def test_a_record_keeps_the_strongest_matches(exact_scene: Callable[..., Any]) -> None:
    scene = exact_scene(2, step=0.2, cell_px=8)
    graph = graph_of(scene, 2)
    p = len(scene.px)
    weight = np.random.default_rng(0).uniform(0, 1, p)
    entry = graph.record(scene.work_frame(1), 0, np.eye(4), "tracked", scene.matches(0, 1), weight)
    assert len(entry.points) == 600 < p
    assert weight[entry.points].min() >= np.sort(weight)[-600] - 1e-12
    assert (np.diff(entry.points) > 0).all()
    np.testing.assert_allclose(entry.target, scene.matches(0, 1).new_px[entry.points], atol=1e-4)


@pytest.mark.parametrize(
    ("views", "window", "everything"),
    [(6, (0,), (0, 1)), (7, (0,), (0, 1)), (8, (0, 1), (0, 1)), (11, (0, 1, 2, 3, 4, 5), (0, 1, 2, 3, 4, 5))],
)
def test_the_lens_is_freed_as_views_come(
    exact_scene: Callable[..., Any], views: int, window: tuple[int, ...], everything: tuple[int, ...]
) -> None:
    """Focal length first; the first radial term with everything, or from ``radial_keyframes``; then the rest."""
    scene = exact_scene(views, step=0.02, cell_px=60)
    graph = graph_of(scene, views, noise_px=0.3, solved=True)
    graph.config = replace(graph.config, radial_keyframes=8, lens_keyframes=11)
    before = graph.intrinsics.values.copy()
    graph.solve_window()
    np.testing.assert_array_equal(np.flatnonzero(graph.intrinsics.values != before), window)
    graph.intrinsics.values = before.copy()
    graph.solve_all(2, 1.0)
    np.testing.assert_array_equal(np.flatnonzero(graph.intrinsics.values != before), everything)


@pytest.mark.parametrize("k", [0.0, -0.05])
def test_predicted_flow_is_the_projection_of_the_scene(exact_scene: Callable[..., Any], k: float) -> None:
    scene = exact_scene(2, step=0.2, k=k, cell_px=10)
    graph = graph_of(scene, 2, solved=True)
    flow = rigid_flow(graph, 0, 1)
    assert flow.shape == (240, 320, 2)
    matches = scene.matches(0, 1)
    at = np.round(scene.px).astype(int)
    error = np.linalg.norm(flow[at[:, 1], at[:, 0]] - (matches.new_px - scene.px), axis=1)
    moved = np.linalg.norm(matches.new_px - scene.px, axis=1)
    assert np.median(error) < 0.1 * np.median(moved)
    away = graph.variables[1].cam_from_world.copy()
    away[2, 3] -= 30  # everything is behind the second camera
    graph.variables[1].cam_from_world = away
    assert np.isfinite(rigid_flow(graph, 0, 1)).all() and np.abs(rigid_flow(graph, 0, 1)).max() <= 640


# -- dense depths ------------------------------------------------------------------------------------------------

CAMERA = Camera.centred(260.0, 320, 240)
PLANE = np.array([0.08, -0.05, 0.4])  # inverse depth = PLANE . ray, exactly linear over the image


def plane_at(px: Array) -> Array:
    return CAMERA.rays(px) @ PLANE


def test_confidence_is_half_at_a_tenth() -> None:
    depth = np.array([0.5, 2.0])
    np.testing.assert_allclose(depth_confidence(depth, 1 / (0.1 * depth) ** 2), 0.5)
    assert depth_confidence(depth, np.full(2, 1e9)).min() > 0.99 and depth_confidence(depth, np.zeros(2)).max() < 1e-9


def test_inpainting_keeps_what_is_known_and_bridges_the_rest(exact_scene: Callable[..., Any]) -> None:
    scene = exact_scene(1)
    truth = plane_at(scene.px)
    rng = np.random.default_rng(0)
    known = rng.random(len(truth)) < 0.6
    info = np.where(known, 1e8, 1e-6)
    found = inpainted(np.where(known, truth, 7.0), info, scene.grid)
    np.testing.assert_allclose(found[known], truth[known], rtol=1e-3)
    assert np.median(np.abs(found[~known] / truth[~known] - 1)) < 0.02
    assert np.abs(found / truth - 1).max() < 0.15


def test_upsampling_keeps_a_plane_and_the_size() -> None:
    width, height, cell = 325, 247, 10  # a partial last row and column of cells
    rows, cols = height // cell, width // cell
    cy, cx = np.divmod(np.arange(rows * cols), cols)
    centres = (np.stack([cx, cy], 1) + 0.5) * cell - 0.5
    dense = upsampled(centres @ [0.01, -0.02] + 9, (rows, cols), width, height)
    assert dense.shape == (height, width) and dense.dtype == np.float32
    y, x = np.mgrid[5:235:7, 5:315:7]
    np.testing.assert_allclose(dense[y, x], x * 0.01 - y * 0.02 + 9, atol=1e-4)


def test_carrying_a_plane_into_another_view(exact_scene: Callable[..., Any]) -> None:
    scene = exact_scene(1, cell_px=10)
    motion = se3_exp(np.array([0.1, -0.05, 0.08, 0.02, -0.03, 0.05]))
    at = np.random.default_rng(1).uniform(30, [290, 210], (80, 2))
    # in the new view: n . (R' (X - t)) = 1  ->  inverse depth = (R n) . ray / (1 + (R n) . t)
    n = motion[:3, :3] @ PLANE
    truth = CAMERA.rays(at) @ n / (1 + n @ motion[:3, 3])
    args = (scene.px, plane_at(scene.px))
    value, confidence = carried(*args, np.full(len(scene.px), 1e6), motion, CAMERA, at)
    assert np.median(np.abs(value / truth - 1)) < 0.01 and np.abs(value / truth - 1).max() < 0.05
    assert np.median(confidence) > 0.8
    away = carried(*args, np.full(len(scene.px), 1e6), motion, CAMERA, at + np.array([600, 0]))[1]
    assert away.max() < 0.01
    _, unknown = carried(*args, np.zeros(len(scene.px)), motion, CAMERA, at)
    assert (unknown == 0).all()
    behind = motion.copy()
    behind[2, 3] = -20
    assert (carried(*args, np.full(len(scene.px), 1e6), behind, CAMERA, at)[1] == 0).all()


# -- places --------------------------------------------------------------------------------------------------------


def test_overlap_falls_with_the_distance(exact_scene: Callable[..., Any]) -> None:
    scene = exact_scene(6, step=0.3)
    graph = graph_of(scene, 6, solved=True)
    share, motion = overlap(graph, 2, graph.variables[2].cam_from_world)
    assert share == 1.0 and motion == pytest.approx(0, abs=1e-9)
    shares, motions = zip(*(overlap(graph, 0, graph.variables[k].cam_from_world) for k in range(4)), strict=True)
    assert list(shares) == sorted(shares, reverse=True) and list(motions) == sorted(motions)
    turned_away = se3_exp(np.array([0, 0, 0, 0, np.pi, 0]))
    assert overlap(graph, 0, turned_away) == (0.0, float("inf"))


def test_covisible_takes_the_nearest_and_no_neighbours(exact_scene: Callable[..., Any]) -> None:
    scene = exact_scene(9, step=0.04)
    graph = graph_of(scene, 9, solved=True)
    graph.variables[8].cam_from_world = graph.variables[3].cam_from_world.copy()  # the camera came back
    assert covisible(graph, 8, 7, 4, 0.5) == [3, 1, 5] or covisible(graph, 8, 7, 4, 0.5) == [3, 5, 1]
    assert covisible(graph, 8, 7, 1, 0.5) == [3]
    assert covisible(graph, 8, 2, 4, 0.5)[0] == 1
    graph.variables[8].cam_from_world = se3_exp(np.array([0, 0, 0, 0, np.pi, 0]))
    assert covisible(graph, 8, 7, 4, 0.5) == []


def test_nearest_keyframe_is_the_one_with_the_least_motion(exact_scene: Callable[..., Any]) -> None:
    scene = exact_scene(9, step=0.05)
    graph = graph_of(scene, 9, solved=True)
    pose = scene.cam_from_world[2] @ inverse(scene.cam_from_world[0])  # the camera is back at view 2
    assert nearest_keyframe(graph, pose, 8, 0.8, 0.06) == 2
    second = nearest_keyframe(graph, pose, 2, 0.8, 0.06)
    assert second in (1, 3)
    assert nearest_keyframe(graph, pose, 2, 0.8, 1e-4) is None  # none is that near
    graph.submap_of[2] = 7  # of a submap that is not being tracked
    assert nearest_keyframe(graph, pose, 8, 0.8, 0.06) == second
    assert nearest_keyframe(graph, se3_exp(np.array([0, 0, 0, 0, np.pi, 0])), 8, 0.8, 0.06) is None


def test_places_know_a_picture_again(exact_scene: Callable[..., Any], room_views: list[SyntheticView]) -> None:
    scene = exact_scene(4)
    graph = KeyframeGraph(GraphConfig(), intrinsics_for(CameraConfig(), 160, 120, (160, 120)))
    grays = [v.frame.image[..., 1] for v in room_views[:2]] + [room_views[0].frame.image[:, ::-1, 1]]
    p = len(scene.px)
    for k, gray in enumerate(grays):
        work = replace(scene.work_frame(k), gray=np.ascontiguousarray(gray))
        graph.add_keyframe(work, np.ones(p), np.zeros(gray.shape), np.eye(4), np.ones(p), np.ones(p))
    index = PlaceRecognition(build_thumbnail(None))
    first, third = (graph.keyframes[k].work for k in (0, 2))
    like_first = replace(first, gray=np.clip(grays[0].astype(int) + 20, 0, 255).astype(np.uint8))  # brighter
    assert index.best(graph, like_first, [0, 1, 2])[0].id == 0
    assert index.best(graph, third, [0, 1, 2])[0].id == 2
    assert [kf.id for kf in index.best(graph, like_first, [1, 2], count=1)] == [1]
    assert len(index.best(graph, like_first, [0, 1, 2], count=2)) == 2
    assert index.best(graph, like_first, []) == []


def test_places_are_of_the_keyframes_there_are_now(
    exact_scene: Callable[..., Any], room_views: list[SyntheticView]
) -> None:
    """A number that was given to another keyframe after a submap was dropped is looked at anew."""
    scene = exact_scene(2)
    graph = KeyframeGraph(GraphConfig(), intrinsics_for(CameraConfig(), 160, 120, (160, 120)))
    gray = room_views[0].frame.image[..., 1]
    p = len(scene.px)
    index = PlaceRecognition(build_thumbnail(None))
    for n, images in enumerate(([gray, 255 - gray], [255 - gray, gray])):
        for k, image in enumerate(images):
            work = replace(scene.work_frame(2 * n + k), gray=np.ascontiguousarray(image))
            graph.add_keyframe(work, np.ones(p), np.zeros(gray.shape), np.eye(4), np.ones(p), np.ones(p))
        assert index.best(graph, replace(work, gray=np.ascontiguousarray(gray)), [0, 1])[0].id == n
        graph.drop_submap()


def test_dropping_the_only_submap_leaves_lost_frames(exact_scene: Callable[..., Any]) -> None:
    scene = exact_scene(2)
    graph = graph_of(scene, 2)
    none = Matches(scene.px, scene.px, np.zeros(len(scene.px)))
    graph.record(scene.work_frame(0), 0, np.eye(4), "tracked", none, none.weight)
    graph.drop_submap()
    assert [r.state for r in graph.records] == ["lost"] and graph.keyframes == [] and graph.edges == []
    assert graph.variables == {} and graph.submap_of == {} and not graph.initialised
