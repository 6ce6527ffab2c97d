"""How far matches are off: told from the better half of them, and what a speed that goes on is weighed against."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from mastd3r.graph import match_noise
from mastd3r.graph.few_points import thinned
from mastd3r.graph.keyframe_graph import KeyframeGraph
from mastd3r.graph.match_noise import learn_match_variance, match_variance_px2, squared_residuals
from mastd3r.graph.solved_anew import solve_anew
from mastd3r.graph.windows import everything, in_a_row
from test_graph_keyframes import graph_of
from test_submaps import play, views_of

VIEWS, NOISE_PX = 6, 0.4


@pytest.fixture(scope="module")
def scene(exact_scene: Callable[..., Any]) -> Any:
    return exact_scene(VIEWS, step=0.1, cell_px=10)


def noisy(scene: Any, noise_px: float = NOISE_PX) -> KeyframeGraph:
    return graph_of(scene, VIEWS, noise_px=noise_px, solved=True)


@pytest.mark.parametrize("noise_px", [0.1, 0.4, 2.0])
def test_the_variance_is_that_of_a_coordinate(scene: Any, noise_px: float) -> None:
    assert match_variance_px2(noisy(scene, noise_px)) == pytest.approx(noise_px**2, rel=0.1)


def test_a_third_that_moves_says_little_and_what_weighs_nothing_says_nothing(scene: Any) -> None:
    graph, rng = noisy(scene), np.random.default_rng(0)
    for n, e in enumerate(graph.edges):
        moves = rng.random(len(e.weight)) < 0.35
        gone = rng.random(len(e.weight)) < 0.5
        target = e.target + np.where(moves[:, None], 30.0, 0.0) + np.where(gone[:, None], 500.0, 0.0)
        weight = np.where(gone, 0.0, e.weight)
        graph.edges[n] = replace(e, target=target.astype(np.float32), weight=weight.astype(np.float32))
    assert NOISE_PX**2 < match_variance_px2(graph) < 2.5 * NOISE_PX**2


def test_of_many_every_nth_is_looked_at(scene: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    graph = noisy(scene)
    every = match_variance_px2(graph)
    monkeypatch.setattr(match_noise, "MOST", 1000)
    assert match_variance_px2(graph) == pytest.approx(every, rel=0.2)


def test_before_there_are_poses_nothing_is_learned(scene: Any) -> None:
    """And where poses are far off, not all of it is believed."""
    graph = noisy(scene, 30.0)
    assert match_variance_px2(graph) == match_noise.LARGEST_PX2
    graph.started = set()
    learn_match_variance(graph)
    assert graph.match_variance_px2 == match_variance_px2(graph) == 1.0


def test_without_matches_it_is_one(scene: Any) -> None:
    graph = noisy(scene)
    for n, e in enumerate(graph.edges):
        graph.edges[n] = replace(e, weight=np.zeros_like(e.weight))
    assert match_variance_px2(graph) == 1.0
    graph.edges = []
    assert match_variance_px2(graph) == 1.0


def test_residuals_are_those_of_the_edge(scene: Any) -> None:
    graph = noisy(scene, 0.0)
    assert squared_residuals(graph, graph.edges[3]).max() < 1e-3
    moved = replace(graph.edges[3], target=graph.edges[3].target + np.float32([3.0, 4.0]))
    np.testing.assert_allclose(squared_residuals(graph, moved), 25.0, rtol=1e-2)


def test_a_speed_that_goes_on_is_weighed_against_it(scene: Any) -> None:
    graph = noisy(scene)
    before = in_a_row(graph, everything(graph, steady=True)).weight
    learn_match_variance(graph)
    after = in_a_row(graph, everything(graph, steady=True)).weight
    np.testing.assert_allclose(after, before * match_variance_px2(graph))
    assert thinned(graph, range(VIEWS)).match_variance_px2 == graph.aside().match_variance_px2 < 1


def test_after_the_last_frame_it_is_learned_and_the_chain_is_solved_anew(monkeypatch: pytest.MonkeyPatch) -> None:
    seen: list[tuple[int, float]] = []

    def solved(graph: KeyframeGraph) -> bool:
        seen.append((graph.submap, graph.match_variance_px2))
        return solve_anew(graph)

    monkeypatch.setattr("mastd3r.slam.solve_anew", solved)
    graph = play(views_of(30)).slam.graph
    assert seen == [(0, graph.match_variance_px2)] and 0 < graph.match_variance_px2 < 0.25


def test_a_clip_that_starts_at_its_end_learns_it_then() -> None:
    """Three keyframes, one of them the last frame: poses come with the last solve, and so do residuals."""
    graph = play(views_of(10)).slam.graph
    assert graph.started and 0 < graph.match_variance_px2 < 1
