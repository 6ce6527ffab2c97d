"""``mastd3r map``: the map of a run that has ended goes on, and whatever goes wrong costs nothing that was there."""

from __future__ import annotations

import argparse
import errno
import json
import shutil
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

import mastd3r
from mastd3r.cli.main import main
from mastd3r.cli.options import config_from_args
from mastd3r.cli.parser import parser
from mastd3r.config import HOLDOUT_EVERY, Config, config_from_yaml
from mastd3r.errors import ConfigError
from mastd3r.export.read_run import read_run
from mastd3r.export.run_folder import RunFolder, stamp
from mastd3r.mapping.gaussian_arrays import of_degree
from mastd3r.mapping.ply import read_gaussians_ply
from mastd3r.mapping.quality import CPU
from mastd3r.offline import continued_map, map_progress, map_stage
from mastd3r.progress import Bar
from mastd3r.sources import open_source
from mastd3r.types import View

STEPS = 40
DEPTH = ("--pointmaps", "depth", "--intrinsics", "150,150,79.5,59.5")  # the quickest way to a run


@dataclass(frozen=True)
class Ended:
    """A run that has ended, and the training views that it had."""

    path: Path
    views: list[View]


@pytest.fixture(scope="module")
def ended(room_clip: Path, tmp_path_factory: pytest.TempPathFactory) -> Ended:
    """The clip with a small map; its poses are those that it was trained with."""
    out, views = tmp_path_factory.mktemp("continued") / "run", []

    train_map = map_stage.train_map

    def watched(*given: Any) -> map_stage.TrainedMap:
        views.extend(given[3])
        return train_map(*given)

    sets = (f"mapping.iterations={STEPS}", "mapping.width_px=120")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(map_stage, "train_map", watched)
        words = ["run", str(room_clip), "--out", str(out), "--quiet", *DEPTH]
        assert main([*words, *(w for s in sets for w in ("--set", s))]) == 0
    return Ended(out, views)


@pytest.fixture
def run(ended: Ended, tmp_path: Path) -> Path:
    """A copy that a test may change."""
    return Path(shutil.copytree(ended.path, tmp_path / "run"))


@pytest.fixture
def refused(capfd: pytest.CaptureFixture[str]) -> Callable[..., None]:
    """Exit code 2 and one line with these words in it."""

    def check(argv: list[str | Path], *words: str) -> None:
        capfd.readouterr()
        assert main([str(w) for w in argv]) == 2
        lines = capfd.readouterr().err.splitlines()
        assert len(lines) == 1 and lines[0].startswith("mastd3r: "), lines
        for word in words:
            assert word in lines[0], lines[0]

    return check


def contents(folder: Path) -> dict[str, bytes]:
    """Every file of a folder."""
    return {p.relative_to(folder).as_posix(): p.read_bytes() for p in sorted(folder.rglob("*")) if p.is_file()}


def record(folder: Path) -> dict[str, Any]:
    data: dict[str, Any] = json.loads((folder / "run.json").read_text())
    return data


def metrics(folder: Path) -> dict[str, Any]:
    data: dict[str, Any] = json.loads((folder / "metrics.json").read_text())
    return data


# -- what it goes on with ------------------------------------------------------------------------------------------


def test_the_training_views_are_those_of_the_run(ended: Ended, room_clip: Path) -> None:
    run, config = read_run(ended.path), mastd3r.load(ended.path).config
    found = continued_map.rebuilt(run, open_source(room_clip, config.source), config)
    assert len(found.views) == len(ended.views) == 21
    for a, b in zip(found.views, ended.views, strict=True):
        assert a.timestamp_s == b.timestamp_s and a.camera == b.camera
        np.testing.assert_array_equal(a.image, b.image)
        np.testing.assert_allclose(a.world_from_cam, b.world_from_cam, atol=1e-7)
        np.testing.assert_allclose(a.static.astype(float), b.static.astype(float), atol=0.01)
        assert a.uncertainty is None
    kept = {stamp(f.record.timestamp_s) for f in found.holdout}
    assert kept == {p.stem for p in (ended.path / "renders").iterdir()} and len(kept) == 24 // HOLDOUT_EVERY
    assert not kept & {stamp(v.timestamp_s) for v in found.views}


@pytest.mark.usefixtures("short_flight")
def test_it_gets_better_and_everything_follows(run: Path) -> None:
    before, old = contents(run), metrics(run)
    assert main(["map", str(run), "--quiet"]) == 0
    after, new = contents(run), metrics(run)
    assert set(after) == set(before)
    for key in ("psnr_holdout", "psnr_holdout_static", "psnr_mapped"):
        assert new[key] > old[key], key
    assert {k for k in old if k not in new} == set() and new["fps_tracking"] == old["fps_tracking"]
    said = record(run)
    assert said["status"] == "complete" and said["timings_s"]["map continued"] > 0
    note = said["choices"][-1]
    assert f"{STEPS // 2} steps" in note and f"from the {old['gaussians']} Gaussians" in note and "u(p)" in note
    for name in ("gaussians.ply", "gaussians.spz", "report.html", "flight.mp4"):
        assert after[name] != before[name], name
    for name in ("trajectory.txt", "keyframes.txt", "cloud.ply", "camera.json", "masks.mp4"):
        assert after[name] == before[name], name  # poses are not refined in this run


@pytest.mark.usefixtures("short_flight")
def test_a_run_without_a_map_gets_one(room_clip: Path, tmp_path: Path) -> None:
    out, moved = tmp_path / "run", tmp_path / "moved"
    shutil.copytree(room_clip, tmp_path / "clip")
    words = ["--out", str(out), "--no-map", "--quiet", "--end", "12", "--set", "mapping.iterations=30", *DEPTH]
    assert main(["run", str(tmp_path / "clip"), *words]) == 0
    before = contents(out)
    (tmp_path / "clip").rename(moved)
    assert main(["map", str(out), "--quality", "draft", "--minutes", "0.05", "--source", str(moved), "--quiet"]) == 0
    names = {f"{n}/{p.name}" for n in ("renders", "alpha", "depth") for p in (out / n).iterdir()}
    assert len(names) == 6 and metrics(out)["holdout_frames"] == 2
    new = {"gaussians.ply", "gaussians.spz", "flight.mp4", *names}
    assert set(contents(out)) - set(before) == new
    config = config_from_yaml(out / "config.yaml").mapping
    assert config.enabled and config.quality == "draft" and config.minutes == 0.05 and config.width_px == 160
    facts = record(out)
    assert "placement" not in facts and facts["map"]["depth_png_per_unit"] > 0
    assert "points of cloud.ply" in facts["choices"][-1] and "in 0.05 min" in facts["choices"][-1]
    assert main(["export", str(out), "--to", "depth", "--out", str(tmp_path / "depth")]) == 0


def test_a_map_never_becomes_coarser(ended: Ended) -> None:
    run = mastd3r.load(ended.path)
    start = continued_map.start_of(read_run(ended.path))
    assert start.gaussians is not None
    few, device, _ = continued_map.options_of(run.config, None, "draft", (160, 120), start)
    assert device == "cpu" and few.mapping.width_px == 160 and few.mapping.iterations == CPU["draft"].iterations
    limited = continued_map.replace(run.config, mapping=continued_map.replace(run.config.mapping, max_gaussians=5))
    kept, _, _ = continued_map.options_of(limited, 2.0, None, (160, 120), start)
    assert kept.mapping.max_gaussians == len(start.gaussians.means) and kept.mapping.minutes == 2
    assert kept.mapping.width_px == 120 and kept.mapping.iterations == STEPS
    padded = of_degree(start.gaussians, 2)
    assert padded.sh_rest.shape[1:] == (8, 3) and not padded.sh_rest.any()


# -- what goes wrong -----------------------------------------------------------------------------------------------


def test_no_run_folder(tmp_path: Path, refused: Callable[..., None]) -> None:
    refused(["map", tmp_path], "expected a run folder", "no run.json")
    refused(["map", tmp_path / "nowhere"], "expected a run folder")


def test_neither_map_nor_cloud(run: Path, refused: Callable[..., None]) -> None:
    (run / "gaussians.ply").unlink()
    (run / "cloud.ply").unlink()
    unchanged = contents(run)
    refused(["map", run], "expected gaussians.ply or a cloud.ply")
    assert contents(run) == unchanged


def test_photographs_that_are_not_the_runs(run: Path, room_clip: Path, tmp_path: Path, refused: Any) -> None:
    unchanged = contents(run)
    refused(["map", run, "--source", tmp_path / "nowhere"], "nowhere", "got no such path")
    fewer, larger = tmp_path / "fewer", tmp_path / "larger"
    shutil.copytree(room_clip, fewer)
    lines = (fewer / "rgb.txt").read_text().splitlines()
    (fewer / "rgb.txt").write_text("\n".join(lines[:-2]) + "\n")
    refused(["map", run, "--source", fewer], "fewer", "expected the 24 frames", "got 22")
    (fewer / "rgb.txt").write_text("\n".join([lines[0], *lines[2:]]) + "\n")
    refused(["map", run, "--source", fewer], "fewer", "expected the 24 frames", "in place of")
    larger.mkdir()
    for n in range(24):
        cv2.imwrite(str(larger / f"{n:03d}.png"), np.zeros((60, 80, 3), np.uint8))
    refused(["map", run, "--source", larger], "expected photographs of 160x120", "got 80x60")
    assert contents(run) == unchanged
    facts = record(run)
    facts["source"]["path"] = str(tmp_path / "gone")
    (run / "run.json").write_text(json.dumps(facts))
    refused(["map", run], "gone", "--source")


@pytest.mark.parametrize("minutes", ["0", "-1", "nan", "inf", "soon"])
def test_minutes_that_are_none(run: Path, minutes: str, refused: Callable[..., None]) -> None:
    unchanged = contents(run)
    refused(["map", run, f"--minutes={minutes}"], "--minutes", minutes)
    assert contents(run) == unchanged


def test_options_of_the_library(ended: Ended) -> None:
    for words in ({"minutes": 0.0}, {"minutes": float("nan")}, {"quality": "best"}):
        with pytest.raises(ConfigError, match="expected"):
            mastd3r.load(ended.path).train_map(**words)  # type: ignore[arg-type]


def test_a_full_disk_at_the_splat(run: Path, monkeypatch: pytest.MonkeyPatch, refused: Callable[..., None]) -> None:
    unchanged = contents(run)

    def full(path: Path, _gaussians: Any) -> None:
        path.write_bytes(b"half")
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(map_stage, "write_gaussians_spz", full)
    refused(["map", run, "--quiet"], "gaussians.spz", "No space left")
    assert contents(run) == unchanged


@pytest.mark.usefixtures("short_flight")
def test_a_full_disk_at_the_pictures(run: Path, monkeypatch: pytest.MonkeyPatch, refused: Any) -> None:
    before = contents(run)

    def full(self: RunFolder, *_: Any) -> None:
        raise mastd3r.OutputError(f"{self.path}: expected to write, got No space left on device")

    monkeypatch.setattr(RunFolder, "write_depth", full)
    refused(["map", run, "--quiet"], "No space left")
    changed = {name for name, data in contents(run).items() if before.get(name) != data}
    assert changed == {"gaussians.ply", "gaussians.spz", "run.json"} and set(contents(run)) == set(before)
    assert not (run / continued_map.STAGED).exists()
    said = record(run)
    assert said["status"] == "complete" and "older than the splat" in said["choices"][-1]


def test_ctrl_c_keeps_the_splat_as_it_is(run: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    before, step = contents(run), map_progress.MapProgress.__call__

    def stopped(self: map_progress.MapProgress, number: int, loss: float) -> None:
        step(self, number, loss)
        if self.steps == 5:
            raise KeyboardInterrupt

    monkeypatch.setattr(map_progress.MapProgress, "__call__", stopped)
    assert main(["map", str(run), "--quiet"]) == 130
    changed = {name for name, data in contents(run).items() if before.get(name) != data}
    assert changed == {"gaussians.ply", "gaussians.spz", "run.json"} and set(contents(run)) == set(before)
    assert len(read_gaussians_ply(run / "gaussians.ply").means) > 100
    said = record(run)
    assert said["status"] == "complete" and "5 steps" in said["choices"][-2]
    assert "stopped" in said["choices"][-1]


# -- what is said --------------------------------------------------------------------------------------------------


class Listening:
    """A reporter that keeps what was said."""

    def __init__(self) -> None:
        self.steps, self.said = 0, []  # type: ignore[var-annotated]

    def advance(self, steps: int = 1) -> None:
        self.steps += steps

    def say(self, text: str) -> None:
        self.said.append((self.steps, text))

    @contextmanager
    def stage(self, name: str, total: int | None, unit: str) -> Iterator[Bar]:
        yield self if name == "map" else Listening()


@pytest.mark.usefixtures("short_flight")
def test_what_is_said_while_it_trains(run: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(map_progress, "MEASURED_APART_S", 0.0)
    monkeypatch.setattr(map_progress, "MEASURED_RATIO", 1e9)
    ear = Listening()
    mastd3r.load(run).train_map(reporter=ear)
    first, last = ear.said[0], ear.said[-1]
    assert first == (0, f"{STEPS // 2} steps on images 120 px wide, at most {CPU['standard'].max_gaussians} Gaussians")
    assert any("left" in text for step, text in ear.said if step < STEPS // 2) and "left" not in last[1]
    shown = float(last[1].split("PSNR ")[1].split()[0])
    assert shown == pytest.approx(metrics(run)["psnr_mapped"], abs=2) and ear.steps == STEPS // 2


def test_durations_in_words() -> None:
    said = [map_progress.duration(s) for s in (0.2, 40, 100, 3600, 5400)]
    assert said == ["0 s", "40 s", "2 min", "60 min", "1 h 30 min"]


# -- options of run ------------------------------------------------------------------------------------------------


def arguments(*words: str) -> argparse.Namespace:
    return parser().parse_args(["run", "a.mp4", "--out", "b", *words])


def test_quality_and_minutes_of_a_run() -> None:
    mapping = config_from_args(arguments("--quality", "high", "--map-minutes", "2.5")).mapping
    assert (mapping.quality, mapping.minutes) == ("high", 2.5)
    assert config_from_args(arguments()).mapping == Config().mapping


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["--quality", "best"], ["--quality", "'best'", "draft"]),
        (["--map-minutes", "0"], ["--map-minutes", "above 0", "got 0"]),
        (["--map-minutes=-2"], ["--map-minutes", "got -2"]),
        (["--map-minutes", "nan"], ["--map-minutes", "got nan"]),
        (["--map-minutes", "inf"], ["--map-minutes", "got inf"]),
        (["--map-minutes", "long"], ["--map-minutes", "'long'"]),
        (["--set", "mapping.minutes=-1"], ["mapping.minutes", "got -1"]),
        (["--set", "mapping.minutes=.nan"], ["mapping.minutes", "got nan"]),
        (["--no-map", "--quality", "draft"], ["--quality", "got --no-map"]),
        (["--no-map", "--map-minutes", "1"], ["--map-minutes", "got --no-map"]),
        (["--no-map", "--realtime"], ["--realtime", "got --no-map"]),
    ],
)
def test_options_that_a_run_refuses(
    room_clip: Path, tmp_path: Path, words: list[str], said: list[str], refused: Callable[..., None]
) -> None:
    refused(["run", room_clip, "--out", tmp_path / "out", "--quiet", *words], *said)
    assert not (tmp_path / "out").exists()
