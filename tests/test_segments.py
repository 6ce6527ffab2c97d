"""Segments of a video: how it is cut, how pieces with worlds of their own become one, and whole runs that do so."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from mastd3r.cli.main import main
from mastd3r.config import CameraConfig, Config, GraphConfig, MappingConfig, SourceConfig
from mastd3r.errors import ConfigError, InputError
from mastd3r.geometry.se3 import inverse, se3_exp
from mastd3r.graph import merging
from mastd3r.graph.intrinsics import intrinsics_for
from mastd3r.graph.keyframe_graph import KeyframeGraph
from mastd3r.graph.merging import join_at_overlaps, one_record_a_frame, side_by_side, with_lost_frames
from mastd3r.offline import segmented
from mastd3r.offline.segmented import LEAST_FRAMES, OVERLAP_FRAMES, Segments, cut
from mastd3r.pipeline import reconstruct, resume
from mastd3r.sources import synthetic
from mastd3r.tasks.processes import Limits, Processes
from mastd3r.tasks.runner import Task

Array = NDArray[Any]
OTHER_WORLD = se3_exp(np.array([0.4, -0.7, 1.1, 0.5, -0.8, 0.3]))
SCALE = 2.6  # lengths of the first piece a length of the second
VIEWS, FIRST_END, SECOND_START = 16, 10, 4


# -- how a video is cut ------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("length", "frames"), [(1000, 100), (1059, 100), (1060, 100), (130, 60), (5000, 777)])
def test_pieces_cover_the_video_and_share_their_ends(length: int, frames: int) -> None:
    source = SourceConfig(start=7, stride=3)
    pieces = cut(Config(source=source), length, Segments(frames))
    assert pieces is not None and "as asked for" in pieces.said
    taken = [set(range(w.start, w.end or 0, w.stride)) for w in pieces.windows]
    assert set().union(*taken) == set(range(7, 7 + 3 * length, 3))
    assert all(len(a & b) == OVERLAP_FRAMES for a, b in pairwise(taken))
    assert all(frames <= len(t) <= frames + OVERLAP_FRAMES + LEAST_FRAMES for t in taken[:-1])
    assert len(taken[-1]) >= LEAST_FRAMES


def test_a_video_is_cut_only_where_asked_or_too_long(monkeypatch: pytest.MonkeyPatch) -> None:
    assert cut(Config(), 100, Segments(100)) is None
    monkeypatch.setattr(segmented, "total_memory_mib", lambda: 8000)
    assert cut(Config(), 3000, Segments()) is None
    long = cut(Config(), 100_000, Segments())
    assert (
        long is not None and len(long.windows) > 1 and "100000 frames need about 25700 MiB, more than 4000" in long.said
    )
    assert cut(replace(Config(), mapping=MappingConfig(realtime=True)), 100_000, Segments()) is None
    assert cut(Config(), None, Segments()) is None
    with pytest.raises(InputError, match="number of frames is known"):
        cut(Config(), None, Segments(100))
    with pytest.raises(ConfigError, match="--segment-frames: expected 60 or more, got 5"):
        Segments(5)
    with pytest.raises(ConfigError, match="--realtime"):
        Segments(100).check(replace(Config(), mapping=MappingConfig(realtime=True)))


# -- pieces of which everything is known -------------------------------------------------------------------------


def piece(scene: Any, views: range, world: Array, scale: float, every: int = 3) -> KeyframeGraph:
    """Views as if tracked by themselves: every third is a keyframe, the others hang on the one before."""
    size = (scene.width, scene.height)
    graph = KeyframeGraph(GraphConfig(), intrinsics_for(CameraConfig(), *size, size))
    graph.intrinsics.values, graph.intrinsics.prior = scene.lens.copy(), scene.lens.copy()
    graph.started.add(0)
    p = len(scene.px)
    for n, view in enumerate(views):
        work = scene.work_frame(view)
        if n % every == 0:
            inv_depth = scale / scene.depth(view)
            pose = scene.cam_from_world[view] @ inverse(world)
            pose[:3, 3] /= scale
            kf = graph.add_keyframe(
                work, np.ones(p), np.zeros((scene.height, scene.width)), pose, inv_depth, inv_depth * 0
            )
            graph.variables[kf.id].depth_info = 1e6 / inv_depth**2
            graph.record(work, kf.id, np.eye(4), "tracked", None, np.zeros(0))
            graph.replace_last_by_keyframe(kf)
            near = view
        else:
            step = scene.j_from_i(near, view).copy()
            step[:3, 3] /= scale
            matches = scene.matches(near, view)
            graph.record(work, kf.id, step, "tracked", matches, matches.weight)
    return graph


def two_pieces(scene: Any) -> list[KeyframeGraph]:
    second = piece(scene, range(SECOND_START, VIEWS), OTHER_WORLD, SCALE)
    return [piece(scene, range(FIRST_END), np.eye(4), 1.0), second]


def off(graph: KeyframeGraph, scene: Any) -> float:
    """The largest difference of a frame's pose from the truth, in the world of the first piece."""
    poses = {r.index: r.cam_from_kf @ graph.variables[r.kf_id].cam_from_world for r in graph.records}
    return max(float(np.abs(poses[k] - scene.cam_from_world[k]).max()) for k in poses)


def test_pieces_come_into_the_world_of_the_first(exact_scene: Callable[..., Any]) -> None:
    scene = exact_scene(VIEWS)
    merged = side_by_side(two_pieces(scene))
    (joint,) = join_at_overlaps(merged)
    one_record_a_frame(merged)
    graph = merged.graph
    assert graph.started == {0} and set(graph.submap_of.values()) == {0}
    assert [kf.id for kf in graph.keyframes] == list(range(len(graph.keyframes)))
    assert [r.index for r in graph.records] == list(range(VIEWS))
    assert joint.frames == FIRST_END - SECOND_START and joint.scale == pytest.approx(SCALE, rel=2e-3)
    assert off(graph, scene) < 0.02  # points of two pieces are compared within five pixels, on a wall that bends
    keyframes = {r.index for r in graph.records if r.is_keyframe}
    assert keyframes == {0, 3, 6, 9} | {4, 7, 10, 13}


def test_a_few_frames_that_are_wrong_change_nothing(exact_scene: Callable[..., Any]) -> None:
    scene = exact_scene(VIEWS)
    pieces = two_pieces(scene)
    wrong = se3_exp(np.array([0.5, 0.2, -0.4, 0.4, 0.3, 0.1]))
    for r in [r for r in pieces[1].records if r.index in (5, 8)]:
        r.cam_from_kf = wrong @ r.cam_from_kf
    merged = side_by_side(pieces)
    assert len(join_at_overlaps(merged)) == 1
    keyframes = {k: v.cam_from_world for k, v in merged.graph.variables.items()}
    assert all(
        np.abs(keyframes[kf.id] - scene.cam_from_world[kf.work.index]).max() < 0.05 for kf in merged.graph.keyframes
    )


def test_pieces_that_do_not_agree_stay_apart(exact_scene: Callable[..., Any]) -> None:
    scene = exact_scene(VIEWS)
    pieces = two_pieces(scene)
    rng = np.random.default_rng(0)
    for r in pieces[1].records:
        r.cam_from_kf = se3_exp(rng.normal(0, 0.3, 6)) @ r.cam_from_kf
    merged = side_by_side(pieces)
    assert join_at_overlaps(merged) == [] and merged.graph.started == {0, 1}
    apart = side_by_side([piece(scene, range(5), np.eye(4), 1.0), piece(scene, range(8, VIEWS), OTHER_WORLD, SCALE)])
    assert join_at_overlaps(apart) == []


def test_all_get_the_lens_of_the_piece_that_knows_it_best(exact_scene: Callable[..., Any]) -> None:
    scene = exact_scene(VIEWS)
    pieces = two_pieces(scene)
    for n, sigma in enumerate((0.02, 0.01)):
        pieces[n].last_report = merging_report(sigma)
    pieces[0].intrinsics.values = scene.lens + np.r_[0.2, np.zeros(5)]
    merged = side_by_side(pieces)
    assert np.allclose(merged.graph.intrinsics.values, scene.lens)
    assert merged.graph.intrinsics.free[0]  # and it may still move


def merging_report(sigma: float) -> Any:
    from mastd3r.graph.bundle_adjustment import SolveReport

    return SolveReport(1, True, 1.0, 1.0, sigma)


def test_a_piece_without_depth_and_one_that_is_missing_leave_lost_frames(exact_scene: Callable[..., Any]) -> None:
    scene = exact_scene(VIEWS)
    pieces = [piece(scene, range(5), np.eye(4), 1.0), piece(scene, range(5, 9), np.eye(4), 1.0)]
    pieces[1].started.clear()
    merged = side_by_side(pieces)
    one_record_a_frame(merged)
    assert len(merged.graph.keyframes) == 2 and [r.state for r in merged.graph.records[5:]] == ["lost"] * 4
    assert with_lost_frames(merged.graph, [(k, k / 30) for k in range(VIEWS)]) == VIEWS - 9
    assert [r.index for r in merged.graph.records] == list(range(VIEWS))
    assert {r.state for r in merged.graph.records[9:]} == {"lost"} and merging.NOTHING["points"].size == 0


# -- whole runs --------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def clip(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """60 frames of the made room, TUM layout."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(synthetic, "CLIP_FPS", 10.0)
        return synthetic.make_room_clip(tmp_path_factory.mktemp("clips") / "room", frames=60, width=160, height=120)


@pytest.fixture
def short(monkeypatch: pytest.MonkeyPatch) -> None:
    """Segments of a few frames, which the made clip has enough motion for."""
    monkeypatch.setattr(segmented, "LEAST_FRAMES", 10)
    monkeypatch.setattr(segmented, "OVERLAP_FRAMES", 10)


class Killing(Processes):
    """Kills one task's first attempt."""

    def give(self, task: Task, attempt: int, need_mib: float) -> None:
        super().give(task, attempt, need_mib)
        if task.name == "001" and attempt == 1:
            self._running[-1].child.process.kill()


LISTS = ("rgb.txt", "groundtruth.txt")
NO_MAP = replace(Config(), mapping=MappingConfig(enabled=False))


def record_of(run: Path) -> dict[str, Any]:
    record: dict[str, Any] = json.loads((run / "run.json").read_text())
    return record


@pytest.mark.slow
@pytest.mark.usefixtures("short")
def test_a_run_in_segments_is_as_good_and_a_killed_task_costs_an_attempt(clip: Path, tmp_path: Path) -> None:
    whole = reconstruct(clip, tmp_path / "whole", NO_MAP)
    pieces = Segments(25, elsewhere=lambda folder: Killing(Limits(2, 4000)))
    run = reconstruct(clip, tmp_path / "run", NO_MAP, segments=pieces)
    record = record_of(tmp_path / "run")
    assert record["status"] == "complete" and record["segments"]["windows"] == [[0, 35], [25, 60]]
    assert len(record["segments"]["joints"]) == 1 and record["segments"]["failed"] == []
    assert run.metrics["frames_tracked"] == 60 == whole.metrics["frames_tracked"]
    assert run.metrics["ate_rmse_all"] < 1.3 * whole.metrics["ate_rmse_all"] + 0.002
    assert not (tmp_path / "run" / "segments").exists() and not (tmp_path / "run" / "checkpoint").exists()
    assert any(c.startswith("segments: 2 of 25 frames") for c in record["choices"])


@pytest.mark.slow
@pytest.mark.usefixtures("short")
def test_a_segment_that_fails_costs_its_frames_alone(clip: Path, tmp_path: Path) -> None:
    class Failing(Processes):
        def give(self, task: Task, attempt: int, need_mib: float) -> None:
            broken = replace(task, argv=lambda n: ["false"]) if task.name == "001" else task
            super().give(broken, attempt, need_mib)

    pieces = Segments(20, elsewhere=lambda folder: Failing(Limits(2, 4000)))
    run = reconstruct(clip, tmp_path / "run", NO_MAP, segments=pieces)
    record = record_of(tmp_path / "run")
    assert record["status"] == "complete"
    (line,) = record["segments"]["failed"]
    assert line.startswith("segment of frames 20 to 50 failed: ") and line in record["choices"]
    assert run.metrics["frames_tracked"] == 50 and run.metrics["frames_posed"] == 60


@pytest.mark.slow
@pytest.mark.usefixtures("short")
def test_segments_that_were_tracked_are_kept_for_the_same_command(clip: Path, tmp_path: Path) -> None:
    out = tmp_path / "run"

    class Stopping(Processes):
        def give(self, task: Task, attempt: int, need_mib: float) -> None:
            if task.name == "001":
                raise KeyboardInterrupt
            super().give(task, attempt, need_mib)

        def has_room(self, need_mib: float) -> bool:
            return not self._running

    with pytest.raises(KeyboardInterrupt):
        reconstruct(clip, out, NO_MAP, segments=Segments(25, elsewhere=lambda folder: Stopping(Limits(1, 4000))))
    assert record_of(out)["status"] == "incomplete"
    (first,) = out.glob("segments/*/000")
    before = sorted(p.name for p in (first / "checkpoint").iterdir())
    with pytest.raises(InputError, match="got none: "):
        reconstruct(clip, out, NO_MAP, segments=Segments(25, elsewhere=NoneRuns))
    assert sorted(p.name for p in (first / "checkpoint").iterdir()) == before
    run = resume(out)  # run.json says that it was in segments
    assert run.metrics["frames_tracked"] == 60 and len(record_of(out)["segments"]["joints"]) == 1
    assert not (out / "segments").exists()


class Useless(Processes):
    """Every task ends well and leaves nothing."""

    def __init__(self, folder: Path) -> None:
        super().__init__(Limits(2, 4000))

    def give(self, task: Task, attempt: int, need_mib: float) -> None:
        super().give(replace(task, argv=lambda n: ["true"]), attempt, need_mib)


@pytest.mark.usefixtures("short")
def test_a_segment_that_left_nothing_is_named(clip: Path, tmp_path: Path) -> None:
    with pytest.raises(InputError, match="expected what a segment leaves, written by version"):
        reconstruct(clip, tmp_path / "run", NO_MAP, segments=Segments(25, elsewhere=Useless))
    assert record_of(tmp_path / "run")["status"] == "incomplete"


class NoneRuns(Processes):
    """Every task fails at once."""

    def __init__(self, folder: Path) -> None:
        super().__init__(Limits(2, 4000))

    def give(self, task: Task, attempt: int, need_mib: float) -> None:
        super().give(replace(task, argv=lambda n: ["false"]), attempt, need_mib)


def test_bad_options_are_one_line(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "in").mkdir()
    words = ["run", str(tmp_path / "in"), "--out", str(tmp_path / "out")]
    for more, said in (
        (["--segment-frames", "5"], "--segment-frames: expected 60 or more, got 5"),
        (["--segment-frames", "100", "--realtime"], "expected a map after tracking, got --realtime"),
        (["--segment-frames", "100", "--jobs", "0"], "--jobs: expected 1 or more"),
        (["--segment-frames", "100", "--task-cores", "2"], "expected --ray with them"),
    ):
        assert main([*words, *more]) == 2
        err = capsys.readouterr().err
        assert said in err and err.count("mastd3r: ") == 1
    assert not (tmp_path / "out").exists()


@pytest.mark.slow
@pytest.mark.usefixtures("short")
def test_a_segment_in_which_the_camera_stands_still_is_placed_by_the_others(clip: Path, tmp_path: Path) -> None:
    """By itself it has no depth, and what it might make up would be wrong."""
    longer = tmp_path / "clip"
    (longer / "rgb").mkdir(parents=True)
    rows = {n: [line.split() for line in (clip / n).read_text().splitlines() if line[0] != "#"] for n in LISTS}
    images, poses = rows["rgb.txt"], rows["groundtruth.txt"]
    for n in range(85):
        (longer / "rgb" / f"{n:03d}.png").symlink_to(clip / images[min(n, 59)][1])
    (longer / "rgb.txt").write_text("".join(f"{n / 10:.6f} rgb/{n:03d}.png\n" for n in range(85)))
    truth = (" ".join([f"{n / 10:.6f}", *poses[min(n, 59)][1:]]) for n in range(85))
    (longer / "groundtruth.txt").write_text("\n".join(truth) + "\n")
    run = reconstruct(longer, tmp_path / "run", NO_MAP, segments=Segments(30))
    record = record_of(tmp_path / "run")
    assert [w[0] for w in record["segments"]["windows"]] == [0, 30, 60] and record["segments"]["failed"] == []
    assert run.metrics["frames_tracked"] == 85 and run.metrics["ate_rmse_all"] < 0.03
