"""Passages that are explained badly: found by what they cost, solved anew, and put back into the chain."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from mastd3r.geometry.se3 import inverse, se3_exp, so3_log
from mastd3r.graph import passages as passages_module
from mastd3r.graph.few_points import State, chain_of_few, solved, thinned
from mastd3r.graph.keyframe_graph import KeyframeGraph
from mastd3r.graph.passages import (
    LENGTH,
    SETTLING,
    STARTS,
    WHOLE,
    OnFew,
    Settled,
    Start,
    Tried,
    cost_around,
    doubtful_passages,
    kept_if_cheaper,
    replace_passage,
    retake_passages,
)
from test_graph_keyframes import graph_of

Array = NDArray[Any]
VIEWS, NEAR, BROKEN = 24, 4, 17  # keyframes, how far apart they are matched, the first that is wrong


def chain(exact_scene: Callable[..., Any]) -> KeyframeGraph:
    """A chain whose keyframes are matched with their neighbours alone, true but for noise."""
    graph = graph_of(exact_scene(VIEWS, step=0.06, cell_px=12), VIEWS, noise_px=0.2, solved=True)
    graph.edges = [e for e in graph.edges if abs(e.i - e.j) <= NEAR]
    for v in graph.variables.values():
        v.prior_info = np.full(len(v.px), 1e-4)
    graph.solve_all(10, 0.5)
    return graph


def break_up(graph: KeyframeGraph) -> None:
    """The last keyframes shift where they should turn, in front of a wall that leans the other way."""
    for k in range(BROKEN, VIEWS):
        wrong = se3_exp(np.array([-0.25, 0.1, 0.2, 0.3, 0.9, -0.2]) * (k - BROKEN + 1))
        graph.set_keyframe_pose(k, wrong @ graph.variables[k].cam_from_world)
        depth = graph.variables[k].inv_depth
        graph.set_depths(k, np.maximum(2 * np.median(depth) - depth, 0.05))
    graph.solve_all(30, 0.5)


def off_deg(graph: KeyframeGraph, truth: dict[int, Array]) -> float:
    """The worst turn between neighbours, against the truth."""
    worst = 0.0
    for a in range(VIEWS - 1):
        found = graph.variables[a + 1].cam_from_world @ inverse(graph.variables[a].cam_from_world)
        true = truth[a + 1] @ inverse(truth[a])
        worst = max(worst, float(np.linalg.norm(so3_log(found[:3, :3] @ true[:3, :3].T))))
    return float(np.degrees(worst))


@pytest.mark.parametrize("is_long", [False, True])
def test_a_passage_in_a_minimum_of_its_own_is_solved_anew(
    exact_scene: Callable[..., Any], monkeypatch: pytest.MonkeyPatch, is_long: bool
) -> None:
    """Of a long chain its surroundings alone are solved with it."""
    if is_long:
        monkeypatch.setattr(passages_module, "LONG", VIEWS - 1)
        monkeypatch.setattr(passages_module, "AROUND", 3)
    graph = chain(exact_scene)
    truth = {k: v.cam_from_world.copy() for k, v in graph.variables.items()}
    assert off_deg(graph, truth) == 0.0
    break_up(graph)
    assert off_deg(graph, truth) > 3.0  # the solver does not leave it by itself
    passages = doubtful_passages(graph)
    assert passages and set(passages[0]) & set(range(BROKEN, VIEWS))
    if is_long:
        monkeypatch.setattr(KeyframeGraph, "solve_all", lambda *_, **__: pytest.fail("the whole chain was solved"))
    retake_passages(graph)
    assert off_deg(graph, truth) < 0.3
    length = np.linalg.norm(graph.world_from_cam(VIEWS - 1)[:3, 3] - graph.world_from_cam(VIEWS - 2)[:3, 3])
    first = np.linalg.norm(graph.world_from_cam(1)[:3, 3] - graph.world_from_cam(0)[:3, 3])
    a, b = (inverse(truth[k])[:3, 3] for k in (VIEWS - 1, VIEWS - 2))
    c, d = (inverse(truth[k])[:3, 3] for k in (1, 0))
    assert length / first == pytest.approx(np.linalg.norm(a - b) / np.linalg.norm(c - d), rel=0.1)  # one scale


@pytest.mark.parametrize("start", STARTS)
def test_a_passage_alone_comes_back_from_either_start(exact_scene: Callable[..., Any], start: Start) -> None:
    graph = chain(exact_scene)
    true_cost = solved(thinned(graph, range(14, VIEWS)), SETTLING)
    break_up(graph)
    part = thinned(graph, range(14, VIEWS))
    assert solved(thinned(graph, range(14, VIEWS)), SETTLING[-1:]) > 3 * true_cost
    assert start(part) and solved(part, SETTLING) == pytest.approx(true_cost, rel=0.02)


def test_what_is_explained_well_stays_as_it_is(exact_scene: Callable[..., Any]) -> None:
    graph = chain(exact_scene)
    before = {k: v.cam_from_world.copy() for k, v in graph.variables.items()}
    assert doubtful_passages(graph) == [] and retake_passages(graph) == 0
    for k, pose in before.items():
        np.testing.assert_array_equal(graph.variables[k].cam_from_world, pose)


def test_a_short_chain_has_no_passages(exact_scene: Callable[..., Any]) -> None:
    graph = graph_of(exact_scene(5, step=0.1), 5, solved=True)
    assert VIEWS >= 2 * LENGTH > 5 and doubtful_passages(graph) == [] and retake_passages(graph) == 0


def test_the_same_passage_in_another_world_and_scale_changes_nothing(exact_scene: Callable[..., Any]) -> None:
    graph = chain(exact_scene)
    before = {k: (v.cam_from_world.copy(), v.inv_depth.copy()) for k, v in graph.variables.items()}
    ids, elsewhere, scale = list(range(8, 18)), se3_exp(np.array([1.0, -2.0, 0.5, 0.3, 0.8, -0.4])), 2.5
    state = {}
    for k in ids:
        pose = before[k][0].copy()
        pose[:3, 3] *= scale
        state[k] = (pose @ elsewhere, before[k][1] / scale)
    replace_passage(graph, ids, state)
    for k, (pose, inv_depth) in before.items():
        np.testing.assert_allclose(graph.variables[k].cam_from_world, pose, atol=1e-9)
        np.testing.assert_allclose(graph.variables[k].inv_depth, inv_depth, rtol=1e-9)


def test_measured_depths_have_a_scale_that_is_not_ours_to_change(exact_scene: Callable[..., Any]) -> None:
    graph = chain(exact_scene)
    break_up(graph)
    assert doubtful_passages(graph)
    for v in graph.variables.values():
        v.prior_info = 100.0 / np.maximum(v.inv_depth, 1e-3) ** 2
    assert graph.depths_measured and doubtful_passages(graph) == [] and retake_passages(graph) == 0


class Counted:
    """As much of a graph as is asked for passages that others make up."""

    edges: tuple[int, ...] = (1, 2)

    def edges_among(self, _: list[int]) -> tuple[int, ...]:
        return self.edges


def test_a_passage_is_tried_again_once_it_has_more_matches_or_another_cost(monkeypatch: pytest.MonkeyPatch) -> None:
    bounds, retaken, graph, costs = list[float](), list[list[int]](), Counted(), [100.0]

    def doubtful(_: Any, times: float) -> list[list[int]]:
        bounds.append(times)
        return [[3, 4]]

    monkeypatch.setattr(passages_module, "doubtful_passages", doubtful)
    monkeypatch.setattr(passages_module, "cost_alone", lambda *_: costs[-1])
    monkeypatch.setattr(passages_module, "_retake", lambda _, ids, *__: bool(retaken.append(ids)))
    tried = Tried()
    for edges, cost, count in (((1, 2), 100, 1), ((1, 2), 101, 1), ((1, 2, 3), 101, 2), ((1, 2, 3), 90, 3)):
        graph.edges = edges
        costs.append(cost)
        retake_passages(graph, tried)  # type: ignore[arg-type]
        assert len(retaken) == count and set(bounds) == {passages_module.LOOKED_AT}


def test_where_one_was_taken_the_others_are_looked_at_once_more(monkeypatch: pytest.MonkeyPatch) -> None:
    """Those that it changed; one elsewhere costs what it did, and is as it was."""
    cost = {3: 100.0, 8: 80.0, 20: 120.0}
    retaken = list[int]()

    def retake(_: Any, ids: list[int], *__: Any) -> bool:
        retaken.append(ids[0])
        if retaken.count(3) != 1 or ids[0] != 3:
            return False
        cost.update({3: 60.0, 8: 70.0})
        return True

    monkeypatch.setattr(passages_module, "doubtful_passages", lambda *_: [[20, 29], [8, 17], [3, 12]])
    monkeypatch.setattr(passages_module, "cost_alone", lambda _, ids: cost[ids[0]])
    monkeypatch.setattr(passages_module, "_retake", retake)
    assert retake_passages(Counted()) == 1  # type: ignore[arg-type]
    assert retaken == [20, 8, 3, 8, 3]


def test_of_several_explanations_that_is_taken_with_which_the_whole_costs_least(
    exact_scene: Callable[..., Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Not the first that is better than the one there is, nor the one with which the passage alone costs least."""
    ids, graph = list(range(14, VIEWS)), chain(exact_scene)
    ends = iter([90.0, 50.0, 50.1, 60.0, 99.0])  # what a passage costs alone after each start; the third is the second
    poses = {cost: se3_exp(np.full(6, 1e-3 * cost)) for cost in (50.0, 60.0)}
    whole = {50.0: 11.0, 60.0: 9.0}
    monkeypatch.setattr(passages_module, "STARTS", (lambda _: True,) * 5)
    last = list[float]()

    def solved_once(*_: Any) -> float:
        last.append(next(ends))
        return last[-1]

    def state(_: Any) -> State:
        return {k: (poses.get(last[-1], np.eye(4)), graph.variables[k].inv_depth) for k in ids}

    def on_few(_: Any, __: Any, explanation: State, ___: Any) -> OnFew:
        cost = next(c for c, pose in poses.items() if pose is explanation[14][0])
        return OnFew(10.0, whole[cost], explanation, False, {})

    taken = list[Any]()
    monkeypatch.setattr(passages_module, "solved", solved_once)
    monkeypatch.setattr(passages_module, "state_of", state)
    monkeypatch.setattr(passages_module, "_on_few", on_few)
    monkeypatch.setattr(passages_module, "_as_on_few", lambda *_: None)
    monkeypatch.setattr(
        passages_module, "replace_passage", lambda _, __, state, follows: taken.append((state, follows))
    )
    monkeypatch.setattr(
        passages_module, "kept_if_cheaper", lambda _, __, change, *___, **____: (change() is None, 1.0, 1.0)
    )
    assert passages_module._retake(graph, ids, 95.0, Settled())
    assert len(taken) == 1 and taken[0][0][14][0] is poses[60.0] and taken[0][1] is False


def test_what_there_is_is_not_judged_by_a_wide_solve_that_ends_in_a_worse_place(
    exact_scene: Callable[..., Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Else a change would be kept that is better than that, and worse than what there was."""
    graph = chain(exact_scene)
    near, place = cost_around(graph, [4, 5]), graph.world_from_cam(VIEWS - 1)
    solve_all = KeyframeGraph.solve_all

    def astray(self: KeyframeGraph, iterations: int, kernel_px: float, **options: Any) -> Any:
        if (kernel_px, iterations) == WHOLE[-1]:
            break_up(self)
        return solve_all(self, iterations, kernel_px, **options)

    monkeypatch.setattr(KeyframeGraph, "solve_all", astray)
    kept, before, after = kept_if_cheaper(graph, [4, 5], lambda: None)
    assert not kept and before == pytest.approx(near, rel=0.01) and after > 1.1 * near
    np.testing.assert_allclose(graph.world_from_cam(VIEWS - 1), place, atol=1e-3)


@pytest.mark.parametrize("turn_rad", [0.2, 0.5])
@pytest.mark.parametrize("end", [0, -1])
def test_one_wrong_link_between_two_right_halves_is_found(
    exact_scene: Callable[..., Any], turn_rad: float, end: int
) -> None:
    """Wherever the halves were put: not by what was seen across, whose depths have adapted to it."""
    graph = chain(exact_scene)
    truth = {k: v.cam_from_world.copy() for k, v in graph.variables.items()}
    for k in range(BROKEN, VIEWS):  # on the left: cameras of the second half turn about the world's origin
        graph.set_keyframe_pose(k, truth[k] @ se3_exp(np.array([0.1, 0.3, -0.2, 0.0, turn_rad, 0.1])))
    part = thinned(graph, range(14, VIEWS))
    assert passages_module._from_one_end(part, end)
    for k in range(14, VIEWS - 1):
        found = part.variables[k + 1].cam_from_world @ inverse(part.variables[k].cam_from_world)
        true = truth[k + 1] @ inverse(truth[k])
        assert np.degrees(np.linalg.norm(so3_log(found[:3, :3] @ true[:3, :3].T))) < 1.0


@pytest.mark.parametrize("is_long", [False, True])
def test_a_few_points_refuse_what_all_would_and_all_are_asked_before_it_is_taken(
    exact_scene: Callable[..., Any], monkeypatch: pytest.MonkeyPatch, is_long: bool
) -> None:
    """Another explanation, from which the solver does not come back."""
    if is_long:
        monkeypatch.setattr(passages_module, "LONG", VIEWS - 1)
        monkeypatch.setattr(passages_module, "AROUND", 3)
    graph, astray, ids = chain(exact_scene), chain(exact_scene), list(range(14, VIEWS))
    break_up(astray)  # into a minimum of its own
    as_it_is = {k: graph.variables[k].cam_from_world.copy() for k in graph.members()}
    right, wrong = (
        {k: (g.variables[k].cam_from_world, g.variables[k].inv_depth) for k in ids} for g in (graph, astray)
    )
    settled = Settled()
    as_good = passages_module._on_few(graph, ids, right, settled)
    assert as_good.after == pytest.approx(as_good.before, rel=0.02)
    worse = passages_module._on_few(graph, ids, wrong, settled)
    assert worse.before == as_good.before and worse.after > 1.2 * worse.before and len(settled.few) == 1
    for k, pose in as_it_is.items():
        np.testing.assert_array_equal(graph.variables[k].cam_from_world, pose)
    asked = list[float | None]()

    def refused(*given: Any) -> tuple[bool, float, float]:
        asked.append(given[4])
        return False, 1.0, 2.0

    monkeypatch.setattr(passages_module, "_explanations", lambda *_: [(1.0, right)])
    monkeypatch.setattr(passages_module, "kept_if_cheaper", refused)
    for dearer, costs in ((1.001, []), (0.999, [None]), (0.99, [None, 1.0])):  # what it costs as it is is known by then
        way = replace(as_good, after=dearer * as_good.before)
        monkeypatch.setattr(passages_module, "_on_few", lambda *_, way=way: way)
        assert not passages_module._retake(graph, ids, 100.0, settled) and asked == costs


def test_what_follows_stays_where_other_views_hold_it(exact_scene: Callable[..., Any]) -> None:
    """A passage that alone is astray, between two that are right: its end says nothing of where the rest is."""
    graph, ids = chain(exact_scene), list(range(8, 18))
    right = {k: (graph.variables[k].cam_from_world.copy(), graph.variables[k].inv_depth.copy()) for k in ids}
    truth = {k: v.cam_from_world.copy() for k, v in graph.variables.items()}
    turned_away = se3_exp(np.array([0.0, 0.0, 0.0, 0.0, 0.3, 0.0]))
    for k in ids:  # as a whole, about the camera of its first: the last is elsewhere
        graph.set_keyframe_pose(k, truth[k] @ inverse(truth[ids[0]]) @ turned_away @ truth[ids[0]])
    way = passages_module._on_few(graph, ids, right, Settled())
    assert not way.follows and way.after < 0.5 * way.before
    scaled = replace_passage(graph, ids, right, way.follows)
    assert scaled.ids == [] and scaled.times == 1.0
    for k in range(ids[-1] + 1, VIEWS):
        np.testing.assert_array_equal(graph.variables[k].cam_from_world, truth[k])
    passages_module._as_on_few(graph, way.state)
    for k in range(VIEWS - 1):
        found = graph.variables[k + 1].cam_from_world @ inverse(graph.variables[k].cam_from_world)
        true = truth[k + 1] @ inverse(truth[k])
        assert np.degrees(np.linalg.norm(so3_log(found[:3, :3] @ true[:3, :3].T))) < 0.3


def test_all_points_start_from_where_a_few_came_to(exact_scene: Callable[..., Any]) -> None:
    """Also those of which a few know nothing: as much nearer or farther as the nearest of the few."""
    graph, ids = chain(exact_scene), list(range(8, 18))
    part = chain_of_few(graph, ids, 150)
    state = {k: (v.cam_from_world, 2.0 * v.inv_depth) for k, v in part.variables.items()}
    depth = {k: graph.variables[k].inv_depth.copy() for k in graph.members()}
    away = se3_exp(np.array([0.1, 0.0, 0.0, 0.0, 0.1, 0.0]))
    state[ids[-1]] = (away @ state[ids[-1]][0], state[ids[-1]][1])
    old = {k: graph.variables[k].cam_from_world.copy() for k in graph.members()}
    passages_module._as_on_few(graph, state)
    for k in graph.members():
        np.testing.assert_allclose(graph.variables[k].inv_depth, (2.0 if k in ids else 1.0) * depth[k])
    np.testing.assert_allclose(graph.variables[ids[-1]].cam_from_world, away @ old[ids[-1]])
    last = graph.variables[VIEWS - 1].cam_from_world @ inverse(graph.variables[ids[-1]].cam_from_world)
    np.testing.assert_allclose(last, old[VIEWS - 1] @ inverse(old[ids[-1]]), atol=1e-9)  # what follows came along


def test_what_was_put_in_and_refused_leaves_no_trace(exact_scene: Callable[..., Any]) -> None:
    """Not in the priors of what came along at another scale either."""
    graph, ids = chain(exact_scene), list(range(8, 18))
    kept = {k: (v.prior_depth.copy(), v.prior_info.copy()) for k, v in graph.variables.items()}
    now = {k: graph.variables[k] for k in ids}
    state = {k: (v.cam_from_world, v.inv_depth * (0.5 if k > 12 else 1.0)) for k, v in now.items()}
    scaled = replace_passage(graph, ids, state)
    assert scaled.times == pytest.approx(0.5) and scaled.ids == list(range(18, VIEWS))
    assert not np.allclose(graph.variables[18].prior_info, kept[18][1])
    scaled.undo(graph)
    for k, (prior_depth, prior_info) in kept.items():
        np.testing.assert_allclose(graph.variables[k].prior_depth, prior_depth)
        np.testing.assert_allclose(graph.variables[k].prior_info, prior_info)


def test_a_speed_that_goes_on_weighs_as_much_beside_a_few_points_as_beside_all(
    exact_scene: Callable[..., Any],
) -> None:
    graph = chain(exact_scene)
    points = len(graph.variables[0].px)
    part = chain_of_few(graph, graph.free_members(), 150)
    assert 150 <= len(part.variables[0].px) < points
    share = len(part.variables[0].px) / points
    assert part.config.steady_speed == pytest.approx(share * graph.config.steady_speed)
