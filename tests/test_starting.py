"""The start of a submap: lens, poses and depths from matches alone, and keyframes that no start explains."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from mastd3r.config import CameraConfig, Config
from mastd3r.errors import InputError
from mastd3r.geometry.se3 import inverse, se3_log
from mastd3r.geometry.sim3 import procrustes
from mastd3r.graph.initialisation import bootstrap
from mastd3r.graph.keyframe_graph import KeyframeGraph
from mastd3r.graph.starting import drop_let_go, start_or_let_go
from mastd3r.offline.final_solve import finish_graph
from test_graph_keyframes import graph_of


@pytest.mark.parametrize(("focal_px", "k"), [(220.0, 0.0), (260.0, -0.05), (330.0, 0.0)])
def test_bootstrap_from_nothing(exact_scene: Callable[..., Any], focal_px: float, k: float) -> None:
    """Five keyframes, 0.2 px of noise, nothing known of lens or depth: near enough to go on from."""
    scene = exact_scene(5, step=0.2, focal_px=focal_px, k=k, cell_px=8)
    graph = graph_of(scene, 5, noise_px=0.2)
    assert bootstrap(graph).started and graph.initialised
    report = graph.solve_all(40, 0.5)
    assert np.exp(graph.intrinsics.values[0]) == pytest.approx(focal_px, rel=0.05)
    found = np.stack([graph.world_from_cam(i) for i in range(5)])
    truth = np.stack([scene.cam_from_world[0] @ inverse(scene.cam_from_world[i]) for i in range(5)])
    np.testing.assert_allclose(found[0], np.eye(4), atol=1e-12)  # the gauge: the world is the first camera
    fit = procrustes(truth[:, :3, 3], found[:, :3, 3], np.ones(5), with_scale=True)
    path = np.linalg.norm(np.diff(truth[:, :3, 3], axis=0), axis=1).sum()
    off = np.linalg.norm(fit.apply(found[:, :3, 3]) - truth[:, :3, 3], axis=1)
    assert off.max() < 0.05 * path and report.cost_last <= report.cost_first
    turns = [np.linalg.norm(se3_log(inverse(t) @ f)[3:]) for t, f in zip(truth, found, strict=True)]
    assert max(turns) < 0.03
    assert np.median([graph.median_inv_depth(i) for i in range(3)]) == pytest.approx(1.0)
    for i in range(5):
        seen = graph.variables[i].depth_info > 1
        ratio = fit.scale / graph.variables[i].inv_depth[seen] / scene.depth(i)[seen]
        assert np.median(np.abs(ratio - 1)) < 0.06


def test_bootstrap_leaves_out_what_moves_by_itself(exact_scene: Callable[..., Any]) -> None:
    """A fifth of the picture drifts across it, each of its matches in step with the others; nothing says so."""
    scene = exact_scene(5, step=0.15, focal_px=280.0, cell_px=8)
    graph = graph_of(scene, 5, noise_px=0.2)
    moves = (np.abs(scene.px - [120, 120]) < [42, 62]).all(1)
    assert 0.1 < moves.mean() < 0.2
    for e in graph.edges:
        e.target = e.target + moves[:, None] * (e.j - e.i) * np.array([2.0, 8.0])
    assert bootstrap(graph).started
    assert np.exp(graph.intrinsics.values[0]) == pytest.approx(280, rel=0.05)
    held = sum(e.weight[moves].sum() for e in graph.edges) / sum(e.weight.sum() for e in graph.edges)
    assert held < 0.02
    for kf in graph.keyframes:
        assert np.mean(kf.static[moves] < 0.5) > 0.9 and np.mean(kf.static[~moves] > 0.5) > 0.97
        assert kf.moving[120, 120] > 127 and kf.moving[20, 290] == 0


def test_bootstrap_with_a_given_lens_keeps_it(exact_scene: Callable[..., Any]) -> None:
    scene = exact_scene(5, step=0.2, focal_px=260.0)
    given = CameraConfig(intrinsics=(260.0, 260.0, 159.5, 119.5))
    graph = graph_of(scene, 5, noise_px=0.1, camera=given)
    assert bootstrap(graph).started
    assert np.exp(graph.intrinsics.values[0]) == pytest.approx(260.0) and graph.intrinsics.values[1] == 0.0
    assert (graph.solve_all(5, 1.0).focal_sigma_ratio) == np.inf


def test_bootstrap_says_no_without_matches(exact_scene: Callable[..., Any]) -> None:
    scene = exact_scene(3, step=0.2)
    graph = graph_of(scene, 3)
    graph.edges = []
    assert not bootstrap(graph).started and not graph.initialised


def test_keyframes_that_fit_no_scene_are_let_go_and_later_ones_started(exact_scene: Callable[..., Any]) -> None:
    """Matches anywhere before keyframe 8: no more than ten keyframes are ever solved, and those after it start."""
    scene = exact_scene(15, step=0.12)
    whole, rng = graph_of(scene, 15, noise_px=0.2), np.random.default_rng(1)
    graph = KeyframeGraph(whole.config, whole.intrinsics)
    most = 0
    for kf in whole.keyframes:
        graph.add_keyframe(
            kf.work, kf.static, kf.moving, np.eye(4), np.ones(len(kf.static)), np.full(len(kf.static), 1e-2)
        )
        graph.record(kf.work, kf.id, np.eye(4), "tracked", None, np.zeros(0))
        graph.replace_last_by_keyframe(graph.latest)
        for e in whole.edges:
            if max(e.i, e.j) == kf.id and abs(e.i - e.j) <= 3:
                wrong = rng.uniform(0, (scene.width, scene.height), e.target.shape).astype(np.float32)
                target = wrong if min(e.i, e.j) < 8 else e.target
                graph.edges.append(replace(e, target=target))
        most = max(most, len(graph.members()))
        if start_or_let_go(graph):
            break
    assert graph.initialised and most <= 2 * graph.config.bootstrap_keyframes
    assert graph.members()[0] >= 5
    gone = graph.members()[0]
    drop_let_go(graph)
    assert graph.members() == list(range(len(graph.keyframes))) and set(graph.submap_of.values()) == {graph.submap}
    assert [r.state for r in graph.records[:gone]] == ["lost"] * gone
    assert all(r.state == "tracked" for r in graph.records[gone:])


def test_a_camera_that_only_turns_is_not_let_go(exact_scene: Callable[..., Any]) -> None:
    """It is waited for, as long as no try costs anything."""
    scene = exact_scene(12, step=0.0)
    graph = graph_of(scene, 12, noise_px=0.05)
    assert not start_or_let_go(graph) and len(graph.members()) == 12


def test_a_video_that_no_camera_explains_is_refused_by_its_matches(exact_scene: Callable[..., Any]) -> None:
    """The line says how many fit, not that the camera stands still."""
    scene = exact_scene(5, step=0.2)
    graph, rng = graph_of(scene, 5), np.random.default_rng(2)
    for e in graph.edges:
        e.target[:] = rng.uniform(0, (scene.width, scene.height), e.target.shape)
    with pytest.raises(InputError, match=r"expected at least 40% of the matches .* got \d+% between 5 keyframes"):
        finish_graph(graph, Config())
