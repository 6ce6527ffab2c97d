"""A lens that bends lines, told from one that does not."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from mastd3r.config import CameraConfig, Config, GraphConfig
from mastd3r.geometry.se3 import inverse
from mastd3r.graph.intrinsics import RADIAL, intrinsics_for, without_radial
from mastd3r.graph.keyframe_graph import KeyframeGraph
from mastd3r.graph.radial_terms import radial_is_told
from mastd3r.offline.final_solve import finish_graph
from mastd3r.types import Matches

VIEWS = 6


def graph_of(scene: Any, noise_px: float, camera: CameraConfig | None = None) -> KeyframeGraph:
    """Matches between all views, from true poses and depths, the lens not known."""
    size = (scene.width, scene.height)
    graph = KeyframeGraph(GraphConfig(), intrinsics_for(camera or CameraConfig(), *size, size))
    p = len(scene.px)
    for k in range(VIEWS):
        still = np.zeros((scene.height, scene.width))
        pose = scene.cam_from_world[k] @ inverse(scene.cam_from_world[0])
        graph.add_keyframe(scene.work_frame(k), np.ones(p), still, pose, 1 / scene.depth(k), np.full(p, 1e-2))
        graph.record(scene.work_frame(k), k, np.eye(4), "tracked", None, np.zeros(0))
        graph.replace_last_by_keyframe(graph.latest)
    for i in range(VIEWS):
        for j in range(VIEWS):
            if i != j:
                m = scene.matches(i, j, noise_px)
                graph.connect(i, j, Matches(m.ref_px, m.new_px, m.weight), np.ones(p))
    graph.started.add(0)
    return graph


def test_a_bent_lens_stays_bent(exact_scene: Callable[..., Any]) -> None:
    scene = exact_scene(VIEWS, step=0.2, k=-0.2, cell_px=10)
    graph = graph_of(scene, 0.1)
    finish_graph(graph, Config())
    assert graph.intrinsics.values[1] == pytest.approx(-0.2, abs=0.03)


def test_what_noise_bends_is_straight(exact_scene: Callable[..., Any]) -> None:
    """The solver alone finds a term that bends the border of the picture; the cost hardly rises without."""
    scene = exact_scene(VIEWS, step=0.2, k=0.0, cell_px=10)
    graph = graph_of(scene, 0.5)
    alone = graph.solve_all(20, 0.5)
    bent = graph.intrinsics.values[1]
    assert bent != 0 and not radial_is_told(graph)
    finish_graph(graph, Config())
    assert not graph.intrinsics.values[list(RADIAL)].any()
    assert np.exp(graph.intrinsics.values[0]) == pytest.approx(scene.focal_px, rel=0.03)
    report = graph.last_report
    assert report is not None and report.cost_last < 1.01 * alone.cost_last
    graph.solve_all(5, 0.5)  # whoever solves again finds it held
    assert not graph.intrinsics.values[list(RADIAL)].any()


def test_less_noise_tells_a_smaller_term(exact_scene: Callable[..., Any]) -> None:
    told = []
    for noise_px in (0.02, 1.0):
        graph = graph_of(exact_scene(VIEWS, step=0.2, k=-0.03, cell_px=10), noise_px)
        graph.solve_all(20, 0.5)
        told.append(radial_is_told(graph))
    assert told == [True, False]


def test_a_given_lens_is_left_alone(exact_scene: Callable[..., Any]) -> None:
    given = CameraConfig(intrinsics=(260.0, 260.0, 159.5, 119.5, 0.01))
    graph = graph_of(exact_scene(VIEWS, step=0.2, k=0.0, cell_px=10), 0.5, given)
    before = graph.intrinsics.values.copy()
    finish_graph(graph, Config())
    assert before[1] != 0 and (graph.intrinsics.values == before).all()


def test_without_radial_holds_them_at_none() -> None:
    g = intrinsics_for(CameraConfig(), 320, 240, (320, 240))
    g.values[list(RADIAL)] = 0.1
    straight = without_radial(g)
    assert not straight.values[list(RADIAL)].any() and straight.free.tolist() == [True, False, True, True, False, False]
    assert g.values[1] == 0.1 and g.free.all()
