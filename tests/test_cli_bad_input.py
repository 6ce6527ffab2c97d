"""Whatever goes wrong: exit code 2 (130 for Ctrl-C), one line that says what, and what was computed is kept."""

from __future__ import annotations

import errno
import json
import shutil
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from helpers import write_video
from mastd3r import pipeline
from mastd3r.cli.main import main
from mastd3r.export import files
from mastd3r.offline import job
from mastd3r.types import Frame


@dataclass(frozen=True)
class Said:
    """What a command left on the terminal and in its run folder."""

    code: int
    out: str
    err: list[str]
    folder: Path

    @property
    def record(self) -> dict[str, Any]:
        data: dict[str, Any] = json.loads((self.folder / "run.json").read_text())
        return data

    def poses(self) -> np.ndarray:
        return np.loadtxt(self.folder / "trajectory.txt", ndmin=2)

    def refused(self, *words: str) -> None:
        """Exit code 2 and exactly one line, with these words in it."""
        assert self.code == 2 and len(self.err) == 1, self.err
        line = self.err[0]
        assert line.startswith("mastd3r: ") and len(line) > 25
        for word in words:
            assert word in line, line


Command = Callable[..., Said]


@pytest.fixture
def mastd3r(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> Command:
    """Call the command line in this process: a run without a map unless told otherwise."""

    def call(*words: str | Path, run: bool = True, out: Path | None = None) -> Said:
        folder = out or tmp_path / "out"
        argv = [str(w) for w in words]
        if run:
            argv = ["run", *argv, "--out", str(folder), "--no-map", "--quiet"]
        capfd.readouterr()
        code = main(argv)
        said = capfd.readouterr()
        return Said(code, said.out, said.err.splitlines(), folder)

    return call


def images_of(clip: Path, folder: Path, count: int) -> Path:
    """The first ``count`` pictures of a clip as a plain folder of images."""
    folder.mkdir()
    for k, file in enumerate(sorted((clip / "rgb").iterdir())[:count]):
        shutil.copy(file, folder / f"{k:03d}.png")
    return folder


def pictures(clip: Path, count: int) -> list[np.ndarray]:
    files_ = sorted((clip / "rgb").iterdir())[:count]
    return [np.ascontiguousarray(cv2.imread(str(f))[..., ::-1]) for f in files_]


# -- before anything is read -----------------------------------------------------------------------------------------


def test_missing_path(mastd3r: Command, tmp_path: Path) -> None:
    said = mastd3r(tmp_path / "nowhere.mp4")
    said.refused("nowhere.mp4", "expected", "got no such path")
    assert not said.folder.exists()


def test_empty_folder(mastd3r: Command, tmp_path: Path) -> None:
    (tmp_path / "empty").mkdir()
    mastd3r(tmp_path / "empty").refused("empty", "expected images", "got an empty folder")


def test_folder_without_pictures(mastd3r: Command, tmp_path: Path) -> None:
    (tmp_path / "texts").mkdir()
    (tmp_path / "texts" / "a.txt").write_text("words")
    mastd3r(tmp_path / "texts").refused("expected images", "a.txt")


def test_a_file_that_is_no_video(mastd3r: Command, tmp_path: Path) -> None:
    (tmp_path / "a.mp4").write_bytes(b"not a video at all, only words")
    mastd3r(tmp_path / "a.mp4").refused("a.mp4", "expected a video")


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["--correction", "best"], ["--correction", "'best'", "coarse-to-fine"]),
        (["--pointmaps", "lidar"], ["--pointmaps", "'lidar'", "geometric"]),
        (["--map-loss", "l2"], ["--map-loss", "'l2'", "uncertainty"]),
        (["--seed", "x"], ["--seed", "'x'"]),
        (["--no-such-option"], ["--no-such-option"]),
        (["--set", "tracking.cel_px=3"], ["tracking.cel_px", "tracking.cell_px"]),
        (["--set", "tracking.cell_px=wide"], ["tracking.cell_px", "expected int", "'wide'"]),
        (["--set", "tracking.cell_px=["], ["--set tracking.cell_px", "expected a YAML value"]),
        (["--set", "nonsense"], ["--set", "expected section.key=value", "'nonsense'"]),
        (["--stride", "0"], ["stride", "expected 1 or more", "got 0"]),
        (["--start", "-3"], ["start", "expected 0 or more", "got -3"]),
        (["--start", "4", "--end", "4"], ["end", "expected more than start", "got 4"]),
        (["--start", "400"], ["expected a start before its 24 frames end", "400"]),
        (["--pointmaps", "mast3r"], ["expected its weights", "mastd3r weights download mast3r"]),
        (["--semantics", "dinov2"], ["expected its weights", "mastd3r weights download dinov2"]),
        (["--semantics", "maps"], ["--semantics maps", "expected probability maps"]),
    ],
)
def test_options_that_cannot_be_served(mastd3r: Command, room_clip: Path, words: list[str], said: list[str]) -> None:
    answer = mastd3r(room_clip, *words)
    answer.refused(*said)
    assert not answer.folder.exists()


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("wide", ["expected fx,fy,cx,cy", "'wide'"]),
        ("", ["expected fx,fy,cx,cy", "got nothing"]),
        ("150,150", ["expected fx,fy,cx,cy", "got 2 numbers"]),
        ("150,150,80,60,0,0,0,0,0,0", ["got 10 numbers"]),
        ("-150,150,80,60", ["fx, fy > 0"]),
        ("150,0,80,60", ["fx, fy > 0"]),
        ("nan,150,80,60", ["expected finite numbers"]),
        ("150,150,inf,60", ["expected finite numbers"]),
    ],
)
def test_intrinsics_that_are_nonsense(mastd3r: Command, room_clip: Path, text: str, said: list[str]) -> None:
    answer = mastd3r(room_clip, f"--intrinsics={text}")
    answer.refused("--intrinsics", *said)
    assert not answer.folder.exists()


def test_no_command_and_unknown_command(mastd3r: Command) -> None:
    mastd3r(run=False).refused("COMMAND")
    mastd3r("walk", run=False).refused("'walk'")
    mastd3r("run", run=False).refused("source", "--out")


def test_a_configuration_file_that_is_not_one(mastd3r: Command, room_clip: Path, tmp_path: Path) -> None:
    bad = tmp_path / "c.yaml"
    mastd3r(room_clip, "--config", bad).refused("c.yaml", "expected readable YAML")
    bad.write_text("mapping: {iterations: [1, 2\n")
    mastd3r(room_clip, "--config", bad).refused("c.yaml", "expected readable YAML")
    bad.write_text("mapping: {loss: best}\n")
    mastd3r(room_clip, "--config", bad).refused("mapping.loss", "expected one of", "'best'")


def test_a_folder_that_is_not_a_runs(mastd3r: Command, room_clip: Path, tmp_path: Path) -> None:
    foreign = tmp_path / "thesis"
    foreign.mkdir()
    (foreign / "chapter1.tex").write_text("years of work")
    said = mastd3r(room_clip, out=foreign)
    said.refused("thesis", "expected an empty folder or an earlier run", "--out")
    assert [p.name for p in foreign.iterdir()] == ["chapter1.tex"]


def test_an_out_path_that_is_a_file(mastd3r: Command, room_clip: Path, tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    mastd3r(room_clip, out=tmp_path / "file").refused("file", "expected to write", "--out")


def test_depth_pointmaps_need_depth(mastd3r: Command, room_clip: Path, tmp_path: Path) -> None:
    folder = images_of(room_clip, tmp_path / "shots", 4)
    mastd3r(folder, "--pointmaps", "depth").refused("--pointmaps depth", "expected a TUM-layout", "no depth")


@pytest.mark.parametrize("words", [["eval"], ["view"], ["export", "--to", "tum", "--out", "x"]])
def test_other_commands_on_a_folder_that_holds_no_run(
    mastd3r: Command, room_clip: Path, tmp_path: Path, words: list[str]
) -> None:
    (tmp_path / "norun").mkdir()
    extra = [str(room_clip)] if words[0] == "eval" else []
    mastd3r(words[0], tmp_path / "norun", *extra, *words[1:], run=False).refused("norun", "expected a run folder")


# -- while frames are read -------------------------------------------------------------------------------------------


def incomplete(said: Said, *words: str) -> None:
    said.refused(*words)
    assert said.record["status"] == "incomplete"
    assert said.record["reason"] and said.record["reason"] in said.err[0]
    assert not (said.folder / ".reserve").exists()


def test_one_frame(mastd3r: Command, room_clip: Path, tmp_path: Path) -> None:
    said = mastd3r(images_of(room_clip, tmp_path / "one", 1))
    incomplete(said, "expected at least 2 frames, got 1")


def test_an_unreadable_frame_in_the_middle_is_left_out_and_named(
    mastd3r: Command, room_clip: Path, tmp_path: Path
) -> None:
    folder = images_of(room_clip, tmp_path / "shots", 24)
    (folder / "019.png").write_bytes(b"\x89PNG no more than a beginning")
    said = mastd3r(folder)
    assert said.code == 0 and said.record["status"] == "complete"
    assert any("019.png" in note and "left out" in note for note in said.record["choices"])
    poses = said.poses()
    assert len(poses) == 23 and np.isfinite(poses).all()
    assert np.ptp(poses[:, 1:4], 0).max() > 0  # and they are poses, not the first one again and again


def test_a_folder_with_one_readable_image(mastd3r: Command, room_clip: Path, tmp_path: Path) -> None:
    folder = images_of(room_clip, tmp_path / "shots", 2)
    (folder / "001.png").write_bytes(b"")
    said = mastd3r(folder)
    said.refused("expected")
    assert not [name for name in ("trajectory.txt", "camera.json") if (said.folder / name).exists()]  # none is known


def test_frames_of_different_sizes(mastd3r: Command, room_clip: Path, tmp_path: Path) -> None:
    folder = images_of(room_clip, tmp_path / "shots", 4)
    cv2.imwrite(str(folder / "002.png"), np.zeros((90, 160, 3), np.uint8))
    incomplete(mastd3r(folder), "002.png", "expected 160x120 pixels", "got 160x90")


def test_black_frames(mastd3r: Command, tmp_path: Path) -> None:
    folder = tmp_path / "night"
    folder.mkdir()
    for k in range(6):
        cv2.imwrite(str(folder / f"{k}.png"), np.zeros((120, 160, 3), np.uint8))
    incomplete(mastd3r(folder), "night", "expected pictures with something in them", "6 blank frames")


def test_a_camera_that_never_moves(mastd3r: Command, room_clip: Path, tmp_path: Path) -> None:
    folder = images_of(room_clip, tmp_path / "still", 1)
    for k in range(1, 20):
        shutil.copy(folder / "000.png", folder / f"{k:03d}.png")
    said = mastd3r(folder)
    incomplete(said, "the camera never moves enough", "20 frames")
    assert not [name for name in ("trajectory.txt", "camera.json") if (said.folder / name).exists()]


def test_noise_without_a_scene(mastd3r: Command, tmp_path: Path) -> None:
    """Every frame another noise: nothing can be followed, and nothing may pretend that it was."""
    folder = tmp_path / "noise"
    folder.mkdir()
    rng = np.random.default_rng(0)
    for k in range(8):
        cv2.imwrite(str(folder / f"{k}.png"), rng.integers(0, 255, (120, 160, 3), np.uint8))
    incomplete(mastd3r(folder), "expected")


def test_a_video_cut_short_runs_on_what_is_there(mastd3r: Command, room_clip: Path, tmp_path: Path) -> None:
    whole = write_video(
        tmp_path / "whole.mp4", pictures(room_clip, 24), mux={"movflags": "frag_keyframe+empty_moov"}, gop=4
    )
    data = whole.read_bytes()
    (tmp_path / "cut.mp4").write_bytes(data[: int(0.85 * len(data))])
    said = mastd3r(tmp_path / "cut.mp4")
    assert said.code in (0, 2)
    if said.code == 2:
        incomplete(said, "expected")
    assert 12 <= len(said.poses()) < 24


def test_a_video_without_its_index(mastd3r: Command, room_clip: Path, tmp_path: Path) -> None:
    whole = write_video(tmp_path / "whole.mp4", pictures(room_clip, 6))
    (tmp_path / "cut.mp4").write_bytes(whole.read_bytes()[:-600])
    mastd3r(tmp_path / "cut.mp4").refused("cut.mp4", "expected a")


def test_depth_that_is_not_finite(mastd3r: Command, room_clip: Path, tmp_path: Path) -> None:
    """NaN in depth files is none, is said, and does not reach the poses."""
    clip = tmp_path / "clip"
    shutil.copytree(room_clip, clip)
    lines = []
    for file in sorted((clip / "depth").iterdir()):
        depth = cv2.imread(str(file), cv2.IMREAD_UNCHANGED).astype(np.float32) / 5000
        depth[40:60, 50:90] = np.nan
        depth[::7, ::5] = np.inf
        np.save(file.with_suffix(".npy"), depth)
        lines.append(f"{file.stem} depth/{file.stem}.npy\n")
    (clip / "depth.txt").write_text("".join(lines))
    said = mastd3r(clip, "--pointmaps", "depth", "--end", "12", "--intrinsics", "150,150,79.5,59.5")
    assert said.code == 0 and said.err == []
    assert any("not finite" in c for c in said.record["choices"])
    assert len(said.poses()) == 12 and np.isfinite(said.poses()).all()


# -- interruptions ---------------------------------------------------------------------------------------------------


class Interrupted:
    """A source whose user presses Ctrl-C at one of its frames."""

    def __init__(self, source: Any, at: int) -> None:
        self._source, self._at = source, at

    def __getattr__(self, name: str) -> Any:
        return getattr(self._source, name)

    def frames(self) -> Iterator[Frame]:
        for frame in self._source.frames():
            if frame.index == self._at:
                raise KeyboardInterrupt
            yield frame


def test_ctrl_c_keeps_what_was_computed(mastd3r: Command, room_clip: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    opened = pipeline.open_source
    monkeypatch.setattr(pipeline, "open_source", lambda *a, **k: Interrupted(opened(*a, **k), 20))
    said = mastd3r(room_clip)
    assert said.code == 130
    assert len(said.err) == 1 and said.err[0].startswith("mastd3r: stopped")
    assert said.record["status"] == "incomplete" and "Ctrl-C" in said.record["reason"]
    assert len(said.poses()) == 20 and np.isfinite(said.poses()).all()


def full_disk(monkeypatch: pytest.MonkeyPatch, names: tuple[str, ...] | None) -> None:
    """From now on files of these names (None: all) do not fit."""

    def refuse(path: Any, *args: Any, **kwargs: Any) -> Any:
        if names is None or Path(path).name.removesuffix(".part") in names:
            raise OSError(errno.ENOSPC, "No space left on device")
        return open(path, *args, **kwargs)

    monkeypatch.setattr(files, "open", refuse, raising=False)


@pytest.mark.parametrize("name", ["trajectory.txt", "metrics.json", "config.yaml"])
def test_a_disk_that_fills_up(mastd3r: Command, room_clip: Path, monkeypatch: pytest.MonkeyPatch, name: str) -> None:
    full_disk(monkeypatch, (name,))
    said = mastd3r(room_clip, "--end", "18")
    said.refused(name, "No space left on device", "free some space")
    if name != "config.yaml":
        incomplete(said, name)


def test_a_disk_that_is_full_from_the_start(mastd3r: Command, room_clip: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    full_disk(monkeypatch, None)
    mastd3r(room_clip).refused("No space left on device", "free some space")


def test_a_disk_that_fills_up_for_good(mastd3r: Command, room_clip: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Nothing can be written any more, not even why: still one line and exit code 2."""
    finish = job.finish_graph

    def then_full(*args: Any, **options: Any) -> bool:
        found = finish(*args, **options)
        full_disk(monkeypatch, None)
        return found

    monkeypatch.setattr(job, "finish_graph", then_full)
    mastd3r(room_clip, "--end", "18").refused("No space left on device", "free some space")


# -- what works ------------------------------------------------------------------------------------------------------


def test_an_earlier_run_may_be_overwritten_and_evaluated(mastd3r: Command, room_clip: Path) -> None:
    first = mastd3r(room_clip, "--end", "20")
    assert first.code == 0 and first.err == [] and "report.html" in first.out
    (first.folder / "notes.md").write_text("mine")
    second = mastd3r(room_clip, "--end", "18")
    assert second.code == 0 and len(second.poses()) == 18
    assert second.record["status"] == "complete" and second.record["command"][:2] == ["mastd3r", "run"]
    assert (second.folder / "notes.md").read_text() == "mine"
    scored = mastd3r("eval", second.folder, room_clip, run=False)
    assert scored.code == 0
    metrics = json.loads((second.folder / "metrics.json").read_text())
    assert metrics["frames_posed"] == 18 and 0 < metrics["ate_rmse_all"] < 0.05


def test_doctor_says_what_would_be_chosen(mastd3r: Command) -> None:
    said = mastd3r("doctor", run=False)
    assert said.code == 0 and "geometric" in said.out and "keyframe_motion_ratio" in said.out


def test_a_path_that_a_terminal_must_not_get_is_refused(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    file = tmp_path / "a\x1b[2Jb.pth"
    file.write_bytes(b"x")
    assert main(["weights", "path", str(file)]) == 2
    said = capfd.readouterr()
    assert not said.out and len(said.err.splitlines()) == 1 and r"a\x1b[2Jb.pth" in said.err
