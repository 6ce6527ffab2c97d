"""Keyframes that next to nothing holds: what they are, and what comes of them."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from mastd3r.geometry.se3 import se3_exp
from mastd3r.geometry.sim3 import Sim3
from mastd3r.graph.keyframe_graph import KeyframeGraph
from mastd3r.graph.loose import FIRM, firm_parts, firm_weight, leave_loose, loose_parts
from mastd3r.graph.submaps import join
from test_submaps import SCALE, VIEWS, cut_graph


@pytest.fixture(scope="module")
def scene(exact_scene: Callable[..., Any]) -> Any:
    return exact_scene(VIEWS, step=0.08, cell_px=10)


def whole(scene: Any) -> KeyframeGraph:
    """One submap of all keyframes, of which nothing holds 4 to 5."""
    graph = cut_graph(scene)
    join(graph, 3, 6, Sim3.from_rigid(scene.j_from_i(3, 6)).in_lengths(1 / SCALE))
    return graph


def linked(graph: KeyframeGraph, scene: Any, i: int, j: int, count: int) -> None:
    """Matches of i in j, ``count`` of which weigh 1."""
    matches = scene.matches(i, j)
    first = np.cumsum(matches.weight > 0) <= count
    assert graph.connect(i, j, matches, (first & (matches.weight > 0)).astype(float), followed=True)


def pairs(*of: tuple[int, int, float]) -> dict[frozenset[int], float]:
    return {frozenset((i, j)): w for i, j, w in of}


def test_parts_that_are_held_weakly_to_many_are_held() -> None:
    half = FIRM / 2
    assert firm_parts(range(3), {}) == [frozenset({0}), frozenset({1}), frozenset({2})]
    chain = pairs((0, 1, FIRM), (1, 2, half))
    assert sorted(map(sorted, firm_parts(range(3), chain))) == [[0, 1], [2]]
    assert firm_parts(range(3), chain | pairs((0, 2, half))) == [frozenset({0, 1, 2})]
    assert len(firm_parts([0, 2], chain)) == 2  # what is not asked about joins nothing


def test_a_link_is_firm_by_what_links_weigh_in_this_video() -> None:
    assert firm_weight({}) == FIRM == firm_weight(pairs((0, 1, 400.0), (1, 2, 300.0), (0, 2, 3.0)))
    assert firm_weight(pairs((0, 1, 40.0), (1, 2, 36.0), (0, 2, 1.0))) == pytest.approx(10.0)


def test_what_is_held_firmly_stays(scene: Any) -> None:
    graph = whole(scene)
    linked(graph, scene, 4, 5, int(FIRM))
    assert loose_parts(graph) == [] and leave_loose(graph) == 0 and len(graph.keyframes) == VIEWS


@pytest.mark.parametrize("gone", [0, 4, VIEWS - 1])
def test_a_keyframe_that_hangs_by_a_thread_is_forgotten_and_its_frame_lost(scene: Any, gone: int) -> None:
    graph = whole(scene)
    graph.edges = [e for e in graph.edges if gone not in (e.i, e.j)]
    linked(graph, scene, gone - 1 if gone else 1, gone, int(FIRM) - 5)
    for i, j in ((3, 6), (6, 3), (4, 5)):
        if gone not in (i, j):
            linked(graph, scene, i, j, 200)
    assert loose_parts(graph) == [[gone]]
    poses = {kf.work.index: graph.variables[kf.id].cam_from_world for kf in graph.keyframes}
    assert leave_loose(graph) == 1
    assert [kf.id for kf in graph.keyframes] == list(range(VIEWS - 1)) == sorted(graph.variables)
    assert gone not in [kf.work.index for kf in graph.keyframes]
    for kf in graph.keyframes:
        assert graph.variables[kf.id].cam_from_world is poses[kf.work.index]
    states = {r.index: r.state for r in graph.records if r.index < 100}
    assert [k for k, state in states.items() if state == "lost"] == [gone]


def test_matches_that_do_not_agree_hold_nothing(scene: Any) -> None:
    """A keyframe that flew away, though many matches were found."""
    graph = whole(scene)
    linked(graph, scene, 4, 5, 200)
    assert loose_parts(graph) == []
    far = graph.variables[VIEWS - 1].cam_from_world
    graph.set_keyframe_pose(VIEWS - 1, se3_exp(np.array([0.5, 0, 0, 0, 0, 0])) @ far)
    assert loose_parts(graph) == [[VIEWS - 1]]


def test_a_part_that_others_hang_on_stays_for_as_long_as_they_do(scene: Any) -> None:
    """4 is held by threads on both sides, and nothing else holds the first keyframes to the last."""
    graph = whole(scene)
    graph.edges = [e for e in graph.edges if 4 not in (e.i, e.j)]
    linked(graph, scene, 3, 4, 20)
    linked(graph, scene, 4, 5, 20)
    assert loose_parts(graph) == [[0, 1, 2, 3], [4]]
    graph.held = 4
    assert loose_parts(graph) == []


def test_a_large_part_becomes_a_piece_of_its_own(scene: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("mastd3r.graph.loose.FEW", 3)
    graph = whole(scene)
    linked(graph, scene, 4, 5, 20)
    first = [graph.variables[k].cam_from_world for k in range(5)]
    assert leave_loose(graph) == 5
    assert len(graph.keyframes) == VIEWS and graph.started == {0, 1} and graph.submap == 0
    assert {len(graph.members(0)), len(graph.members(1))} == {5}
    assert all(graph.variables[k].cam_from_world is pose for k, pose in enumerate(first))


def test_what_has_a_part_of_a_saved_map_stays(scene: Any) -> None:
    graph = whole(scene)
    graph.edges = [e for e in graph.edges if 0 not in (e.i, e.j)]
    linked(graph, scene, 0, 1, 20)
    linked(graph, scene, 4, 5, 200)
    assert loose_parts(graph) == [[0]]
    graph.held = 1
    assert loose_parts(graph) == []
