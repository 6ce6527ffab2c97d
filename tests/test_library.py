"""The library: a live loop gives what the command line gives, instances keep apart, and nonsense is refused."""

from __future__ import annotations

import subprocess
import sys
import threading
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from threadpoolctl import threadpool_info, threadpool_limits

import mastd3r
from helpers import data_path
from mastd3r.cli.main import main
from mastd3r.config import SourceConfig, with_override
from mastd3r.errors import InputError, OutputError
from mastd3r.sources import open_source
from mastd3r.tracking.state import Status

Array = NDArray[Any]
NO_MAP = with_override(mastd3r.Config(), "mapping.enabled=false")


def images_of(path: Path, **window: int) -> list[tuple[float, Array]]:
    return [(f.timestamp_s, f.image) for f in open_source(path, SourceConfig(**window)).frames()]


def poses_file(rec: mastd3r.Reconstruction) -> bytes:
    return (rec.path / "trajectory.txt").read_bytes()


@pytest.fixture(scope="module")
def clip(room_clip: Path) -> list[tuple[float, Array]]:
    return images_of(room_clip)


@pytest.fixture(scope="module")
def whole(room_clip: Path, tmp_path_factory: pytest.TempPathFactory) -> mastd3r.Reconstruction:
    """The clip by the command line."""
    out = tmp_path_factory.mktemp("library") / "run"
    assert main(["run", str(room_clip), "--out", str(out), "--no-map", "--quiet"]) == 0
    return mastd3r.load(out)


def interleaved(
    clip: list[tuple[float, Array]], first: mastd3r.Slam, second: mastd3r.Slam
) -> Iterator[tuple[Any, Any]]:
    """The clip in one instance, and backwards in the other, frame by frame in turn."""
    last_s = clip[-1][0]
    for (t, image), (t_back, image_back) in zip(clip, reversed(clip), strict=True):
        yield first.track(image, t), second.track(image_back, last_s - t_back)


def test_a_live_loop_beside_another_is_the_run_of_the_command_line(
    clip: list[tuple[float, Array]], whole: mastd3r.Reconstruction
) -> None:
    height, width = clip[0][1].shape[:2]
    first, second = (mastd3r.Slam(NO_MAP, (width, height)) for _ in range(2))
    results = [pair[0] for pair in interleaved(clip, first, second)]
    assert [r.index for r in results] == list(range(24)) and results[0].is_keyframe
    assert results[0].state is Status.INITIALISING and results[0].world_from_cam is None
    assert results[-1].state == "tracking" and np.isfinite(results[-1].world_from_cam).all()
    assert results[-1].moving.shape == (height, width) and results[-1].moving.dtype == np.float32
    assert results[-1].moving.min() >= 0 and results[-1].moving.max() <= 1
    rec = first.finish()
    assert rec.metrics["fps_total"] < rec.metrics["fps_tracking"]  # tracking is a part of the whole
    assert poses_file(rec) == poses_file(whole)
    for name in ("cloud.ply", "keyframes.txt", "camera.json"):
        assert (rec.path / name).read_bytes() == (whole.path / name).read_bytes()
    assert all(np.array_equal(a, b) for a, b in zip(rec.masks, whole.masks, strict=True))
    assert poses_file(second.finish()) != poses_file(rec)


def test_an_iterable_of_images_is_a_video_too(
    clip: list[tuple[float, Array]], whole: mastd3r.Reconstruction, tmp_path: Path
) -> None:
    rec = mastd3r.reconstruct(iter(clip), tmp_path / "run", NO_MAP)
    assert poses_file(rec) == poses_file(whole) and rec.path == tmp_path / "run"
    with pytest.raises(InputError, match="expected images, got none"):
        mastd3r.reconstruct([], config=NO_MAP)


def test_a_reconstruction_says_what_is_in_its_folder(whole: mastd3r.Reconstruction, tmp_path: Path) -> None:
    assert whole.poses.shape == (24, 4, 4) and len(whole.states) == len(whole.timestamps_s) == 24
    assert whole.is_keyframe.sum() == whole.metrics["keyframes"] and whole.is_complete and whole.reason is None
    assert whole.camera.width == 160 and len(whole.cloud.points_world) > 100
    assert len(whole.masks) == 24 and whole.masks[3].shape == (120, 160) and len(whole.masks[2:5]) == 3
    assert whole.gaussians is None and any(n.startswith("pointmaps: geometric") for n in whole.notes)
    for kind, name in (("tum", "poses.txt"), ("kitti", "poses.kitti"), ("colmap", "colmap")):
        assert whole.export(kind, tmp_path / name).exists()
    assert whole.export("nerfstudio", tmp_path / "nerf", undistort=False, all_poses=True).is_dir()
    with pytest.raises(mastd3r.ConfigError, match="expected one of tum"):
        whole.export("usd", tmp_path / "x")
    with pytest.raises(InputError, match=r"gaussians\.ply"):
        whole.export("spz", tmp_path / "x.spz")


def test_saving_keeps_everything_and_costs_nobody_anything(whole: mastd3r.Reconstruction, tmp_path: Path) -> None:
    rec = mastd3r.load(whole.path)
    (tmp_path / "other").mkdir()
    (tmp_path / "other" / "thesis.txt").write_text("years of work")
    for taken in (tmp_path / "other", whole.path.parent, whole.path / "inside"):
        with pytest.raises(OutputError, match="--out"):
            rec.save(taken)
    assert (tmp_path / "other" / "thesis.txt").read_text() == "years of work"
    assert rec.save(tmp_path / "kept") == rec.path == tmp_path / "kept"
    assert poses_file(rec) == poses_file(whole) and len(rec.masks) == 24


def test_a_temporary_result_lives_as_long_as_it_is_held(clip: list[tuple[float, Array]], tmp_path: Path) -> None:
    rec = mastd3r.reconstruct(clip[:6], config=with_override(NO_MAP, "tracking.first_motion_ratio=0.01"))
    folder = rec.path
    assert folder.is_dir() and len(rec.poses) == 6
    kept = rec.save(tmp_path / "kept")
    assert not folder.is_dir() and len(mastd3r.load(kept).poses) == 6


@pytest.mark.parametrize(
    ("image", "time_s", "says"),
    [
        (np.zeros((120, 160, 3), np.float32), 0.0, r"expected an image .*120, 160, 3.* of uint8 RGB, got float32"),
        (np.zeros((120, 160), np.uint8), 0.0, r"expected an image .*got uint8 \(120, 160\)"),
        (np.zeros((60, 80, 3), np.uint8), 0.0, r"expected an image .*got uint8 \(60, 80, 3\)"),
        ([[0]], 0.0, r"expected an image .*got list"),
        (np.zeros((120, 160, 3), np.uint8), float("nan"), "expected a finite time in seconds, got nan"),
        (np.zeros((120, 160, 3), np.uint8), float("inf"), "expected a finite time in seconds, got inf"),
    ],
)
def test_what_no_camera_gives_is_refused(image: Any, time_s: float, says: str) -> None:
    slam = mastd3r.Slam(NO_MAP, (160, 120))
    with pytest.raises(InputError, match=says) as caught:
        slam.track(image, time_s)
    assert "\n" not in str(caught.value)
    assert not slam.graph.records and slam.state.status is Status.INITIALISING


def test_a_refused_frame_changes_nothing_and_time_rises(clip: list[tuple[float, Array]]) -> None:
    slam = mastd3r.Slam(NO_MAP, (160, 120))
    slam.track(clip[0][1], 1.0)
    for again_s in (1.0, 0.5):
        with pytest.raises(InputError, match=r"frame 1: expected a finite time in seconds after 1\.000000 s"):
            slam.track(clip[1][1], again_s)
    with pytest.raises(InputError, match="expected no depth without pointmaps=depth"):
        slam.track(clip[1][1], 2.0, depth_m=np.ones((120, 160)))
    with pytest.raises(InputError, match="expected no map without semantics=maps"):
        slam.track(clip[1][1], 2.0, semantic=np.ones((120, 160)))
    assert slam.track(clip[1][1], 2.0).index == 1


def test_nothing_goes_on_after_the_end(clip: list[tuple[float, Array]]) -> None:
    slam = mastd3r.Slam(NO_MAP, (160, 120))
    slam.track(clip[0][1], 0.0)
    with pytest.raises(InputError, match="expected at least 2 frames, got 1"):
        slam.finish()
    for call in (lambda: slam.track(clip[1][1], 1.0), slam.finish):
        with pytest.raises(InputError, match=r"expected a run that goes on, got one that has been finished"):
            call()


def test_frames_without_a_source_cannot_be_read_again(room_clip: Path) -> None:
    slam = mastd3r.Slam(NO_MAP, (160, 120))
    for frame in list(open_source(room_clip, SourceConfig()).frames())[:3]:
        slam.track(frame)
    with pytest.raises(InputError, match="expected images, or a source"):
        slam.finish()


def test_sizes_and_names_that_are_none() -> None:
    with pytest.raises(InputError, match=r"size: expected \(width, height\)"):
        mastd3r.Slam(NO_MAP, (0, 120))
    with pytest.raises(mastd3r.ConfigError, match="expected one of auto, geometric"):
        mastd3r.Slam(mastd3r.Config(pointmaps="geometrik"), (160, 120))
    with pytest.raises(InputError, match=r"expected a run folder"):
        mastd3r.load("/nowhere")
    with pytest.raises(AttributeError, match="no attribute 'slum'"):
        mastd3r.slum  # noqa: B018


def test_a_blank_image_is_a_state_and_no_error(clip: list[tuple[float, Array]]) -> None:
    slam = mastd3r.Slam(NO_MAP, (160, 120))
    slam.track(clip[0][1], 0.0)
    lost = slam.track(np.zeros_like(clip[0][1]), 0.1)
    assert lost.state is Status.LOST and lost.reason == "the image is blank"
    assert lost.world_from_cam is None and not lost.is_keyframe and not lost.moving.any()


def blas_threads() -> set[int]:
    return {library["num_threads"] for library in threadpool_info() if library["user_api"] == "blas"}


def test_blas_is_held_inside_and_given_back(clip: list[tuple[float, Array]], monkeypatch: pytest.MonkeyPatch) -> None:
    seen: list[set[int]] = []
    slam = mastd3r.Slam(NO_MAP, (160, 120))
    monkeypatch.setattr(slam.observer, "describe", lambda _: seen.append(blas_threads()))
    look = slam.parts.provider.look
    monkeypatch.setattr(slam.parts.provider, "look", lambda frame: (seen.append(blas_threads()), look(frame))[1])
    with threadpool_limits(limits=2, user_api="blas"):
        slam.track(clip[0][1], 0.0)
        assert blas_threads() == {2}
    assert seen and all(threads == {1} for threads in seen)


def test_two_threads_may_come_and_go_in_any_order() -> None:
    from mastd3r.concurrency import one_blas_thread

    inside, leave = threading.Event(), threading.Event()
    found: list[set[int]] = []

    def other() -> None:
        with one_blas_thread():
            found.append(blas_threads())
            inside.set()
            leave.wait(10)

    with threadpool_limits(limits=2, user_api="blas"):
        thread = threading.Thread(target=other)
        with one_blas_thread():
            thread.start()
            assert inside.wait(10)
            assert blas_threads() == {1}
        leave.set()
        thread.join()
        assert blas_threads() == {2} and found[0] == {1}


def test_importing_is_light() -> None:
    code = "import sys, mastd3r; print(sorted({'torch', 'numba', 'numpy', 'cv2', 'rich'} & set(sys.modules)))"
    said = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True, timeout=60)
    assert said.stdout.strip() == "[]"
    words = [sys.executable, "-X", "importtime", "-m", "mastd3r", "--help"]
    loaded = subprocess.run(words, capture_output=True, text=True, check=True, timeout=60).stderr
    names = {line.rpartition("|")[2].strip() for line in loaded.splitlines()}
    assert not names & {"torch", "numba", "numpy", "cv2", "scipy"}


def test_a_run_without_a_map_loads_no_torch(room_clip: Path, tmp_path: Path) -> None:
    """It takes seconds, and gigabytes where pip brings CUDA: with ORB, no network is asked for anything either."""
    words = ["run", str(room_clip), "--out", str(tmp_path / "run"), "--no-map", "--quiet", "--set", "features=orb"]
    code = f"import sys; from mastd3r.cli.main import main; print(main({words!r}), 'torch' in sys.modules)"
    said = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True, timeout=240)
    assert said.stdout.strip().endswith("0 False"), said.stderr


@pytest.mark.slow
def test_a_live_loop_over_the_kitchen_is_its_run(tmp_path: Path) -> None:
    """Frames 0-79 from memory, two instances interleaved: the poses of ``mastd3r run --end 80``."""
    kitchen = data_path("kitchen")
    out = tmp_path / "run"
    assert main(["run", str(kitchen), "--end", "80", "--out", str(out), "--no-map", "--quiet"]) == 0
    clip = images_of(kitchen, end=80)
    height, width = clip[0][1].shape[:2]
    first, second = (mastd3r.Slam(NO_MAP, (width, height)) for _ in range(2))
    for _ in interleaved(clip, first, second):
        pass
    assert poses_file(first.finish()) == poses_file(mastd3r.load(out))
    second.end_tracking()
