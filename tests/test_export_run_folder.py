"""The run folder: its contract, its manners with other people's files, and a full disk."""

from __future__ import annotations

import errno
import json
import logging
import os
from contextlib import suppress
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from mastd3r.camera.pinhole import Camera
from mastd3r.errors import InputError, OutputError
from mastd3r.export import files, machine
from mastd3r.export.claim import settle
from mastd3r.export.read_run import read_run
from mastd3r.export.run_folder import RunFolder
from mastd3r.types import StaticCloud, Trajectory


def some_trajectory() -> Trajectory:
    poses = np.tile(np.eye(4), (5, 1, 1))
    poses[:, 0, 3] = np.arange(5)
    states = ("started", "tracked", "tracked", "interpolated", "lost")
    return Trajectory(np.arange(5) / 10, poses, states, np.array([True, False, True, False, False]))


def full_disk(monkeypatch: pytest.MonkeyPatch, code: int = errno.ENOSPC) -> None:
    def refuse(*_: Any, **__: Any) -> None:
        raise OSError(code, os.strerror(code))

    monkeypatch.setattr(files.os, "replace", refuse)


def test_a_whole_run_comes_back(tmp_path: Path) -> None:
    folder = RunFolder(tmp_path / "deep" / "run", ["mastd3r", "run", "a b.mp4"])
    camera = Camera.centred(519.0, 640, 480, k1=-0.03)
    folder.write_trajectory(some_trajectory())
    folder.write_camera(camera)
    folder.write_config("seed: 0\n")
    folder.write_metrics({"frames": np.int64(5), "psnr_holdout": np.float32(20.5), "mask_iou": float("nan")})
    folder.write_mask(0.1, np.full((4, 6), 0.25))
    folder.write_render(0.2, np.full((4, 6, 3), [1.0, 0.5, 0.0]))
    folder.write_depth(0.2, np.full((4, 6), 2.5), 100.0)
    folder.note("focal length found", "focal length found", "no semantics")
    folder.update(timings_s={"tracking": 1.5})
    assert read_run(folder.path).record["status"] == "running"
    folder.finish()
    run = read_run(folder.path)
    assert run.record["status"] == "complete"
    assert run.record["command"] == ["mastd3r", "run", "a b.mp4"]
    assert run.record["choices"] == ["focal length found", "no semantics"]
    assert run.trajectory.states == some_trajectory().states
    assert run.trajectory.is_keyframe.tolist() == [True, False, True, False, False]
    assert np.array_equal(run.trajectory.world_from_cam, some_trajectory().world_from_cam)
    assert run.camera == camera
    assert run.config == "seed: 0\n"
    assert run.metrics == {"frames": 5, "psnr_holdout": 20.5, "mask_iou": None}
    assert np.array_equal(run.mask(0.1), np.full((4, 6), 64))
    assert np.array_equal(run.render(0.2), np.full((4, 6, 3), [255, 128, 0]))
    assert (run.mask_times_s().tolist(), run.render_times_s().tolist()) == ([0.1], [0.2])
    assert {p.name for p in folder.path.iterdir()} == {
        "run.json", "config.yaml", "trajectory.txt", "keyframes.txt", "states.txt", "camera.json", "metrics.json",
        "run.log", "masks", "renders", "alpha", "depth",
    }  # fmt: skip


def test_a_mask_value_above_127_is_more_likely_than_not(tmp_path: Path) -> None:
    folder = RunFolder(tmp_path)
    p = np.array([[0.0, 0.4999, 0.5, 0.5001, 1.0, 0.0019]])
    folder.write_mask(1.5, p)
    written = cv2.imread(str(tmp_path / "masks" / "1.500000.png"), cv2.IMREAD_UNCHANGED)
    assert (written > 127).tolist() == (p > 0.5).tolist()
    assert written[0, [0, 4]].tolist() == [0, 255]
    assert np.abs(written / 255 - p).max() <= 0.5 / 255 + 1e-12


def earlier_run(path: Path) -> RunFolder:
    first = RunFolder(path)
    first.write_trajectory(some_trajectory())
    first.write_mask(0.1, np.zeros((4, 4)))
    first.write_mask(0.2, np.zeros((4, 4)))
    (first.path / "gaussians.ply").write_text("old")
    first.finish()
    (path / "my notes.txt").write_text("keep me")
    return first


def test_an_earlier_run_stays_until_the_new_one_is_complete(tmp_path: Path) -> None:
    first = earlier_run(tmp_path / "run")
    before = {p: p.read_bytes() for p in first.path.rglob("*") if p.is_file()}
    second = RunFolder(tmp_path / "run", ["mastd3r", "again"])
    second.write_trajectory(some_trajectory())
    second.write_mask(0.1, np.ones((4, 4)))
    assert second.path == tmp_path / "run" / "unfinished"
    assert {p: p.read_bytes() for p in before} == before
    second.finish()
    assert second.path == tmp_path / "run" and not (tmp_path / "run" / "unfinished").exists()
    run = read_run(tmp_path / "run")
    assert (run.record["status"], run.record["command"]) == ("complete", ["mastd3r", "again"])
    assert run.mask_times_s().tolist() == [0.1] and run.mask(0.1).all()
    assert not (second.path / "gaussians.ply").exists()
    assert (second.path / "my notes.txt").read_text() == "keep me"


def test_an_earlier_run_stays_when_the_new_one_is_stopped(tmp_path: Path) -> None:
    earlier_run(tmp_path / "run")
    with pytest.raises(KeyboardInterrupt) as stopped, RunFolder(tmp_path / "run") as second:
        second.write_trajectory(some_trajectory())
        raise KeyboardInterrupt
    assert "unfinished" in stopped.value.__notes__[0]
    assert (tmp_path / "run" / "gaussians.ply").read_text() == "old"
    assert read_run(tmp_path / "run").record["status"] == "complete"
    kept = read_run(tmp_path / "run" / "unfinished")
    assert kept.record["status"] == "incomplete" and len(kept.trajectory.timestamps_s) == 5
    third = RunFolder(tmp_path / "run")
    assert third.path == tmp_path / "run" / "unfinished" and not (third.path / "trajectory.txt").exists()


def test_overwriting_removes_an_earlier_run_at_once_and_other_files_stay(tmp_path: Path) -> None:
    earlier_run(tmp_path / "run")
    second = RunFolder(tmp_path / "run", overwrite=True)
    assert second.path == tmp_path / "run"
    assert (second.path / "my notes.txt").read_text() == "keep me"
    assert not (second.path / "trajectory.txt").exists()
    assert not (second.path / "gaussians.ply").exists()
    assert not list((second.path / "masks").iterdir())
    assert json.loads((second.path / "run.json").read_text())["status"] == "running"


@pytest.mark.parametrize("moves", [0, 1, 2, 4, 6, 8])
def test_stopped_while_the_new_run_takes_its_place(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, moves: int) -> None:
    """After so many files, for good: whoever comes next finishes it."""
    earlier_run(tmp_path / "run")
    second = RunFolder(tmp_path / "run")
    second.write_trajectory(some_trajectory())
    second.write_mask(0.1, np.ones((4, 4)))
    second.write_config("seed: 7")
    left = [moves]

    def replace_some(a: Path, b: Path) -> None:
        if b.parent.name != "unfinished" and b.parent.parent.name != "unfinished":
            left[0] -= 1
            if left[0] < 0:
                raise KeyboardInterrupt
        a.rename(b)

    monkeypatch.setattr("mastd3r.export.claim.os.replace", replace_some)
    with suppress(KeyboardInterrupt):
        second.finish()
    monkeypatch.undo()
    settle(tmp_path / "run")
    run = read_run(tmp_path / "run")
    assert run.config == "seed: 7" and run.mask(0.1).all() and len(run.trajectory.timestamps_s) == 5
    assert not (tmp_path / "run" / "gaussians.ply").exists() and not (tmp_path / "run" / "unfinished").exists()


def test_an_unexpected_end_is_an_end_with_its_traceback_in_the_log(tmp_path: Path) -> None:
    with pytest.raises(ZeroDivisionError) as caught, RunFolder(tmp_path / "run", ["mastd3r", "run"]) as folder:
        logging.getLogger("mastd3r.somewhere").error("said in between")
        folder.note(str(1 / 0))
    record = read_run_record(tmp_path / "run")
    assert record["status"] == "incomplete" and record["reason"] == "unexpected ZeroDivisionError: division by zero"
    text = (tmp_path / "run" / "run.log").read_text()
    assert "said in between" in text and "Traceback" in text and "command: ['mastd3r', 'run']" in text
    assert "run.log" in caught.value.__notes__[0]
    assert not (tmp_path / "run" / ".reserve").exists()
    logging.getLogger("mastd3r.somewhere").error("said later")
    assert "said later" not in (tmp_path / "run" / "run.log").read_text()


def read_run_record(path: Path) -> dict[str, Any]:
    record: dict[str, Any] = json.loads((path / "run.json").read_text())
    return record


def test_other_peoples_folders_are_refused_untouched(tmp_path: Path) -> None:
    (tmp_path / "thesis.txt").write_text("years of work")
    with pytest.raises(OutputError, match=r"no run\.json of a run"):
        RunFolder(tmp_path)
    assert [p.name for p in tmp_path.iterdir()] == ["thesis.txt"]


def test_a_file_in_the_way_is_named(tmp_path: Path) -> None:
    (tmp_path / "run").write_text("a file")
    with pytest.raises(OutputError, match="run: expected to write"):
        RunFolder(tmp_path / "run")


@pytest.mark.parametrize(
    ("code", "says"),
    [(errno.ENOSPC, "free some space"), (errno.EACCES, "allow writing"), (errno.EIO, "--out")],
)
def test_what_the_system_refuses_is_one_line_with_a_remedy(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, code: int, says: str
) -> None:
    folder = RunFolder(tmp_path / "run")
    with monkeypatch.context() as patch:
        full_disk(patch, code)
        for write in (
            lambda: folder.write_mask(0.0, np.zeros((4, 4))),
            lambda: folder.write_trajectory(some_trajectory()),
            lambda: folder.write_metrics({"frames": 1}),
            lambda: folder.write_cloud(
                StaticCloud(np.zeros((1, 3)), np.zeros((1, 3)), np.zeros(1), np.zeros(1), np.zeros(1))
            ),
        ):
            with pytest.raises(OutputError, match=says) as caught:
                write()
            assert "\n" not in str(caught.value)
            assert str(folder.path) in str(caught.value)
    assert not list(folder.path.rglob("*.part"))
    assert json.loads((folder.path / "run.json").read_text())["status"] == "running"


def test_a_truly_full_disk_still_gets_its_last_words(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A disk of 1.5 MiB, in bytes counted on open files: the reserve makes room for the end of the run."""
    size = 3 * 2**19
    real_replace = os.replace

    def replace_if_it_fits(source: Path, target: Path) -> None:
        used = sum(p.stat().st_size for p in tmp_path.rglob("*") if p.is_file())
        if used > size:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        real_replace(source, target)

    monkeypatch.setattr(files.os, "replace", replace_if_it_fits)
    folder = RunFolder(tmp_path / "run")
    rng = np.random.default_rng(0)
    with pytest.raises(OutputError, match="free some space"):
        for i in range(100):
            folder.write_mask(i / 30, rng.random((100, 100)))
    folder.make_room()
    folder.write_trajectory(some_trajectory())
    folder.finish("incomplete", "the disk was full at frame 57")
    run = read_run(folder.path)
    assert (run.record["status"], run.record["reason"]) == ("incomplete", "the disk was full at frame 57")
    assert len(run.trajectory.timestamps_s) == 5
    assert len(run.mask_times_s()) > 10


def test_half_a_file_never_replaces_a_whole_one(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "a.json"
    files.write_json(path, {"a": 1})
    full_disk(monkeypatch)
    with pytest.raises(OutputError):
        files.write_json(path, {"a": 2})
    assert json.loads(path.read_text()) == {"a": 1}
    assert [p.name for p in tmp_path.iterdir()] == ["a.json"]


def test_incomplete_needs_its_reason(tmp_path: Path) -> None:
    folder = RunFolder(tmp_path)
    for wrong in (("incomplete", None), ("complete", "why"), ("done", None)):
        with pytest.raises(ValueError, match="expected complete"):
            folder.finish(*wrong)


def test_pictures_that_are_not_finite_are_refused(tmp_path: Path) -> None:
    folder = RunFolder(tmp_path)
    with pytest.raises(OutputError, match=r"mask at 0.100000 s.*1 not finite"):
        folder.write_mask(0.1, np.array([[0.0, np.nan]]))
    with pytest.raises(OutputError, match="render at"):
        folder.write_render(0.1, np.full((2, 2, 3), np.inf))


def test_folders_that_are_no_runs_are_named(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"no run.json"):
        read_run(tmp_path)
    (tmp_path / "run.json").write_text("{ broken")
    with pytest.raises(InputError, match=r"run\.json: expected readable JSON"):
        read_run(tmp_path)
    (tmp_path / "run.json").write_text('{"states": [["tracked", 3]]}')
    with pytest.raises(InputError, match=r"trajectory.txt"):
        read_run(tmp_path)
    (tmp_path / "trajectory.txt").write_text("0 0 0 0 0 0 0 1\n")
    with pytest.raises(InputError, match="states of 1 poses, got 3"):
        read_run(tmp_path)
    (tmp_path / "run.json").write_text("{}")
    (tmp_path / "camera.json").write_text('{"fx_px": 1}')
    with pytest.raises(InputError, match=r"camera.json"):
        read_run(tmp_path)


def test_machine_facts() -> None:
    info = machine.machine_info()
    assert info["cores"] >= 1
    assert info["packages"]["numpy"] == np.__version__
    json.dumps(info, allow_nan=False)
    block = np.ones(2**24)  # 128 MiB
    assert 128 < machine.peak_rss_mib() < 2**20
    assert block.sum() == 2**24


def test_no_commit_outside_a_checkout(tmp_path: Path) -> None:
    assert machine.git_commit(tmp_path) is None
