"""A saved map in the graph: it stays where it is, a video is joined to it, or leaves it behind."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from mastd3r.config import CameraConfig, GraphConfig
from mastd3r.geometry.se3 import inverse, se3_exp
from mastd3r.geometry.sim3 import Sim3
from mastd3r.graph.bridging import bridge_submaps
from mastd3r.graph.intrinsics import intrinsics_for
from mastd3r.graph.keyframe_graph import KeyframeGraph
from mastd3r.graph.pose_graph import Loop, optimise_pose_graph
from mastd3r.graph.submaps import join

Array = NDArray[Any]


def held_graph(scene: Any, held: int, video_from_map: Array) -> KeyframeGraph:
    """Keyframes 0 … held of a map, the rest of a video that has a world of its own; edges within each."""
    size = (scene.width, scene.height)
    graph = KeyframeGraph(GraphConfig(), intrinsics_for(CameraConfig(), *size, size))
    graph.intrinsics.values, graph.intrinsics.prior = scene.lens.copy(), scene.lens.copy()
    ones = np.ones(len(scene.px))
    for k in range(len(scene.cam_from_world)):
        pose = scene.cam_from_world[k] if k < held else scene.cam_from_world[k] @ inverse(video_from_map)
        if k == held:
            graph.hold()
            graph.start_submap()
        work, moving = scene.work_frame(k), np.zeros((scene.height, scene.width))
        inv_depth = 1 / scene.depth(k)
        graph.add_keyframe(work, ones, moving, pose, inv_depth, 1e-2 / inv_depth**2)
        graph.variables[k].depth_info = 1e6 / inv_depth**2
        if k >= held:
            graph.record(work, k, np.eye(4), "tracked", None, np.zeros(0))
            graph.replace_last_by_keyframe(graph.latest)
    graph.started.add(graph.submap)
    for i in range(len(graph.keyframes) - 1):
        if i != held - 1:
            graph.connect(i, i + 1, scene.matches(i, i + 1), ones)
            graph.connect(i + 1, i, scene.matches(i + 1, i), ones)
    return graph


@pytest.fixture(scope="module")
def scene(exact_scene: Callable[..., Any]) -> Any:
    return exact_scene(6, step=0.08, cell_px=10)


AWAY = se3_exp(np.array([0.4, -0.7, 1.1, 0.5, -0.8, 0.3]))


@pytest.mark.parametrize("ends", [(1, 4), (4, 1)])
def test_a_map_stays_where_it_is_whichever_is_joined_to_which(scene: Any, ends: tuple[int, int]) -> None:
    graph = held_graph(scene, 3, AWAY)
    i, j = ends
    join(graph, i, j, Sim3.from_rigid(scene.j_from_i(i, j)))
    for k in range(6):
        np.testing.assert_allclose(graph.variables[k].cam_from_world, scene.cam_from_world[k], atol=1e-9)
    assert graph.members(0) == list(range(6)) and graph.free_members() == [3, 4, 5] and graph.started == {0}
    assert graph.found_at == graph.records[-1].index


def test_solving_and_closing_loops_moves_the_video_alone(scene: Any) -> None:
    graph = held_graph(scene, 3, np.eye(4))
    join(graph, 1, 4, Sim3.from_rigid(scene.j_from_i(1, 4)))
    graph.connect(2, 3, scene.matches(2, 3), np.ones(len(scene.px)))
    step = se3_exp(np.array([0.05, 0.02, -0.03, 0.02, -0.03, 0.01]))
    for k in (3, 4, 5):
        graph.set_keyframe_pose(k, step @ graph.variables[k].cam_from_world)
    drifted = graph.variables[5].cam_from_world.copy()
    optimise_pose_graph(graph, [Loop(0, 5, Sim3.from_rigid(scene.j_from_i(0, 5)), 500.0)])
    assert np.abs(graph.variables[5].cam_from_world - drifted).max() > 0.01
    graph.solve_all(30, 1.0)
    for k in range(6):
        np.testing.assert_allclose(
            graph.variables[k].cam_from_world, scene.cam_from_world[k], atol=1e-12 if k < 3 else 2e-3
        )


def test_a_map_in_which_nothing_was_found_leaves_nothing(scene: Any) -> None:
    graph, alone = held_graph(scene, 3, AWAY), held_graph(scene, 3, AWAY)
    graph.leave_map_unless_found()
    assert (
        graph.held == 0 and graph.started == {1} and graph.members() == [0, 1, 2] == [kf.id for kf in graph.keyframes]
    )
    assert {(e.i, e.j) for e in graph.edges} == {(0, 1), (1, 0), (1, 2), (2, 1)}
    assert [r.kf_id for r in graph.records] == [0, 1, 2] and sorted(graph.variables) == [0, 1, 2]
    assert graph.solve_all(1, 1.0).cost_first < 1e-3
    alone.found_in_map(7)
    alone.leave_map_unless_found()
    assert alone.held == 3 and len(alone.keyframes) == 6 and alone.found_at == 7


def test_what_came_before_the_map_is_placed_backwards(scene: Any) -> None:
    """A video begins elsewhere and then moves steadily in the map: it came from where it would have been."""
    graph = held_graph(scene, 3, AWAY)
    graph.found_in_map(0)
    for n, k in enumerate((2, 1, 0)):  # frames that hang on the map, after the three of the video's own
        work = replace(scene.work_frame(k), index=10 + n, timestamp_s=(6 + n) / 30)
        graph.record(work, k, np.eye(4), "tracked", None, np.zeros(0))
    for n, record in enumerate(graph.records):
        record.timestamp_s = n / 30
    now, then = scene.cam_from_world[2], scene.cam_from_world[0]
    assert bridge_submaps(graph) == [(graph.records[0].index, graph.records[2].index)]
    assert {r.state for r in graph.records[:3]} == {"interpolated"} and graph.members(0) == list(range(6))
    expected = now @ inverse(then) @ now  # two frames of motion over 2/30 s, one is 1/30 s ahead: half of it
    found = graph.variables[5].cam_from_world
    half = np.linalg.norm((found @ inverse(now))[:3, 3]) / np.linalg.norm((expected @ inverse(now))[:3, 3])
    assert half == pytest.approx(0.5, rel=0.05)
