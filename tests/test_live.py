"""Live runs: frames are dropped and counted, every end leaves a whole run, and what was kept can be finished."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

import mastd3r
from mastd3r.cli.main import main
from mastd3r.config import SourceConfig, with_override
from mastd3r.errors import InputError, OutputError
from mastd3r.evaluation.trajectory_error import ate_rmse
from mastd3r.export.trajectory_files import read_tum
from mastd3r.graph.keyframe_graph import Keyframe, KeyframeGraph
from mastd3r.live import CameraOptions, LiveFrame, LiveLoop, open_camera, run_live
from mastd3r.live.warm import warm_up
from mastd3r.slam import Slam
from mastd3r.sources import open_source
from mastd3r.sources.camera import CameraFrame
from mastd3r.tracking.live_keyframes import LiveKeyframes
from mastd3r.types import StaticCloud, Trajectory

Array = NDArray[Any]
NO_MAP = with_override(mastd3r.Config(), "mapping.enabled=false")
SHORT = with_override(NO_MAP, "tracking.first_motion_ratio=0.01")  # for clips that hardly move
EARLY = with_override(NO_MAP, "graph.bootstrap_keyframes=3")  # so that a short clip has frames after its start


def record_of(out: Path) -> dict[str, Any]:
    record: dict[str, Any] = json.loads((out / "run.json").read_text())
    return record


@pytest.fixture(scope="module", autouse=True)
def cold() -> Iterator[None]:
    """Loops of these tests do not warm up; one test does."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("mastd3r.live.loop.warm_up", lambda *_: True)
        yield


class Patient:
    """A camera that waits: the next frame comes when all work of the last is done, as on a fast machine."""

    name, kind, state = "clip", "test", "open"
    timeout_s: float | None = None
    calibration: tuple[float, ...] = ()
    focal_hint_px: float | None = None

    def __init__(self, clip: Path, count: int = 24) -> None:
        source = open_source(clip, SourceConfig(end=count), want_semantic=False)
        self.clip, self.size = list(source.frames()), source.size
        self.said, self.notes = list[str](), list[str]()
        self.loop: LiveLoop | None = None

    def frames(self) -> Any:
        for n, frame in enumerate(self.clip):
            while self.loop is not None and (self.loop.tracked < n or self._busy(self.loop)):
                time.sleep(0.001)
            yield CameraFrame(frame.timestamp_s, frame.image, time.perf_counter())

    def close(self) -> None:
        pass

    def _busy(self, loop: LiveLoop) -> bool:
        pending = loop.slam.keyframes._pending
        return pending is not None and not pending.ready()


class View:
    """Who looks on."""

    def __init__(self) -> None:
        self.frames: list[LiveFrame] = []
        self.clouds: list[tuple[StaticCloud, Array]] = []

    def frame(self, seen: LiveFrame) -> None:
        self.frames.append(seen)

    def cloud(self, cloud: StaticCloud, times_s: Array, path: Array) -> None:
        assert len(times_s) == len(path) and (np.diff(times_s) > 0).all()
        self.clouds.append((cloud, path))


def live_run(camera: Patient, out: Path, config: mastd3r.Config, **how: Any) -> mastd3r.Reconstruction:
    """``run_live`` of a camera that waits for it."""
    init = LiveLoop.__init__

    def with_camera(self: LiveLoop, *args: Any, **kwargs: Any) -> None:
        init(self, *args, **kwargs)
        camera.loop = self

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("mastd3r.live.run.open_camera", lambda *_: camera)
        patch.setattr("mastd3r.live.run.CLOUD_EVERY_S", 0.0)
        patch.setattr(LiveLoop, "__init__", with_camera)
        return run_live("clip", out, config, **how)


@pytest.fixture(scope="module")
def watched(room_clip: Path, tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, View]:
    """The clip, live, every frame of it; by the library."""
    out, view = tmp_path_factory.mktemp("live") / "run", View()
    live_run(Patient(room_clip), out, EARLY, view=view)
    return out, view


def test_a_live_run_is_a_whole_run(watched: tuple[Path, View], room_clip: Path) -> None:
    out, view = watched
    rec, record = mastd3r.load(out), record_of(out)
    assert rec.is_complete and len(rec.poses) == 24 and len(rec.masks) == 24 and len(rec.cloud.points_world) > 50
    assert (out / "report.html").is_file() and (out / "tracks.npz").is_file() and not (out / ".reserve").exists()
    live, metrics = record["live"], rec.metrics
    assert live["ended"] == "the camera ended" and not live["recorded"] and live["camera"] == "clip"
    assert (metrics["frames_came"], metrics["frames_dropped"], metrics["frames"]) == (24, 0, 24)
    assert 0 < metrics["pose_latency_ms_median"] <= metrics["latency_ms_median"] <= metrics["latency_ms_95"]
    rows = (out / "live_frames.csv").read_text().splitlines()
    assert len(rows) == 25 and rows[1].startswith("0.000000,initialising,1,0,0,") and "first view" in rows[1]
    given = read_tum(out / "trajectory_live.txt")
    posed = [f for f in view.frames if f.world_from_cam is not None]
    assert 2 < len(given.timestamps_s) == len(posed) < 24
    assert np.allclose(given.world_from_cam, [f.world_from_cam for f in posed], atol=1e-6)
    truth = open_source(room_clip, SourceConfig()).truth()
    assert truth is not None
    for trajectory in (given, poses(rec)):
        assert (ate_rmse(trajectory, truth).rmse or 1) < 0.1
    cloud, path = view.clouds[-1]
    assert len(cloud.points_world) > 50 and path.shape[1:] == (4, 4) and len(path) > 10
    assert view.frames[-1].moving.shape == (120, 160) and view.frames[-1].latency_s > 0


def poses(rec: mastd3r.Reconstruction) -> Trajectory:
    return Trajectory(rec.timestamps_s, rec.poses, rec.states, rec.is_keyframe)


def test_what_was_kept_is_finished_as_a_run_over_it(
    room_clip: Path, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    out, camera = tmp_path / "run", Patient(room_clip, 8)
    live_run(camera, out, SHORT, record=True)
    kept = list(open_source(out / "recorded", SourceConfig()).frames())
    for a, b in zip(kept, camera.clip, strict=True):
        assert a.timestamp_s == b.timestamp_s and np.array_equal(a.image, b.image)
    with pytest.raises(OutputError, match=r"without frames of a live run, got 8 .*--overwrite"):
        mastd3r.reconstruct(room_clip, out, SHORT)
    live = (out / "trajectory_live.txt").read_bytes()
    assert main(["finish", str(out), "--quiet"]) == 0
    whole = mastd3r.reconstruct(out / "recorded", tmp_path / "whole", SHORT)
    for name in ("trajectory.txt", "keyframes.txt", "cloud.ply"):
        assert (out / name).read_bytes() == (whole.path / name).read_bytes()
    metrics = mastd3r.load(out).metrics
    assert metrics["latency_ms_median"] > 0 and metrics["frames_dropped"] == 0 and metrics["frames_posed"] == 8
    assert (out / "trajectory_live.txt").read_bytes() == live and (out / "masks.mp4").is_file()
    capfd.readouterr()
    for path, says in ((out, "got a finished one"), (whole.path, "got one of files")):
        assert main(["finish", str(path), "--quiet"]) == 2
        said = capfd.readouterr().err
        assert says in said and said.count("\n") == 1


def test_dropped_frames_are_counted(
    room_clip: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    """A tracker that takes as long as three frames of the camera; nothing is kept, so nothing can be finished."""
    track = Slam.track
    monkeypatch.setattr(Slam, "track", lambda *a, **k: (time.sleep(0.15), track(*a, **k))[1])
    words = ["live", str(room_clip), "--pace", "20", "--out", str(tmp_path / "run"), "--quiet"]
    assert main([*words, "--set", "tracking.first_motion_ratio=0.01"]) == 0
    record, metrics = record_of(tmp_path / "run"), mastd3r.load(tmp_path / "run").metrics
    assert record["status"] == "complete" and metrics["frames_came"] == 24
    assert metrics["frames_dropped"] > 8 and metrics["frames"] == 24 - metrics["frames_dropped"]
    rows = [r.split(",") for r in (tmp_path / "run" / "live_frames.csv").read_text().splitlines()[1:]]
    assert sum(int(r[4]) for r in rows) == metrics["frames_dropped"] and len(rows) == metrics["frames"]
    assert float(rows[-1][0]) == 4.6 and metrics["latency_ms_median"] > 150  # the newest is never the one dropped
    assert not (tmp_path / "run" / "recorded").exists()
    capfd.readouterr()
    assert main(["finish", str(tmp_path / "run")]) == 2
    assert "expected a live run that kept its frames (--record)" in capfd.readouterr().err


def pipe_until_tracked(images: list[Array], write: Callable[[bytes], Any], out: Path) -> None:
    """Frames into a pipe, the next once the last is in the files of the run; then nothing comes."""
    rows = out / "live_frames.csv"
    for n, image in enumerate(images):
        write(image.tobytes())
        until = time.monotonic() + 60
        while time.monotonic() < until and not (rows.is_file() and rows.read_text().count("\n") > n + 1):
            time.sleep(0.01)


def words_of(out: Path) -> list[str]:
    size = ["--size", "160x120", "--pixel-format", "rgb24", "--record", "--no-map", "--quiet"]
    return ["live", "-", *size, "--set", "tracking.first_motion_ratio=0.01", "--out", str(out)]


def whole_after_ctrl_c(out: Path, count: int) -> None:
    record, rec = record_of(out), mastd3r.load(out)
    assert record["status"] == "complete" and record["live"]["ended"] == "stopped by the user (Ctrl-C)"
    assert len(rec.poses) == count == len(rec.masks) == len(list((out / "recorded").glob("*.png")))
    assert len(rec.cloud.points_world) > 20 and rec.metrics["frames_dropped"] == 0


def test_ctrl_c_ends_a_live_run_with_all_of_it(
    room_clip: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    """Frames on standard input; the pipe stays open, and after the last frame nothing comes."""
    out, images = tmp_path / "run", [f.image for f in open_source(room_clip, SourceConfig(end=8)).frames()]
    reading, writing = os.pipe()
    monkeypatch.setattr(sys, "stdin", os.fdopen(reading, "r"))

    def camera() -> None:
        pipe_until_tracked(images, lambda data: os.write(writing, data), out)
        os.kill(os.getpid(), signal.SIGINT)

    thread = threading.Thread(target=camera)
    thread.start()
    assert main(words_of(out)) == 0
    thread.join()
    os.close(writing)
    assert capfd.readouterr().err == ""
    whole_after_ctrl_c(out, 8)


@pytest.mark.slow
def test_ctrl_c_ends_the_process_of_a_live_run(room_clip: Path, tmp_path: Path) -> None:
    """The thread that waits for the pipe does not hold it, nor break its end."""
    out, images = tmp_path / "run", [f.image for f in open_source(room_clip, SourceConfig(end=8)).frames()]
    process = subprocess.Popen(
        [sys.executable, "-m", "mastd3r", *words_of(out)],
        stdin=subprocess.PIPE,
        stderr=subprocess.PIPE,
        bufsize=0,
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.default_int_handler),  # noqa: PLW1509
    )
    assert process.stdin is not None and process.stderr is not None
    pipe_until_tracked(images, process.stdin.write, out)
    process.send_signal(signal.SIGINT)
    process.wait(60)
    assert process.stderr.read() == b"" and process.returncode == 0
    whole_after_ctrl_c(out, 8)


def test_a_second_request_to_stop_is_heeded(room_clip: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """While the end is being made: the run is incomplete, and says so."""
    camera = Patient(room_clip, 8)

    def interrupted(*_: Any, **__: Any) -> None:
        raise KeyboardInterrupt("stopped by SIGTERM")

    monkeypatch.setattr("mastd3r.live.run.open_camera", lambda *_: camera)
    monkeypatch.setattr(Slam, "end_tracking", interrupted)
    with pytest.raises(KeyboardInterrupt):
        run_live("clip", tmp_path / "run", NO_MAP)
    record = record_of(tmp_path / "run")
    assert record["status"] == "incomplete" and record["reason"] == "stopped by SIGTERM"
    assert record["live"]["figures"]["frames_came"] == 8 and (tmp_path / "run" / "live_frames.csv").is_file()


def test_what_cannot_begin_touches_nothing(room_clip: Path, tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    out = str(tmp_path / "run")
    for words in (
        ["/dev/video77"],
        ["nothing_of_the_kind"],
        ["http://127.0.0.1:9/x.ts"],
        ["-", "--size", "640"],
        ["0", "--seconds", "-1"],
        ["0", "--set", "pointmaps=depth"],
    ):
        assert main(["live", *words, "--out", out, "--quiet"]) == 2
        said = capfd.readouterr().err
        assert said.startswith("mastd3r: ") and said.count("\n") == 1 and "expected" in said
    assert not (tmp_path / "run").exists()
    assert main(["live", str(room_clip), "--set", "mapping.realtime=true", "--out", out, "--quiet"]) == 2
    assert "mapping.realtime=true: expected a map that is made afterwards" in capfd.readouterr().err
    assert not (tmp_path / "run").exists()


def test_a_loop_ends_when_it_is_told_to_and_when_nothing_comes(room_clip: Path) -> None:
    """By the library, without a run folder."""
    camera = open_camera(room_clip, CameraOptions(pace_fps=50.0), SourceConfig(end=6))
    with LiveLoop(camera, NO_MAP) as live:
        first = next(iter(live))
        assert first.timestamp_s == 0.0 and first.state == "initialising" and first.world_from_cam is None
        assert not len(live.cloud().points_world) and live.path()[1].shape == (0, 4, 4)
    assert live.ended == "it was stopped"
    silent = Patient(room_clip, 1)
    silent.timeout_s = 0.0
    clip = silent.frames

    def then_nothing() -> Any:
        yield from clip()
        time.sleep(30)

    silent.frames = then_nothing  # type: ignore[method-assign]
    with LiveLoop(silent, NO_MAP) as live:
        states = []
        live.while_silent = lambda: states.append(live.state)  # type: ignore[func-returns-value]
        assert len(list(live)) == 1
    assert live.ended == "nothing came from clip for 0 s" and states
    with LiveLoop(Patient(room_clip, 3), NO_MAP, seconds=1e-3) as live:
        assert 1 <= len(list(live)) <= 3 and (live.ended or "").startswith(("after 0.001 s", "the camera ended"))


def test_a_tripod_ends_in_one_line(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    """A camera that never moves has no map: what was given out is kept."""
    from helpers import blobs, write_video

    write_video(tmp_path / "still.mp4", blobs(1, 160, 120) * 6)
    out = tmp_path / "run"
    assert main(["live", str(tmp_path / "still.mp4"), "--out", str(out), "--quiet", "--record"]) == 2
    said = capfd.readouterr().err
    assert said.count("\n") == 1 and record_of(out)["status"] == "incomplete"
    assert len(list((out / "recorded").glob("*.png"))) == 6


def test_an_error_of_the_camera_is_the_run_s(room_clip: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    camera = Patient(room_clip, 4)
    clip = camera.frames

    def broken() -> Any:
        yield from clip()
        raise InputError("y4m: expected FRAME before frame 4, got something else")

    camera.frames = broken  # type: ignore[method-assign]
    monkeypatch.setattr("mastd3r.live.run.open_camera", lambda *_: camera)
    with pytest.raises(InputError, match="expected FRAME"):
        run_live("clip", tmp_path / "run", NO_MAP)
    assert record_of(tmp_path / "run")["reason"].startswith("y4m: expected FRAME")


def test_warming_up_goes_as_far_as_a_map() -> None:
    """Every kernel of the loop has been called then."""
    assert warm_up(NO_MAP, (160, 120))


def test_keyframes_that_come_while_the_map_is_started_join_it(room_clip: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The start takes as long as some frames do, and every keyframe is wanted meanwhile."""
    monkeypatch.setattr("mastd3r.tracking.live_keyframes.STILL_MATCHED", 1.0)
    held, release, placed = threading.Event(), threading.Event(), list[int]()
    started, place = LiveKeyframes._started, LiveKeyframes._place

    def slow(self: LiveKeyframes, aside: KeyframeGraph, *new: Any) -> KeyframeGraph:
        if len(aside.members()) >= 3:
            held.set()
            release.wait(60)
        return started(self, aside, *new)

    def counted(self: LiveKeyframes, kf: Keyframe, before: int) -> None:
        placed.append(kf.id)
        place(self, kf, before)

    def busy(self: Patient, loop: LiveLoop) -> bool:
        pending = loop.slam.keyframes._pending
        return pending is not None and not pending.ready() and (release.is_set() or not held.is_set())

    monkeypatch.setattr(LiveKeyframes, "_started", slow)
    monkeypatch.setattr(LiveKeyframes, "_place", counted)
    monkeypatch.setattr(Patient, "_busy", busy)
    camera, found = Patient(room_clip), list[LiveFrame]()
    with LiveLoop(camera, EARLY) as live:
        camera.loop = live
        for seen in live:
            found.append(seen)
            if seen.result.index == 16:
                release.set()
        live.slam.keyframes.settle()
        graph = live.slam.graph
        assert placed and graph.initialised
    times_s = np.array([kf.work.timestamp_s for kf in graph.keyframes])
    pose = np.stack([graph.world_from_cam(kf.id) for kf in graph.keyframes])
    truth = open_source(room_clip, SourceConfig()).truth()
    path = Trajectory(times_s, pose, ("tracked",) * len(pose), np.ones(len(pose), bool))
    assert truth is not None and (ate_rmse(path, truth).rmse or 1) < 0.1
