"""Edges of a new keyframe, made beside tracking: taken at the same frame however long they took."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from mastd3r.graph.keyframe_graph import Keyframe, KeyframeGraph
from mastd3r.pointmap.geometric import GeometricPointmaps
from mastd3r.sources.synthetic import SyntheticView
from mastd3r.tracking.covisibility import CovisibilityEdges
from mastd3r.tracking.keyframes import EDGES_AFTER
from mastd3r.types import WorkFrame
from test_chain import turning_fast
from test_graph_keyframes import graph_of
from test_submaps import Played, play, views_of

Array = NDArray[Any]


@pytest.fixture(scope="module")
def room() -> list[SyntheticView]:
    return views_of(60)


def watched(monkeypatch: pytest.MonkeyPatch, wait_s: float) -> list[tuple[int, str]]:
    """What is connected from here on: (keyframe, thread's name). Each takes at least ``wait_s``."""
    seen: list[tuple[int, str]] = []
    connect = CovisibilityEdges.connect

    def slow(self: CovisibilityEdges, graph: KeyframeGraph, kf: Keyframe, before: int) -> KeyframeGraph:
        time.sleep(wait_s)
        seen.append((kf.id, threading.current_thread().name))
        return connect(self, graph, kf, before)

    monkeypatch.setattr(CovisibilityEdges, "connect", slow)
    return seen


def poses(run: Played) -> Array:
    return np.stack([f.world_from_cam for f in run.final])


@pytest.fixture(scope="module")
def quick_run(room: list[SyntheticView]) -> tuple[Played, list[tuple[int, str]]]:
    """The room, and what was connected. Read only."""
    with pytest.MonkeyPatch.context() as patch:
        quick = watched(patch, 0.0)
        return play(room), quick


def test_the_result_does_not_depend_on_how_long_edges_take(
    quick_run: tuple[Played, list[tuple[int, str]]], room: list[SyntheticView], monkeypatch: pytest.MonkeyPatch
) -> None:
    first, quick = quick_run
    slow = watched(monkeypatch, 0.4)
    second = play(room)
    assert quick == slow and sum(thread.startswith("edges") for _, thread in slow) >= 2
    np.testing.assert_array_equal(poses(first), poses(second))
    assert {(e.i, e.j) for e in first.slam.graph.edges} == {(e.i, e.j) for e in second.slam.graph.edges}


def test_where_keyframes_follow_one_another_they_are_connected_at_once(monkeypatch: pytest.MonkeyPatch) -> None:
    made_where = watched(monkeypatch, 0.0)
    run = play(views_of(36, turning_fast))
    made = {r.kf_id: r.index for r in run.slam.graph.records if r.is_keyframe}
    hurried = [
        thread for k, thread in made_where if made[k] - made[k - 1] < EDGES_AFTER and k >= run.slam.config.graph.window
    ]
    assert len(hurried) >= 4 and not any(thread.startswith("edges") for thread in hurried)


def test_a_provider_that_serves_one_at_a_time_is_asked_in_turn(
    room: list[SyntheticView], monkeypatch: pytest.MonkeyPatch
) -> None:
    threads, predict = set(), GeometricPointmaps.predict

    def noted(self: GeometricPointmaps, ref: WorkFrame, new: WorkFrame, guess: Any) -> Any:
        threads.add(threading.get_ident())
        return predict(self, ref, new, guess)

    monkeypatch.setattr(GeometricPointmaps, "predict", noted)
    monkeypatch.setattr(GeometricPointmaps, "side_by_side", False)
    made_where = watched(monkeypatch, 0.0)
    run = play(room[:40])
    assert len(made_where) >= 2 and threads == {threading.get_ident()}
    assert run.ate_ratio(np.ones(40, bool)) < 0.005


def test_many_pairs_at_once_are_the_pairs_one_by_one(
    quick_run: tuple[Played, list[tuple[int, str]]], monkeypatch: pytest.MonkeyPatch
) -> None:
    slam = quick_run[0].slam
    graph, edges = slam.graph.aside(), slam.keyframes.edges
    pairs, known = [(0, 4), (1, 6), (0, 7), (2, 5)], len(graph.edges)
    one_by_one = sum([edges.add(graph, i, j) for i, j in pairs])
    expected, graph.edges = graph.edges[known:], graph.edges[:known]
    for side_by_side in (True, False):
        monkeypatch.setattr(GeometricPointmaps, "side_by_side", side_by_side)
        assert edges.add_many(graph, pairs) == one_by_one >= 2
        made, graph.edges = graph.edges[known:], graph.edges[:known]
        assert [(e.i, e.j) for e in made] == [(e.i, e.j) for e in expected]
        for a, b in zip(made, expected, strict=True):
            np.testing.assert_array_equal(a.target, b.target)
            np.testing.assert_array_equal(a.weight, b.weight)


def test_a_graph_is_solved_aside_and_taken(exact_scene: Callable[..., Any]) -> None:
    graph = graph_of(exact_scene(6), 6, noise_px=0.2, solved=True)
    before = [b.cam_from_world.copy() for b in graph.variables.values()]
    depths, edges, g = graph.variables[5].inv_depth.copy(), len(graph.edges), graph.intrinsics.values.copy()
    aside = graph.aside()
    aside.edges.pop()
    aside.solve_window()
    assert all(np.array_equal(a, b.cam_from_world) for a, b in zip(before, graph.variables.values(), strict=True))
    assert np.array_equal(depths, graph.variables[5].inv_depth) and np.array_equal(g, graph.intrinsics.values)
    assert len(graph.edges) == edges
    graph.take(aside)
    assert len(graph.edges) == edges - 1 and not np.array_equal(depths, graph.variables[5].inv_depth)
    graph.add_keyframe(graph.keyframes[0].work, np.ones(1), np.zeros((2, 2)), np.eye(4), np.ones(1), np.ones(1))
    with pytest.raises(ValueError, match="expected a copy of 7 keyframes, got 6"):
        graph.take(aside)


def test_depths_are_found_under_poses_that_stay(exact_scene: Callable[..., Any]) -> None:
    scene = exact_scene(2)
    graph = graph_of(scene, 2, solved=True)
    graph.variables[1].inv_depth = 1.3 / scene.depth(1)
    graph.variables[1].prior_depth = graph.variables[1].inv_depth.copy()
    graph.variables[1].prior_info = np.full(len(scene.px), 1e-3)
    pose, other = graph.variables[1].cam_from_world.copy(), graph.variables[0].inv_depth.copy()
    graph.solve_depths(1, 10)
    seen = next(e for e in graph.edges if e.i == 1).weight > 0
    sure = seen & (graph.variables[1].depth_info / scene.depth(1) ** 2 > 30)
    assert sure.sum() > 100
    np.testing.assert_allclose(graph.variables[1].inv_depth[sure] * scene.depth(1)[sure], 1.0, atol=0.01)
    assert np.array_equal(pose, graph.variables[1].cam_from_world) and np.array_equal(
        other, graph.variables[0].inv_depth
    )
