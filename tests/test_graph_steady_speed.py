"""That a camera's speed goes on is believed where matches say nothing, and nowhere else."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from mastd3r.config import Config, GraphConfig
from mastd3r.geometry.se3 import se3_exp
from mastd3r.geometry.sim3 import Sim3
from mastd3r.graph import bundle_adjustment
from mastd3r.graph.few_points import solved, thinned
from mastd3r.graph.keyframe_graph import KeyframeGraph
from mastd3r.graph.passages import SETTLING, Settled, _on_few, cost_around
from mastd3r.graph.steady_speed import SteadySpeed
from mastd3r.graph.windows import Window, everything, in_a_row, sliding
from mastd3r.offline.final_solve import finish_graph
from test_graph_scale_jumps import neighbours_matched

VIEWS, FIRST, END = 14, 5, 10  # the keyframes between FIRST and END may be brought to a scale of their own
ROWS, TIMES_S = [(0, 1, 2), (1, 2, 3)], {0: 0.0, 1: 0.3, 2: 0.5, 3: 0.9}


def poses(centres: Any, seed: int = 0) -> Any:
    """(n, 4, 4) cam_from_world of cameras at ``centres`` (n, 3) that look anywhere."""
    rng = np.random.default_rng(seed)
    out = []
    for centre in np.asarray(centres, float):
        out.append(se3_exp(np.concatenate([np.zeros(3), rng.normal(size=3)])))
        out[-1][:3, 3] = -out[-1][:3, :3] @ centre
    return np.array(out)


def test_nothing_is_asked_of_a_camera_whose_speed_goes_on() -> None:
    speed = SteadySpeed.of(ROWS, TIMES_S, 7.0)
    assert speed.cost(poses([[t, 2 * t, -t] for t in TIMES_S.values()])) == pytest.approx(0, abs=1e-20)


def test_twice_as_fast_costs_a_ninth_of_the_weight_and_turning_back_all_of_it() -> None:
    speed = SteadySpeed.of(ROWS[:1], {0: 0.0, 1: 0.1, 2: 0.2}, 9.0)
    assert speed.cost(poses([[0, 0, 0], [1, 0, 0], [3, 0, 0]])) == pytest.approx(1.0)
    assert speed.cost(poses([[0, 0, 0], [1, 0, 0], [0, 0, 0]])) == pytest.approx(9.0)
    still = poses(np.zeros((3, 3)))
    assert speed.cost(still) == 0.0 and not speed.system(still)[0].any()


def test_longer_gaps_weigh_less_and_none_are_left_out() -> None:
    assert SteadySpeed.of(ROWS, {0: 0.0, 1: 0.5, 2: 1.5, 3: 3.5}, 8.0).weight.tolist() == [8.0, 2.0]
    assert len(SteadySpeed.of(ROWS, {0: 0.0, 1: 0.5, 2: 0.5, 3: 1.0}, 8.0).ids) == 0
    assert len(SteadySpeed.of(ROWS, TIMES_S, 0.0).ids) == 0
    assert SteadySpeed.of([], {}, 8.0).cost(np.zeros((0, 4, 4))) == 0.0


def test_the_unit_of_length_does_not_matter() -> None:
    speed, centres = SteadySpeed.of(ROWS, TIMES_S, 7.0), np.random.default_rng(1).normal(size=(4, 3))
    assert speed.cost(poses(1e-3 * centres)) == pytest.approx(speed.cost(poses(centres)))
    h, b = speed.system(poses(centres))
    for n, row in enumerate(ROWS):
        grows = np.concatenate([[*p[:3, 3], 0, 0, 0] for p in (poses(centres)[k] for k in row)])
        assert abs(b[n] @ grows) < 1e-12 and abs(grows @ h[n] @ grows) < 1e-12


def test_the_system_is_that_of_its_differences() -> None:
    speed, at = SteadySpeed.of(ROWS, TIMES_S, 7.0), poses(np.random.default_rng(1).normal(size=(4, 3)))
    h, b = speed.system(at)
    for n, row in enumerate(ROWS):
        one = replace(speed, ids=np.arange(3)[None], gaps_s=speed.gaps_s[n : n + 1], weight=speed.weight[n : n + 1])
        here = at[list(row)]
        columns = []
        for unit in 1e-6 * np.eye(18):
            moved = [np.stack([se3_exp(s * unit[6 * m : 6 * m + 6]) @ here[m] for m in range(3)]) for s in (1, -1)]
            there, back = (one._residuals(some[None])[0][0] for some in moved)
            columns.append((there - back) / 2e-6)
        jacobian, residual = np.stack(columns, axis=1), one._residuals(here[None])[0][0]
        np.testing.assert_allclose(h[n], 7.0 * jacobian.T @ jacobian, atol=1e-7)
        np.testing.assert_allclose(b[n], -7.0 * jacobian.T @ residual, atol=1e-7)


@pytest.fixture(scope="module")
def scene(exact_scene: Callable[..., Any]) -> Any:
    return exact_scene(VIEWS, step=0.08, cell_px=10)


def chain(scene: Any, ratio: float, across: float, weight: float) -> KeyframeGraph:
    """A camera at one speed; the keyframes from ``FIRST`` to ``END`` are ``ratio`` times as large, those after come
    along, and matches between them and the others weigh ``across``."""
    graph = neighbours_matched(scene, VIEWS, range(FIRST, END), across, 1e-6, GraphConfig(steady_speed=weight))
    centre, end = graph.world_from_cam(FIRST)[:3, 3], graph.world_from_cam(END - 1)[:3, 3]
    graph.transform_keyframes(range(FIRST, END), Sim3(np.eye(3), centre - ratio * centre, ratio))
    moved = np.eye(4)
    moved[:3, 3] = graph.world_from_cam(END - 1)[:3, 3] - end
    graph.transform_keyframes(range(END, VIEWS), Sim3.from_rigid(moved))
    return graph


def steps_of(graph: KeyframeGraph) -> Any:
    """Lengths between keyframes, of the first ones' mean."""
    steps = np.linalg.norm(np.diff([graph.world_from_cam(k)[:3, 3] for k in range(VIEWS)], axis=0), axis=1)
    return steps / steps[: FIRST - 1].mean()


@pytest.mark.parametrize(("weight", "speed"), [(25.0, 1.0), (0.0, 2.0)])
def test_a_part_that_no_match_measures_comes_out_at_the_speed_around_it(
    scene: Any, weight: float, speed: float
) -> None:
    graph = chain(scene, 2.0, 0.0, weight)
    for _ in range(8):
        graph.solve_all(20, 1.0, steady=True)
    np.testing.assert_allclose(steps_of(graph)[FIRST : END - 1], speed, rtol=0.1)


def test_what_matches_tell_is_not_bent(scene: Any) -> None:
    """True jumps of speed, told by matches, stay: every second keyframe at half the time."""
    found = []
    for weight in (0.0, 25.0):
        graph = chain(scene, 1.0, 1.0, weight)
        for k, kf in enumerate(graph.keyframes):
            time_s = k / 10 + (0.04 if k % 2 else 0.0)
            graph.keyframes[k] = replace(kf, work=replace(kf.work, timestamp_s=time_s))
        graph.solve_all(20, 1.0, steady=True)
        found.append(steps_of(graph))
    np.testing.assert_allclose(found[1], found[0], rtol=0.005)


def test_whole_chains_after_the_last_frame_are_solved_with_it(scene: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    """And of a passage what has settled from a start."""
    graph, asked, optimise = chain(scene, 1.0, 1.0, 25.0), list[bool](), KeyframeGraph.optimise

    def seen(graph: KeyframeGraph, problem: Window, *args: Any, **options: Any) -> Any:
        asked.append(problem.steady)
        return optimise(graph, problem, *args, **options)

    monkeypatch.setattr(KeyframeGraph, "optimise", seen)
    explanation = {k: (graph.variables[k].cam_from_world, graph.variables[k].inv_depth) for k in range(4, 10)}
    for solve, steady in (
        (lambda: finish_graph(graph, Config()), {True}),
        (lambda: cost_around(graph, [4, 5]), {True}),
        (lambda: _on_few(graph, range(4, 10), explanation, Settled()), {True}),
        (lambda: solved(thinned(graph, range(4, 10)), SETTLING[:-1]), {False}),
        (lambda: solved(thinned(graph, range(4, 10)), SETTLING[-1:]), {True}),
        (lambda: graph.solve_all(2, 1.0), {False}),
    ):
        asked.clear()
        solve()
        assert set(asked) == steady


def test_the_sparse_system_says_the_same(scene: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    dense = chain(scene, 1.5, 0.0, 25.0)
    dense.solve_all(4, 1.0, steady=True)
    monkeypatch.setattr(bundle_adjustment, "DENSE_MOST", 2)
    sparse = chain(scene, 1.5, 0.0, 25.0)
    sparse.solve_all(4, 1.0, steady=True)
    np.testing.assert_allclose(steps_of(sparse), steps_of(dense), rtol=1e-4)


def test_only_keyframes_in_a_row_of_one_submap_and_one_video_speak(scene: Any) -> None:
    graph = chain(scene, 1.0, 1.0, 25.0)
    whole = in_a_row(graph, everything(graph, steady=True)).ids.tolist()
    assert whole == [[k, k + 1, k + 2] for k in range(VIEWS - 2)]
    some = replace(everything(graph, steady=True), ids=[0, 1, 2, 4, 5, 7])
    assert in_a_row(graph, some).ids.tolist() == [[0, 1, 2]]
    assert len(in_a_row(graph, replace(some, steady=False)).ids) == 0
    assert not sliding(graph)[0].steady and not everything(graph).steady  # while tracking
    graph.separate(range(8, VIEWS))
    graph.held = 3  # keyframes of a saved map: of another video
    rows = in_a_row(graph, everything(graph, steady=True)).ids
    assert rows[:, 0].tolist() == [3, 4, 5, 8, 9, 10, 11]
