"""Submaps: what was cut is joined again, the rest is placed by continuity; whole runs that lose the camera."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import cache
from itertools import islice
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from mastd3r.config import CameraConfig, Config, GraphConfig, TrackingConfig
from mastd3r.geometry.se3 import inverse, se3_exp, se3_log, transform
from mastd3r.geometry.sim3 import Sim3, procrustes
from mastd3r.graph.intrinsics import intrinsics_for
from mastd3r.graph.keyframe_graph import KeyframeGraph
from mastd3r.graph.submaps import join, with_scale
from mastd3r.offline.final_solve import FinalFrame, final_frames, finish_graph
from mastd3r.parts import Parts, build_parts
from mastd3r.slam import Slam, TrackResult
from mastd3r.sources import synthetic
from mastd3r.sources.room import camera_pose
from mastd3r.sources.synthetic import SyntheticView
from mastd3r.tracking.state import Status
from mastd3r.types import Frame

Array = NDArray[Any]
VIEWS, CUT = 10, 5
B_FROM_A = se3_exp(np.array([0.4, -0.7, 1.1, 0.5, -0.8, 0.3]))  # the second part's own world
SCALE = 2.6  # lengths of the first part per length of the second


def world_from(scene: Any, k: int) -> Array:
    return scene.cam_from_world[0] @ inverse(scene.cam_from_world[k])


def keyframe(
    graph: KeyframeGraph, scene: Any, view: int, time_s: float, cam_from_world: Array, inv_depth: Array
) -> int:
    """Add a keyframe of which everything is known; its number."""
    p = len(scene.px)
    work = replace(scene.work_frame(view), timestamp_s=time_s)
    moving = np.zeros((scene.height, scene.width))
    kf = graph.add_keyframe(work, np.ones(p), moving, cam_from_world, inv_depth, 1e-2 / inv_depth**2)
    graph.variables[kf.id].depth_info = 1e6 / inv_depth**2  # sure to a thousandth
    graph.record(work, kf.id, np.eye(4), "tracked", None, np.zeros(0))
    graph.replace_last_by_keyframe(kf)
    return kf.id


def cut_graph(scene: Any, scale: float = SCALE, b_from_a: Array = B_FROM_A) -> KeyframeGraph:
    """True keyframes 0 … 4 in one world, 5 … 9 in another one with lengths of its own; a frame hangs on 2 and on 7."""
    size = (scene.width, scene.height)
    graph = KeyframeGraph(GraphConfig(), intrinsics_for(CameraConfig(), *size, size))
    graph.intrinsics.values, graph.intrinsics.prior = scene.lens.copy(), scene.lens.copy()
    for k in range(VIEWS):
        if k == CUT:
            graph.start_submap()
        pose = inverse(world_from(scene, k))
        if k >= CUT:
            pose = pose @ inverse(b_from_a)
            pose[:3, 3] /= scale
        unit = scale if k >= CUT else 1.0
        keyframe(graph, scene, k, k / 30, pose, unit / scene.depth(k))
        if k in (2, 7):
            step = se3_exp(np.array([0.02, 0.01, -0.03, 0.01, 0.02, 0.0]))
            step[:3, 3] /= unit
            work = replace(scene.work_frame(100 + k), timestamp_s=(k + 0.5) / 30)
            graph.record(work, k, step, "tracked", scene.matches(k, k + 1), np.ones(len(scene.px)))
        graph.started.add(graph.submap)
    for first in (0, CUT):
        for i in range(first, first + CUT - 1):
            graph.connect(i, i + 1, scene.matches(i, i + 1), np.ones(len(scene.px)))
            graph.connect(i + 1, i, scene.matches(i + 1, i), np.ones(len(scene.px)))
    return graph


@pytest.fixture(scope="module")
def scene(exact_scene: Callable[..., Any]) -> Any:
    return exact_scene(VIEWS, step=0.08, cell_px=10)


# -- joining -------------------------------------------------------------------------------------------------------


def test_a_cut_graph_is_two_submaps(scene: Any) -> None:
    graph = cut_graph(scene)
    assert graph.members(0) == [0, 1, 2, 3, 4] and graph.members(1) == graph.members() == [5, 6, 7, 8, 9]
    assert graph.roots() == [0, 5] and graph.started == {0, 1} and graph.initialised
    part = graph.part()
    assert [kf.id for kf in part.keyframes] == [5, 6, 7, 8, 9] and list(part.variables) == [5, 6, 7, 8, 9]
    assert {(e.i, e.j) for e in part.edges} == {(i, j) for i in range(5, 10) for j in (i - 1, i + 1) if 5 <= j < 10}
    assert part.variables[6] is graph.variables[6] and all(r.kf_id >= CUT for r in part.records)
    assert graph.connected(1, 2) and not graph.connected(4, 5)


@pytest.mark.parametrize("scale", [0.3, 1.0, 2.6])
@pytest.mark.parametrize(("i", "j"), [(4, 5), (3, 6), (2, 9)])
def test_the_scale_between_two_submaps(scene: Any, i: int, j: int, scale: float) -> None:
    """To 1 %, though the depths compared are of the nearest cell and not of the same pixel."""
    graph = cut_graph(scene, scale)
    matches = scene.matches(i, j, 0.3)
    found = with_scale(graph, i, j, scene.j_from_i(i, j), matches, matches.weight)
    assert found is not None and 1 / found.scale == pytest.approx(scale, rel=0.01)
    np.testing.assert_allclose(
        found.apply(scene.points(i)), transform(scene.j_from_i(i, j), scene.points(i)) / scale, rtol=0.02
    )


def test_a_third_of_wrong_matches_does_not_move_the_scale(scene: Any) -> None:
    graph, matches = cut_graph(scene), scene.matches(4, 5)
    wrong = np.random.default_rng(0).random(len(scene.px)) < 0.33
    graph.variables[4].inv_depth = np.where(wrong, 0.3, 1.0) * graph.variables[4].inv_depth
    graph.variables[4].depth_info = graph.variables[4].depth_info * 100
    found = with_scale(graph, 4, 5, scene.j_from_i(4, 5), matches, matches.weight)
    assert found is not None and 1 / found.scale == pytest.approx(SCALE, rel=0.05)


def test_no_scale_where_too_little_is_known(scene: Any) -> None:
    matches = scene.matches(4, 5)
    args = scene.j_from_i(4, 5), matches
    assert with_scale(cut_graph(scene), 4, 5, *args, np.zeros(len(scene.px))) is None
    for unknown in (4, 5):
        graph = cut_graph(scene)
        graph.variables[unknown].depth_info = np.zeros(len(scene.px))
        graph.variables[unknown].prior_info = np.full(len(scene.px), 1e-6)
        assert with_scale(graph, 4, 5, *args, matches.weight) is None
    few = matches.weight * (np.cumsum(matches.weight) <= 19)
    assert with_scale(cut_graph(scene), 4, 5, *args, few) is None


@pytest.mark.parametrize("current", [0, 1])
def test_joining_puts_everything_where_it_belongs(scene: Any, current: int) -> None:
    graph = cut_graph(scene)
    graph.submap = current
    info = graph.variables[7].depth_info.copy() * graph.variables[7].inv_depth ** 2
    graph.variables[8].prior_depth = 1.1 * graph.variables[8].inv_depth
    join(graph, 3, 6, Sim3.from_rigid(scene.j_from_i(3, 6)).in_lengths(1 / SCALE))
    for k in range(VIEWS):
        np.testing.assert_allclose(graph.world_from_cam(k), world_from(scene, k), atol=1e-6)
        np.testing.assert_allclose(graph.variables[k].inv_depth, 1 / scene.depth(k), rtol=1e-9)
    np.testing.assert_allclose(graph.variables[8].prior_depth, 1.1 / scene.depth(8), rtol=1e-9)
    np.testing.assert_allclose(graph.variables[7].depth_info * graph.variables[7].inv_depth ** 2, info, rtol=1e-9)
    step = se3_exp(np.array([0.02, 0.01, -0.03, 0.01, 0.02, 0.0]))
    hanging = [r for r in graph.records if not r.is_keyframe]
    assert [r.kf_id for r in hanging] == [2, 7]
    for r in hanging:
        np.testing.assert_allclose(r.cam_from_kf, step, atol=1e-12)
    assert graph.members(0) == list(range(VIEWS)) and graph.roots() == [0]
    assert graph.started == {0} and graph.submap == 0 and graph.initialised


def test_a_join_changes_no_residual_within_either_part(scene: Any) -> None:
    """Matches within a submap do not see its world or its unit: all stay explained."""
    graph = cut_graph(scene)
    assert graph.solve_all(1, 1.0).cost_first < 1e-3
    graph = cut_graph(scene)
    join(graph, 3, 6, Sim3.from_rigid(scene.j_from_i(3, 6)).in_lengths(1 / SCALE))
    assert graph.solve_all(1, 1.0).cost_first < 1e-3


def test_roots_hold_every_submap_where_it_is(scene: Any) -> None:
    graph = cut_graph(scene)
    before = [graph.variables[k].cam_from_world.copy() for k in graph.roots()]
    rng = np.random.default_rng(0)
    for k in (2, 7):
        graph.variables[k].cam_from_world = se3_exp(rng.normal(0, 0.01, 6)) @ graph.variables[k].cam_from_world
    report = graph.solve_all(10, 1.0)
    assert report.cost_last < 0.01 * report.cost_first
    for k, pose in zip(graph.roots(), before, strict=True):
        np.testing.assert_allclose(graph.variables[k].cam_from_world[:3, :3], pose[:3, :3], atol=1e-12)


# -- dropping and bridging -----------------------------------------------------------------------------------------


def test_dropping_the_newest_submap_leaves_contiguous_numbers(scene: Any) -> None:
    graph = cut_graph(scene)
    records = list(graph.records)
    graph.drop_submap()
    assert [kf.id for kf in graph.keyframes] == list(range(CUT)) == sorted(graph.variables) == sorted(graph.submap_of)
    assert all(e.i < CUT and e.j < CUT for e in graph.edges) and len(graph.edges) == 8
    assert graph.records == records and graph.started == {0} and not graph.initialised
    for r in records:
        late = r.index >= CUT and r.index != 102
        assert (r.state == "lost") == late and r.kf_id < CUT
        assert not late or (not r.is_keyframe and len(r.points) == len(r.target) == len(r.weight) == 0)
    graph.start_submap()
    assert graph.submap == 1
    k = keyframe(graph, scene, 5, 1.0, np.eye(4), 1 / scene.depth(5))
    assert k == CUT and graph.submap_of[k] == 1 and graph.members() == [k]


# -- whole runs ----------------------------------------------------------------------------------------------------


@dataclass
class Room:
    """The name and the size of a source, for the parts."""

    size: tuple[int, int] = (240, 180)
    name: str = "room"
    has_depth: bool = False
    has_semantic: bool = False


@dataclass
class Played:
    """A run over frames of the room."""

    slam: Slam
    steps: list[TrackResult]
    final: list[FinalFrame]
    truth: Array  # (n, 4, 4)

    def fit(self, by: Array) -> Sim3:
        """The similarity that brings what was found to the truth, over the frames in ``by`` (n,) bool."""
        found = np.stack([f.world_from_cam[:3, 3] for f in self.final])
        return procrustes(self.truth[:, :3, 3], found, by.astype(float), with_scale=True)

    def off_m(self, by: Array) -> Array:
        """(n,) distance from the truth after that."""
        found = np.stack([f.world_from_cam[:3, 3] for f in self.final])
        return np.asarray(np.linalg.norm(self.fit(by).apply(found) - self.truth[:, :3, 3], axis=1))

    def ate_ratio(self, by: Array) -> float:
        """Root mean square of that distance over those frames / length of the whole path."""
        return float(np.sqrt((self.off_m(by)[by] ** 2).mean()) / self.path_m)

    @property
    def path_m(self) -> float:
        return float(np.linalg.norm(np.diff(self.truth[:, :3, 3], axis=0), axis=1).sum())


@cache
def _walk(pose: Callable[[float], Array]) -> tuple[Iterator[SyntheticView], list[SyntheticView]]:
    """Frames still to be made, and those made so far."""
    return synthetic.synthetic_frames(1000, *Room.size), []


def views_of(count: int, pose: Callable[[float], Array] = camera_pose) -> list[SyntheticView]:
    """Frames of the room at 10 a second: enough way for a dozen keyframes. Made once for all tests; read only."""
    to_come, made = _walk(pose)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(synthetic, "CLIP_FPS", 10.0)
        patch.setattr(synthetic, "camera_pose", pose)
        made += islice(to_come, max(0, count - len(made)))
    return made[:count]


@pytest.fixture(scope="module")
def room() -> list[SyntheticView]:
    return views_of(60)


def play(views: list[SyntheticView], dark: range = range(0), motion_ratio: float = 0.03) -> Played:
    """Track the views in this order at 10 a second; those in ``dark`` are black. Keyframes lie closer than usual."""
    t = TrackingConfig(
        keyframe_motion_ratio=motion_ratio, first_motion_ratio=0.03, known_motion_ratio=0.67 * motion_ratio
    )
    config = replace(Config(), pointmaps="geometric", semantics="none", tracking=t)
    parts: Parts = build_parts(config, Room())  # type: ignore[arg-type]
    slam = Slam(config, Room.size, parts=parts)
    steps = []
    for n, view in enumerate(views):
        image = np.zeros_like(view.frame.image) if n in dark else view.frame.image
        steps.append(slam.track(Frame(n, n / 10, image)))
    slam.end_tracking()
    finish_graph(slam.graph, config)
    return Played(slam, steps, final_frames(slam.graph), np.stack([v.world_from_cam for v in views]))


def test_fifteen_black_frames_in_the_middle(room: list[SyntheticView]) -> None:
    """Every frame has a pose, the black ones' are interpolated, and the camera is found again behind them."""
    dark = range(24, 39)
    run = play(room, dark)
    assert len(run.final) == 60 and all(np.isfinite(f.world_from_cam).all() for f in run.final)
    assert [f.state == "interpolated" for f in run.final] == [n in dark for n in range(60)]
    assert [s.state == "lost" for s in run.steps] == [n in dark for n in range(60)]
    assert set(run.slam.graph.submap_of.values()) == {0}  # found in the map that there was
    seen = np.array([n not in dark for n in range(60)])
    assert run.ate_ratio(seen) < 0.005
    assert run.off_m(seen)[~seen].max() < 0.08 * run.path_m  # a straight line through 1.5 s of a bent way


def test_forward_and_back_uses_the_keyframes_there_are(room: list[SyntheticView]) -> None:
    """The way back adds less than a fifth of the keyframes of the way there, and ends where it began: to 1/1000."""
    there_views = room[:36]  # the path turns round by itself behind that
    run = play([*there_views, *there_views[-2::-1]])
    assert {s.state for s in run.steps} <= {Status.INITIALISING, Status.TRACKING}
    there = sum(r.is_keyframe for r in run.slam.graph.records[:36])
    back = sum(r.is_keyframe for r in run.slam.graph.records[36:])
    assert there >= 7 and back < 0.2 * there
    every = np.ones(len(run.final), bool)
    first, last = run.final[0].world_from_cam, run.final[-1].world_from_cam
    assert run.fit(every).scale * np.linalg.norm(last[:3, 3] - first[:3, 3]) < 0.001 * run.path_m
    assert np.linalg.norm(se3_log(inverse(first) @ last)[3:]) < 0.002
    assert run.ate_ratio(every) < 0.005


def turning_away(time_s: float) -> Array:
    """30 frames as ever, then a jerk by 100 degrees, and slowly back to where the camera was."""
    n = 10 * time_s
    away_deg = 0.0 if n < 30 else max(100 - 3.0 * (n - 30), 0.0)
    pose = camera_pose(time_s if n < 30 else max(3.0 - 0.06 * (n - 30), 0.1))
    return pose @ se3_exp(np.array([0, 0, 0, 0, np.deg2rad(away_deg), 0]))


@pytest.fixture(scope="module")
def jerk() -> list[SyntheticView]:
    return views_of(64, turning_away)


def test_a_jerk_starts_a_submap_which_is_joined_when_the_place_is_seen_again(jerk: list[SyntheticView]) -> None:
    """Then one map holds all of it, to 1/200 of the path."""
    run = play(jerk, motion_ratio=0.1)
    assert [s.index for s in run.steps if s.reason] == [0, 30]
    assert run.steps[30].reason.startswith("the view before it cannot be followed")
    assert run.steps[29].submap == 0 and run.steps[30].submap == 1
    assert {f.state for f in run.final} <= {"started", "tracked"}
    assert set(run.slam.graph.submap_of.values()) == {0} and run.slam.graph.started == {0}
    every = np.ones(64, bool)
    assert run.ate_ratio(every) < 0.005


def test_a_submap_that_is_never_seen_again_is_placed_by_continuity(jerk: list[SyntheticView]) -> None:
    """No pose tells of a jerk that nothing saw: it starts where the camera was going, and has about the right size."""
    run = play(jerk[:38], motion_ratio=0.1)
    states = [f.state for f in run.final]
    assert "interpolated" not in states[:30] and set(states[30:]) == {"interpolated"}
    found = np.stack([f.world_from_cam for f in run.final])
    assert np.isfinite(found).all() and set(run.slam.graph.submap_of.values()) == {0}
    known = np.arange(38) < 30
    assert run.ate_ratio(known) < 0.005
    assert run.off_m(known)[30] < 0.03 * run.path_m
    way, truth = (float(np.linalg.norm(np.diff(p[30:, :3, 3], axis=0), axis=1).sum()) for p in (found, run.truth))
    assert 1 / 3 < run.fit(known).scale * way / truth < 3.0
