"""Everything solved anew on a few points: it leaves a minimum that no narrow kernel leaves, and alters nothing else."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from mastd3r.geometry.se3 import inverse, se3_exp, transform
from mastd3r.graph import passages
from mastd3r.graph import solved_anew as module
from mastd3r.graph.few_points import state_of
from mastd3r.graph.keyframe_graph import KeyframeGraph
from mastd3r.graph.solved_anew import solve_anew
from test_graph_passages import VIEWS, off_deg
from test_graph_passages import chain as true_chain

FIRST = 12  # the first keyframe beyond the passage where somebody walks by
WALKED = se3_exp(np.array([0.03, 0.0, 0.02, 0.0, 0.015, 0.0]))  # by which the matches of who walks are off
FOLLOWED = 0.4  # of the matches there, those that are of the one who walks


@pytest.fixture
def wrong(exact_scene: Callable[..., Any]) -> tuple[KeyframeGraph, dict[int, Any]]:
    """A chain of which one half was put where what moves says that it is; and its true poses."""
    graph = true_chain(exact_scene)
    truth = {k: v.cam_from_world.copy() for k, v in graph.variables.items()}
    scene = exact_scene(VIEWS, step=0.06, cell_px=12)
    rng = np.random.default_rng(0)
    for k in range(FIRST, VIEWS):
        graph.set_keyframe_pose(k, WALKED @ truth[k])
    for n, edge in enumerate(graph.edges):
        if (edge.i < FIRST) != (edge.j < FIRST):
            j_from_i = graph.variables[edge.j].cam_from_world @ inverse(graph.variables[edge.i].cam_from_world)
            there = scene.pixels(transform(j_from_i, scene.points(edge.i)))
            moves = rng.random(len(there)) < FOLLOWED
            target = np.where(moves[:, None], there, edge.target).astype(np.float32)
            graph.edges[n] = replace(edge, target=target)
    graph.solve_all(40, 0.5)
    return graph, truth


def test_another_minimum_is_found_and_kept_where_it_costs_less(wrong: tuple[KeyframeGraph, dict[int, Any]]) -> None:
    graph, truth = wrong
    before = graph.solve_all(20, 0.5).cost_last
    assert off_deg(graph, truth) > 0.8  # the solver does not leave it by itself
    assert solve_anew(graph)
    assert off_deg(graph, truth) < 0.1 and graph.solve_all(20, 0.5).cost_last < 0.8 * before


def test_what_costs_more_on_all_points_is_put_back(
    wrong: tuple[KeyframeGraph, dict[int, Any]], monkeypatch: pytest.MonkeyPatch
) -> None:
    graph, _ = wrong
    before, costs = state_of(graph), iter([1.0, 1.0])
    lens = graph.intrinsics.values.copy()
    monkeypatch.setattr(passages, "cost_around", lambda *_: next(costs))
    assert not solve_anew(graph)
    assert next(costs, None) is None
    np.testing.assert_array_equal(graph.intrinsics.values, lens)
    for k, (pose, inv_depth) in before.items():
        np.testing.assert_array_equal(graph.variables[k].cam_from_world, pose)
        np.testing.assert_array_equal(graph.variables[k].inv_depth, inv_depth)


def test_where_a_few_points_know_nothing_better_all_are_left_alone(
    exact_scene: Callable[..., Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    graph = true_chain(exact_scene)
    before = state_of(graph)
    monkeypatch.setattr(passages, "cost_around", lambda *_: pytest.fail("everything was solved"))
    assert not solve_anew(graph)
    for k, (pose, _) in before.items():
        np.testing.assert_array_equal(graph.variables[k].cam_from_world, pose)


@pytest.mark.parametrize("why", ["short", "long", "in a saved map", "depths are measured"])
def test_it_is_not_for_every_chain(exact_scene: Callable[..., Any], monkeypatch: pytest.MonkeyPatch, why: str) -> None:
    graph = true_chain(exact_scene)
    monkeypatch.setattr(module, "solved", lambda *_: pytest.fail("something was solved"))
    if why == "depths are measured":
        for v in graph.variables.values():
            v.prior_info = 100.0 / np.maximum(v.inv_depth, 1e-3) ** 2
    graph.held = 3 if why == "in a saved map" else 0
    if why in ("short", "long"):
        monkeypatch.setattr(module, {"short": "LEAST", "long": "LONG"}[why], {"short": VIEWS + 1, "long": 3}[why])
    assert not solve_anew(graph)
