"""Where the scale of a chain jumps: it is found, mended where that explains more, and left where it does not."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from mastd3r.config import CameraConfig, GraphConfig
from mastd3r.geometry.se3 import inverse, transform
from mastd3r.geometry.sim3 import Sim3
from mastd3r.graph import passages
from mastd3r.graph import scale_jumps as scale_jumps_module
from mastd3r.graph.intrinsics import intrinsics_for
from mastd3r.graph.keyframe_graph import KeyframeGraph
from mastd3r.graph.scale_jumps import LEAST_SPAN, UNTOLD, mend_scale_jumps, scale_jumps
from test_submaps import keyframe, world_from

VIEWS, JUMP_AT = 20, 7


@pytest.fixture(scope="module")
def scene(exact_scene: Callable[..., Any]) -> Any:
    return exact_scene(VIEWS, step=0.08, cell_px=10)


def neighbours_matched(
    scene: Any, views: int, inside: range, across: float, depth_info: float, config: GraphConfig
) -> KeyframeGraph:
    """True keyframes matched with two on either side; matches between those ``inside`` and the others weigh ``across``.

    ``depth_info``: of the depths' priors, times what they have."""
    size = (scene.width, scene.height)
    graph = KeyframeGraph(config, intrinsics_for(CameraConfig(), *size, size))
    graph.intrinsics.values, graph.intrinsics.prior = scene.lens.copy(), scene.lens.copy()
    for k in range(views):
        keyframe(graph, scene, k, k / 10, inverse(world_from(scene, k)), 1 / scene.depth(k))
        graph.variables[k].prior_info = graph.variables[k].prior_info * depth_info
    graph.started.add(0)
    for i in range(views):
        for j in range(max(i - 2, 0), min(i + 3, views)):
            weight = across if (i in inside) != (j in inside) else 1.0
            if i != j and weight:
                graph.connect(i, j, scene.matches(i, j), np.full(len(scene.px), weight), followed=True)
    return graph


def chain(scene: Any, ratio: float, across: float = 1.0) -> KeyframeGraph:
    """Keyframes from ``JUMP_AT`` on are ``ratio`` times as large about the first of them as they are; matches between
    the two parts weigh ``across``."""
    graph = neighbours_matched(scene, VIEWS, range(JUMP_AT, VIEWS), across, 1e-3, GraphConfig())
    centre = graph.world_from_cam(JUMP_AT)[:3, 3]
    graph.transform_keyframes(range(JUMP_AT, VIEWS), Sim3(np.eye(3), centre - ratio * centre, ratio))
    return graph


@pytest.mark.parametrize("ratio", [0.05, 0.2, 4.0])
def test_a_jump_is_found_and_mended(scene: Any, ratio: float) -> None:
    graph = chain(scene, ratio)
    (kf_id, found), *others = scale_jumps(graph)
    assert abs(kf_id - JUMP_AT) <= LEAST_SPAN and found == pytest.approx(ratio, rel=0.5) and not others
    assert mend_scale_jumps(graph) == 1
    np.testing.assert_allclose(steps_of(graph), steps_of(chain(scene, 1.0)), rtol=0.02)
    assert scale_jumps(graph) == []


def steps_of(graph: KeyframeGraph) -> Any:
    """Lengths between keyframes, of their mean."""
    steps = np.linalg.norm(np.diff([graph.world_from_cam(k)[:3, 3] for k in range(VIEWS)], axis=0), axis=1)
    return steps / steps.mean()


def test_what_lies_between_two_jumps_is_mended_by_itself(scene: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    """The first keyframes and the last are at one scale, what is between them is small: the last stay as they are."""
    graph = chain(scene, 1.0)
    true, end = steps_of(graph), JUMP_AT + 7
    centre = graph.world_from_cam(JUMP_AT)[:3, 3]
    graph.transform_keyframes(range(JUMP_AT, end), Sim3(np.eye(3), 0.75 * centre, 0.25))
    first, second = sorted(scale_jumps(graph))
    assert first[1] < 1 < second[1]
    assert scale_jumps_module._leads_back([second, first], *first) == second[0]
    assert scale_jumps_module._leads_back([second, first], *second) is None
    assert scale_jumps_module._leads_back([(second[0], 20.0), first], *first) is None
    monkeypatch.setattr(scale_jumps_module, "scale_jumps", lambda _: [first, second])
    tried: list[tuple[int, int | None]] = []
    whole = scale_jumps_module._rescaled

    def seen(graph: KeyframeGraph, kf_id: int, ratio: float, end: int | None = None) -> bool:
        tried.append((kf_id, end))
        return whole(graph, kf_id, ratio, end)

    monkeypatch.setattr(scale_jumps_module, "_rescaled", seen)
    assert mend_scale_jumps(graph) >= 1
    assert tried[0] == (first[0], second[0])
    np.testing.assert_allclose(steps_of(graph), true, rtol=0.02)


def test_only_what_lies_before_the_end_is_brought_to_another_scale(scene: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    graph, costs = chain(scene, 1.0), iter([2.0, 1.0])
    monkeypatch.setattr(passages, "cost_around", lambda *_: next(costs))
    depths = {k: v.inv_depth.copy() for k, v in graph.variables.items()}
    assert scale_jumps_module._rescaled(graph, 5, 0.5, 9)
    for k, v in graph.variables.items():
        np.testing.assert_allclose(v.inv_depth, depths[k] * (0.5 if 5 <= k < 9 else 1.0))


def test_where_no_match_tells_the_scale_goes_on_as_before(scene: Any) -> None:
    graph = chain(scene, 0.2, across=0.0)
    assert len(scale_jumps(graph)) == 1 and mend_scale_jumps(graph) == 1
    before, after = steps_of(graph)[JUMP_AT - 3], steps_of(graph)[JUMP_AT + 2]
    assert after == pytest.approx(before, rel=0.5)
    assert scale_jumps(graph) == []


def test_a_jump_that_matches_tell_of_stays(scene: Any) -> None:
    """From the seventh on the camera is faster and sees farther, truly: the step between is held by its matches."""
    graph = chain(scene, 0.2, across=0.0)
    for i, j in ((JUMP_AT - 1, JUMP_AT), (JUMP_AT, JUMP_AT - 1), (JUMP_AT - 2, JUMP_AT), (JUMP_AT, JUMP_AT - 2)):
        points = scene.points(i) * (0.2 if i >= JUMP_AT else 1.0)
        there = transform(graph.variables[j].cam_from_world @ graph.world_from_cam(i), points)
        seen = replace(scene.matches(i, j), new_px=scene.pixels(there))
        graph.connect(i, j, seen, np.ones(len(points)) * (seen.weight > 0), followed=True)
    before = steps_of(graph)
    mend_scale_jumps(graph)
    np.testing.assert_allclose(steps_of(graph), before, rtol=0.05)


def test_what_costs_more_is_left_with_all_that_belongs_to_it(scene: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    graph, costs = chain(scene, 0.2, across=0.0), iter([1000.0, 1000.0 + 1.1 * UNTOLD])
    monkeypatch.setattr(passages, "cost_around", lambda *_: next(costs))
    kept = {k: (v.cam_from_world.copy(), v.inv_depth.copy(), v.prior_depth.copy()) for k, v in graph.variables.items()}
    assert mend_scale_jumps(graph) == 0
    for k, (pose, inv_depth, prior) in kept.items():
        v = graph.variables[k]
        np.testing.assert_allclose(v.inv_depth, inv_depth)
        np.testing.assert_allclose(v.prior_depth, prior)
        np.testing.assert_allclose(v.cam_from_world, pose)


def test_no_jump_is_seen_where_speed_alone_changes_or_depths_are_measured(scene: Any) -> None:
    graph = chain(scene, 1.0)
    assert scale_jumps(graph) == []
    for kf in graph.keyframes[JUMP_AT:]:  # the later ones came ten times as fast
        sooner = replace(kf.work, timestamp_s=0.7 + (kf.work.timestamp_s - 0.7) / 10)
        graph.keyframes[kf.id] = replace(kf, work=sooner)
    assert scale_jumps(graph) == []
    graph = chain(scene, 0.2)
    for v in graph.variables.values():
        v.prior_info = 100 / v.inv_depth**2
    assert graph.depths_measured and mend_scale_jumps(graph) == 0


def test_a_short_chain_has_no_two_sides() -> None:
    size = (64, 48)
    assert scale_jumps(KeyframeGraph(GraphConfig(), intrinsics_for(CameraConfig(), *size, size))) == []
