"""Pieces that others see and that have no scale: they are dropped, and their frames are lost."""

from __future__ import annotations

from collections.abc import Callable
from types import SimpleNamespace
from typing import Any

import pytest

from mastd3r.graph.keyframe_graph import KeyframeGraph
from mastd3r.tracking.joining import give_up_unscaled
from test_submaps import CUT, VIEWS, cut_graph


@pytest.fixture(scope="module")
def scene(exact_scene: Callable[..., Any]) -> Any:
    return exact_scene(VIEWS, step=0.08, cell_px=10)


def seen_from(graph: KeyframeGraph, *anchors: int) -> list[Any]:
    """Views of a piece from these keyframes."""
    return [SimpleNamespace(anchor=graph.keyframes[k]) for k in anchors]


def test_dropping_a_submap_before_others_numbers_their_keyframes_anew(scene: Any) -> None:
    graph = cut_graph(scene)
    poses = [graph.variables[k].cam_from_world for k in graph.members(1)]
    graph.drop_submap(0)
    assert [kf.id for kf in graph.keyframes] == list(range(VIEWS - CUT)) == graph.members(1) == sorted(graph.variables)
    assert all(graph.variables[k].cam_from_world is pose for k, pose in enumerate(poses)) and graph.started == {1}
    assert graph.edges and all(min(e.i, e.j) >= 0 and max(e.i, e.j) < VIEWS - CUT for e in graph.edges)
    for r in graph.records:
        assert (r.state == "lost") == (r.index < CUT or r.index == 102)
        assert not r.is_keyframe or graph.keyframes[r.kf_id].work.index == r.index
        assert r.state == "lost" or graph.submap_of[r.kf_id] == 1


def test_a_piece_that_larger_ones_see_twice_is_given_up(scene: Any) -> None:
    graph = cut_graph(scene)
    assert not give_up_unscaled(graph, 1, seen_from(graph, 0, 2))  # as large as the other
    graph.start_submap()
    for k in (VIEWS - 2, VIEWS - 1):  # two keyframes of a piece of their own
        graph.submap_of[k] = graph.submap
    graph.started.add(graph.submap)
    assert not give_up_unscaled(graph, graph.submap, seen_from(graph, 0))
    assert not give_up_unscaled(graph, graph.submap, seen_from(graph, VIEWS - 1, VIEWS - 2))
    assert give_up_unscaled(graph, graph.submap, seen_from(graph, 0, 2))
    assert len(graph.keyframes) == VIEWS - 2 and [r.state for r in graph.records[-2:]] == ["lost", "lost"]
