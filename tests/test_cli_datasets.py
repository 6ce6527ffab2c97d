"""Datasets through the command line: their lenses, and what is wrong with them in one line and exit code 2."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import pytest
import yaml

import miniatures
from mastd3r.cli.main import main
from mastd3r.config import CameraConfig, Config
from mastd3r.parts import with_dataset_lens
from mastd3r.sources import open_source


def run(source: Path, out: Path, *words: str) -> int:
    return main(["run", str(source), "--out", str(out), "--no-map", "--quiet", *words])


def refused(capfd: pytest.CaptureFixture[str], code: int, out: Path, *words: str) -> None:
    lines = capfd.readouterr().err.splitlines()
    assert code == 2 and len(lines) == 1 and not out.exists(), lines
    assert all(word in lines[0] for word in ("mastd3r: ", *words)), lines[0]


@pytest.mark.parametrize(
    ("kind", "lost", "words"),
    [
        ("tum", "rgb/1305031102.208637.png", ["rgb.txt line 5", "expected an image file"]),
        ("bonn", "rgb", ["rgb.txt", "expected"]),
        ("kitti-raw", "image_02/data/0000000001.png", ["expected 4 images, got 3", "missing is 1"]),
        ("kitti-odometry", "calib.txt", ["calib.txt", "got no such file"]),
        ("euroc", "mav0/cam0/sensor.yaml", ["sensor.yaml", "expected the camera's calibration"]),
    ],
)
def test_a_dataset_with_something_lost(
    tmp_path: Path, capfd: pytest.CaptureFixture[str], kind: str, lost: str, words: list[str]
) -> None:
    made = miniatures.ALL[kind](tmp_path)
    if (made.folder / lost).is_dir():
        shutil.rmtree(made.folder / lost)
    else:
        (made.folder / lost).unlink()
    code = run(made.folder, tmp_path / "out")
    refused(capfd, code, tmp_path / "out", *words)


def test_a_folder_of_sequences_is_refused_with_their_names(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    miniatures.kitti_raw(tmp_path / "raw")
    code = run(tmp_path / "raw", tmp_path / "out")
    refused(capfd, code, tmp_path / "out", "expected one sequence", "2011_09_26/2011_09_26_drive_0001_sync")


@pytest.mark.parametrize("kind", ["7scenes", "images"])
def test_a_source_without_calibration_cannot_bring_one(
    tmp_path: Path, capfd: pytest.CaptureFixture[str], kind: str
) -> None:
    made = miniatures.seven_scenes(tmp_path)
    code = run(made.folder, tmp_path / "out", "--kind", kind, "--intrinsics", "dataset")
    refused(capfd, code, tmp_path / "out", "--intrinsics dataset: expected a calibration in", f"({kind}), got none")


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["--kind", "lidar"], ["--kind", "'lidar'", "kitti-odometry"]),
        (["--kind", "video"], ["expected a video file", "got a folder"]),
        (["--set", "source.kind=tumm"], ["source.kind", "expected one of auto, video", "'tumm'"]),
        (["--intrinsics", "datasets"], ["--intrinsics", "'datasets'"]),
    ],
)
def test_options_that_cannot_be_served(
    tmp_path: Path, capfd: pytest.CaptureFixture[str], words: list[str], said: list[str]
) -> None:
    made = miniatures.seven_scenes(tmp_path)
    refused(capfd, run(made.folder, tmp_path / "out", *words), tmp_path / "out", *said)


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["tumm"], ["tumm: expected one of tum, bonn", "perhaps you meant tum"]),
        (["bonn", "baloon"], ["baloon: expected a sequence of bonn", "perhaps balloon"]),
        (["list", "nothing"], ["nothing: expected one of tum"]),
        (["--speed"], ["--speed"]),
    ],
)
def test_downloads_of_nothing(
    tmp_path: Path, capfd: pytest.CaptureFixture[str], words: list[str], said: list[str]
) -> None:
    refused(capfd, main(["download", *words, "--to", str(tmp_path / "out")]), tmp_path / "out", *said)


def test_the_default_reads_no_calibration(tmp_path: Path) -> None:
    """Every source but one knows its lens, and a run is told of it only when that is asked for."""
    source = open_source(miniatures.euroc(tmp_path).folder, Config().source)
    assert source.calibration
    assert with_dataset_lens(Config(), source) == (Config(), [])
    told, notes = with_dataset_lens(Config(camera=CameraConfig(from_dataset=True)), source)
    assert told.camera.intrinsics == source.calibration and "calibration of the dataset (euroc)" in notes[0]


def test_a_run_with_the_datasets_lens(room_clip: Path, tmp_path: Path) -> None:
    """The made room is a TUM layout whose info.json has its lens; the run says that it was used."""
    words = ["--pointmaps", "depth", "--end", "8"]
    assert run(room_clip, tmp_path / "out", "--intrinsics", "dataset", *words) == 0
    record = json.loads((tmp_path / "out" / "run.json").read_text())
    info = json.loads((room_clip / "info.json").read_text())
    assert record["camera"]["found"] == "given" and record["camera"]["focal_px"] == pytest.approx(info["fx"])
    assert any("calibration of the dataset (tum)" in line for line in record["choices"])
    assert any(line == "tum: rgb.txt is there" for line in record["choices"])
    config = yaml.safe_load((tmp_path / "out" / "config.yaml").read_text())
    assert config["camera"]["intrinsics"][0] == info["fx"] and config["camera"]["from_dataset"]
