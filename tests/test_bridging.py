"""Pieces that were never joined: placed where the camera would have gone."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from mastd3r.config import CameraConfig, GraphConfig
from mastd3r.geometry.se3 import inverse, se3_exp, se3_log
from mastd3r.graph.bridging import bridge_submaps
from mastd3r.graph.intrinsics import intrinsics_for
from mastd3r.graph.keyframe_graph import KeyframeGraph
from test_submaps import B_FROM_A, CUT, SCALE, VIEWS, keyframe

Array = NDArray[Any]


@pytest.fixture(scope="module")
def scene(exact_scene: Callable[..., Any]) -> Any:
    return exact_scene(VIEWS, step=0.08, cell_px=10)


def steady(k: float) -> Array:
    """world_from_cam of a camera that moves and turns at constant velocity."""
    return inverse(se3_exp(k * np.array([0.05, 0.01, -0.02, 0.0, 0.03, 0.01])))


def steady_graph(scene: Any, gap: int) -> KeyframeGraph:
    """Keyframes 0 … 9 of a steady camera, ``gap`` frames missing after the fifth; the rest is in a world of its own."""
    size = (scene.width, scene.height)
    graph = KeyframeGraph(GraphConfig(), intrinsics_for(CameraConfig(), *size, size))
    graph.intrinsics.values = scene.lens.copy()
    inv_depth = np.full(len(scene.px), 0.4)
    for k in range(VIEWS):
        if k == CUT:
            graph.start_submap()
        at = k + gap if k >= CUT else k
        pose = inverse(steady(at))
        if k >= CUT:
            pose = pose @ inverse(B_FROM_A)
            pose[:3, 3] /= SCALE
        keyframe(graph, scene, k, at / 30, pose, inv_depth * (SCALE if k >= CUT else 1.0))
        graph.started.add(graph.submap)
    return graph


@pytest.mark.parametrize("gap", [0, 3, 9])
def test_a_submap_never_joined_is_placed_by_continuity(scene: Any, gap: int) -> None:
    """Constant velocity and the same depth on both sides of the gap: exactly where the camera was."""
    graph = steady_graph(scene, gap)
    assert bridge_submaps(graph) == [(5, 9)]
    for k in range(VIEWS):
        at = k + gap if k >= CUT else k
        np.testing.assert_allclose(graph.world_from_cam(k), steady(at), atol=1e-6)
    assert [r.state for r in graph.records] == ["tracked"] * 5 + ["interpolated"] * 5
    assert set(graph.submap_of.values()) == {0} and graph.started == {0}
    assert bridge_submaps(graph) == []


def test_velocity_is_not_believed_for_long(scene: Any) -> None:
    """After a gap of a hundred frames the camera is guessed three spans of the velocity ahead, no more."""
    graph = steady_graph(scene, 100)
    bridge_submaps(graph)
    ahead = np.linalg.norm(se3_log(inverse(steady(4)) @ graph.world_from_cam(5)))
    assert ahead == pytest.approx(3 * np.linalg.norm(se3_log(inverse(steady(0)) @ steady(4))), rel=1e-6)


def test_broken_depths_at_the_edge_of_a_gap_have_no_say(scene: Any) -> None:
    """Where somebody fills the picture on both sides of a loss, the keyframes there have depths of any size."""
    graph = steady_graph(scene, 0)
    for k, times in ((CUT - 1, 8.0), (CUT, 0.02), (CUT + 1, 0.05)):
        graph.set_depths(k, graph.variables[k].inv_depth * times)
    bridge_submaps(graph)
    for k in range(VIEWS):
        np.testing.assert_allclose(graph.world_from_cam(k), steady(k), atol=1e-6)


def test_three_submaps_are_bridged_one_after_another(scene: Any) -> None:
    graph = steady_graph(scene, 2)
    graph.start_submap()
    for k in range(3):
        pose = inverse(steady(12 + k) @ inverse(steady(12)))
        pose[:3, 3] *= 0.2
        keyframe(graph, scene, 0, (12 + k) / 30, pose, np.full(len(scene.px), 0.4 / 0.2))
    graph.started.add(graph.submap)
    assert len(bridge_submaps(graph)) == 2
    for k in range(3):
        np.testing.assert_allclose(graph.world_from_cam(10 + k), steady(12 + k), atol=1e-6)


@pytest.mark.parametrize("gap", [0, 1])
def test_a_piece_between_two_that_are_placed_goes_where_both_sides_have_it(scene: Any, gap: int) -> None:
    """Its depths are three times what those beside it are: what its ends are apart tells its size."""
    graph = steady_graph(scene, gap)
    for k in range(CUT, VIEWS):
        graph.set_depths(k, graph.variables[k].inv_depth / 3)
    graph.submap = 0
    for k in range(5):
        at = VIEWS + 2 * gap + k
        keyframe(graph, scene, k, at / 30, inverse(steady(at)), np.full(len(scene.px), 0.4))
    assert bridge_submaps(graph) == [(5, 9)]
    for k in range(CUT, VIEWS):
        np.testing.assert_allclose(graph.world_from_cam(k), steady(k + gap), atol=1e-3)
    assert [r.state for r in graph.records[CUT:VIEWS]] == ["interpolated"] * 5
    assert set(graph.submap_of.values()) == {0}


def test_a_piece_shorter_than_its_gaps_has_its_size_by_depth(scene: Any) -> None:
    graph = steady_graph(scene, 30)
    graph.submap = 0
    for k in range(5):
        at = VIEWS + 60 + k
        keyframe(graph, scene, k, at / 30, inverse(steady(at)), np.full(len(scene.px), 0.4))
    bridge_submaps(graph)
    steps = np.linalg.norm(np.diff([graph.world_from_cam(k)[:3, 3] for k in range(VIEWS)], axis=0), axis=1)
    np.testing.assert_allclose(steps[CUT:], steps[0], rtol=1e-3)
