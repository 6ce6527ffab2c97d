"""Pieces that others see and that have no scale: they are dropped, and their frames are lost."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import pytest

from mastd3r.config import Config
from mastd3r.graph.keyframe_graph import KeyframeGraph
from mastd3r.parts import build_parts
from mastd3r.tracking import keyframes as keyframes_module
from mastd3r.tracking.joining import give_up_unscaled
from mastd3r.tracking.keyframes import Keyframes
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


def with_a_small_piece(scene: Any) -> KeyframeGraph:
    """The last two keyframes are a piece of their own, the one that is tracked."""
    graph = cut_graph(scene)
    graph.start_submap()
    for k in (VIEWS - 2, VIEWS - 1):
        graph.submap_of[k] = graph.submap
    graph.started.add(graph.submap)
    return graph


def test_a_piece_that_larger_ones_see_twice_is_given_up(scene: Any) -> None:
    graph = cut_graph(scene)
    assert not give_up_unscaled(graph, 1, seen_from(graph, 0, 2))  # as large as the other
    graph = with_a_small_piece(scene)
    assert not give_up_unscaled(graph, graph.submap, seen_from(graph, 0))
    assert not give_up_unscaled(graph, graph.submap, seen_from(graph, VIEWS - 1, VIEWS - 2))
    assert give_up_unscaled(graph, graph.submap, seen_from(graph, 0, 2))
    assert len(graph.keyframes) == VIEWS - 2 and [r.state for r in graph.records[-2:]] == ["lost", "lost"]


def test_a_saved_map_that_was_not_entered_costs_no_piece(scene: Any) -> None:
    """Without it the video has its own world; a map has more keyframes than most."""
    graph = with_a_small_piece(scene)
    graph.held = CUT
    assert not give_up_unscaled(graph, graph.submap, seen_from(graph, 0, 2))
    assert len(graph.keyframes) == VIEWS


def test_what_cannot_be_joined_is_given_up_after_the_last_frame(scene: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    graph = with_a_small_piece(scene)

    def seen_without_scale(graph: KeyframeGraph, kf: Any, *rest: Any) -> bool:
        rest[-1].extend(seen_from(graph, 0) if kf.id >= VIEWS - 2 else [])
        return False

    monkeypatch.setattr(keyframes_module, "join_recognised", seen_without_scale)
    source: Any = SimpleNamespace(size=(scene.width, scene.height), has_depth=False, has_semantic=False)
    parts = build_parts(replace(Config(), pointmaps="geometric", semantics="none", features="orb"), source)
    keyframes = Keyframes(Config(), parts, graph, SimpleNamespace(parts=parts))  # type: ignore[arg-type]
    keyframes.edges.flows = {(VIEWS - 2, VIEWS - 1): scene.px}
    keyframes.finish(SimpleNamespace(last=None))  # type: ignore[arg-type]
    keyframes.close()
    assert len(graph.keyframes) == VIEWS - 2 and graph.submap == 1 and not keyframes.edges.flows


def test_keyframes_that_were_let_go_are_gone_after_the_last_frame(scene: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    """They have neither poses nor depths: left there, they would be placed by continuity."""
    graph = with_a_small_piece(scene)
    gone = {0, 1}
    graph.submap_of.update(dict.fromkeys(gone, 9))
    monkeypatch.setattr(keyframes_module, "join_recognised", lambda *_: False)
    source: Any = SimpleNamespace(size=(scene.width, scene.height), has_depth=False, has_semantic=False)
    parts = build_parts(replace(Config(), pointmaps="geometric", semantics="none", features="orb"), source)
    keyframes = Keyframes(Config(), parts, graph, SimpleNamespace(parts=parts))  # type: ignore[arg-type]
    keyframes.finish(SimpleNamespace(last=None))  # type: ignore[arg-type]
    keyframes.close()
    assert len(graph.keyframes) == VIEWS - 2 and set(graph.submap_of.values()) == graph.started
    assert [r.state for r in graph.records[:2]] == ["lost", "lost"]
