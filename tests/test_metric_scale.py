"""Metres: what each way to them finds in made maps, how honest its sigma is, and what it refuses."""

from __future__ import annotations

import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

BENCHMARKS = Path(__file__).resolve().parents[1] / "benchmarks"
sys.path.insert(0, str(BENCHMARKS))

import metric_worlds as worlds  # noqa: E402
from mastd3r.cli.main import main  # noqa: E402
from mastd3r.errors import ConfigError, InputError  # noqa: E402
from mastd3r.metric.depth import sensor_depth  # noqa: E402
from mastd3r.metric.estimate import biweight, jackknifed  # noqa: E402
from mastd3r.metric.ground import scale_from_height  # noqa: E402
from mastd3r.metric.measure import measure  # noqa: E402
from mastd3r.metric.positions import (  # noqa: E402
    Positions,
    earth_fixed_m,
    paired,
    read_positions,
    scale_from_positions,
)
from mastd3r.metric.spec import absolute, parsed  # noqa: E402

Array = NDArray[Any]


# -- how often a sigma holds; benchmarks/metric_scale.py counts the same over more trials ------------------------------


@pytest.mark.parametrize(
    ("trial", "trials", "least", "most"),
    [
        (worlds.positions_trial, 12, 0.4, 0.95),
        (worlds.points_trial, 20, 0.45, 0.9),
        (worlds.height_trial, 3, 0.2, 1.0),
        (None, 12, 0.4, 0.95),
    ],
    ids=["positions", "points", "height", "depth"],
)
def test_the_true_factor_is_within_a_sigma_as_often_as_said(
    trial: Callable[[int], Any] | None, trials: int, least: float, most: float, tmp_path: Path
) -> None:
    found = worlds.held([worlds.depth_trial(n, tmp_path) if trial is None else trial(n) for n in range(trials)])
    assert least <= found["within_1_sigma"] <= most, found
    assert found["within_2_sigma"] >= 0.8, found
    assert 0.4 < found["error_rms"] / found["sigma_median"] < 2.2, found


def test_drift_that_neighbours_share_is_not_taken_for_many_witnesses() -> None:
    """Two hundred frames whose errors hang together say little more than as many pieces as do not."""
    errors = np.stack([worlds.drift(np.random.default_rng(n), 200, 0.05, 0.97)[:, 0] for n in range(60)])
    found = np.array([jackknifed(lambda rows, e=e: biweight(e[rows]), 200) for e in errors])
    assert 0.45 < (np.abs(found[:, 0]) < found[:, 1]).mean() < 0.9
    assert np.median(found[:, 1]) > 3 * 0.05 / np.sqrt(200)


# -- positions ---------------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def walked() -> tuple[Any, Array]:
    """A made map of a walk, and where the camera was, metres."""
    rng = np.random.default_rng(3)
    poses = worlds.walk(rng, 60)
    return worlds.material(poses, np.zeros((0, 3)), rng), poses[:, :3, 3]


def test_frames_without_a_measured_pose_are_never_used(walked: tuple[Any, Array]) -> None:
    map_, true_m = walked
    guessed = np.arange(60) % 3 == 1
    poses = map_.trajectory.world_from_cam.copy()
    poses[guessed, :3, 3] += 5.0
    states = tuple("interpolated" if g else "tracked" for g in guessed)
    map_ = replace(map_, trajectory=replace(map_.trajectory, world_from_cam=poses, states=states))
    between_s = np.sort(np.concatenate([map_.trajectory.timestamps_s, map_.trajectory.timestamps_s[:-1] + 0.05]))
    at = [np.interp(between_s, map_.trajectory.timestamps_s, true_m[:, axis]) for axis in range(3)]
    ours, theirs = paired(Positions(Path("x"), between_s, np.stack(at, 1)), map_.trajectory)
    assert len(ours) == 40 + 19  # the tracked frames, and halfway between two that follow one another
    np.testing.assert_allclose(ours * worlds.METRES, theirs, atol=1e-9)


ROWS = "".join(f"{t / 10:.1f} {t * 0.5} {t * t * 0.02} 1 0 0 0 1\n" for t in range(8))


def _like(rows: str, separator: str, head: str, times: float = 1.0) -> str:
    lines = [[str(float(w[0]) * times), *w[1:4]] for w in (line.split() for line in rows.splitlines())]
    return head + "".join(separator.join(line) + "\n" for line in lines)


@pytest.mark.parametrize(
    "text",
    [
        ROWS,
        "# timestamp tx ty tz qx qy qz qw\n" + ROWS,
        _like(ROWS, ",", "time,x,y,z\n"),
        _like(ROWS, ",", "#timestamp [ns],p_RS_R_x [m],p_RS_R_y [m],p_RS_R_z [m]\n", 1e9),
        _like(ROWS, ";", ""),
    ],
    ids=["tum", "heading", "csv", "euroc", "semicolons"],
)
def test_every_form_of_a_file_says_the_same(text: str, tmp_path: Path) -> None:
    (tmp_path / "p.txt").write_text(text)
    found = read_positions(tmp_path / "p.txt")
    np.testing.assert_allclose(found.times_s, np.arange(8) / 10, atol=1e-9)
    np.testing.assert_allclose(found.metres[:, 1], 0.02 * np.arange(8) ** 2, atol=1e-12)


def test_degrees_become_metres(tmp_path: Path) -> None:
    """A thousandth of a degree is 111 m along a meridian and 56 m along the parallel of 60 degrees."""
    rows = [f"{n},{60 + 0.001 * (n % 2)},{10 + 0.001 * (n // 2 % 2)},{5 * (n // 4)}\n" for n in range(8)]
    (tmp_path / "gps.csv").write_text("timestamp,lat,lon,alt\n" + "".join(rows))
    p = read_positions(tmp_path / "gps.csv").metres
    assert np.linalg.norm(p[1] - p[0]) == pytest.approx(111.42, abs=0.02)
    assert np.linalg.norm(p[2] - p[0]) == pytest.approx(55.80, abs=0.02)
    assert np.linalg.norm(p[4] - p[0]) == pytest.approx(5, abs=1e-6)
    np.testing.assert_allclose(earth_fixed_m(np.zeros((2, 3))), 0)


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("0 1 2 3\n" * 3, "at least 6 positions of the camera, got 3"),
        (ROWS + "1.0 a b c\n", "line 9: expected numbers 'time x y z', got '1.0 a b c'"),
        ("t,lat,lon,alt\n" + "0,95,0,0\n" * 7, "expected a time and a place"),
        (ROWS.replace("0.5 2.5", "0.5 nan"), "line 6: expected a time and a place"),
        ("", "got 0"),
    ],
)
def test_a_file_that_is_none(text: str, said: str, tmp_path: Path) -> None:
    (tmp_path / "p.txt").write_text(text)
    with pytest.raises(InputError, match=said.replace("(", r"\(")):
        measure(f"positions:{tmp_path / 'p.txt'}")


def test_positions_of_another_time_or_another_path(walked: tuple[Any, Array]) -> None:
    map_, true_m = walked
    times = map_.trajectory.timestamps_s
    with pytest.raises(InputError, match=r"at times of tracked frames \(0.000 to 5.900 s\), got 0 of 60 \(1000"):
        scale_from_positions(Positions(Path("p"), times + 1000, true_m), map_)
    rng = np.random.default_rng(0)
    with pytest.raises(InputError, match="expected"):
        scale_from_positions(Positions(Path("p"), times, rng.normal(0, 5, true_m.shape)), map_)
    with pytest.raises(InputError, match="changes its place"):
        scale_from_positions(Positions(Path("p"), times, np.ones_like(true_m)), map_)


def test_any_axes_and_any_origin(walked: tuple[Any, Array]) -> None:
    map_, true_m = walked
    turned = true_m @ Rotation.from_rotvec([1.0, -2.0, 0.5]).as_matrix().T + [4e6, -3e5, 7e4]
    found = scale_from_positions(Positions(Path("p"), map_.trajectory.timestamps_s, turned), map_)
    assert found.metres_per_unit == pytest.approx(worlds.METRES, rel=1e-6)
    assert found.sigma_ratio is not None and found.sigma_ratio < 1e-5 and found.supports == 60


# -- ground, depth, points ---------------------------------------------------------------------------------------------


def test_a_table_is_not_the_ground_nor_are_walls() -> None:
    """The lowest level plane is; where things lie below the only one, or there is none, no metres are made up."""
    rng = np.random.default_rng(1)
    poses = worlds.walk(rng, 16)
    table = worlds.street(rng, 600, height=0.7)[:600]
    floor = worlds.street(rng, 900, height=1.5)[:900]
    found = scale_from_height(1.5, worlds.material(poses, np.concatenate([table, floor]), rng))
    assert found.metres_per_unit == pytest.approx(worlds.METRES, rel=0.03)
    things = floor + np.stack([np.zeros(900), rng.uniform(-0.7, 0.7, 900), np.zeros(900)], 1)
    with pytest.raises(InputError, match="expected ground below the camera"):
        scale_from_height(0.7, worlds.material(poses, np.concatenate([table, things]), rng))
    walls = worlds.street(rng, 1500)[1500:]
    with pytest.raises(InputError, match="expected ground below the camera"):
        scale_from_height(1.5, worlds.material(poses, walls, rng))
    with pytest.raises(InputError, match=r"whose \+y is down"):
        scale_from_height(1.5, replace(worlds.material(poses, floor, rng), down_sigma_rad=None))


def test_depth_says_its_unit_or_is_asked_for_it(tmp_path: Path) -> None:
    import cv2

    cv2.imwrite(str(tmp_path / "0.000000.png"), np.full((12, 16), 1500, np.uint16))
    with pytest.raises(InputError, match=r"expected the units a metre of .*depth:FOLDER=1000"):
        sensor_depth(tmp_path, None)
    assert sensor_depth(tmp_path, 1000.0).units_per_metre == 1000
    (tmp_path / "info.json").write_text('{"depth_scale": 256}')
    assert sensor_depth(tmp_path, None).units_per_metre == 256
    (tmp_path / "info.json").write_text('{"depth_scale": "many"}')
    with pytest.raises(InputError, match="depth_scale above 0"):
        sensor_depth(tmp_path, None)


@pytest.mark.parametrize(
    ("words", "said"),
    [
        ("points:0:1,1:1,1=2", "two points apart|6 or more static points"),
        ("points:nothing.jpg:40,45:90,75=2", "expected a number below 8, got 'nothing.jpg'"),
        ("points:0:40,45:900,75=2", "expected pixels of a 160x120 photograph, got 900,75"),
    ],
)
def test_points_that_cannot_be_measured(words: str, said: str) -> None:
    rng = np.random.default_rng(0)
    points = np.stack([*rng.uniform(-2, 2, (2, 300)), np.full(300, 6.0)], 1)
    map_ = worlds.material(worlds.walk(rng, 8, 0.5), points, rng)
    wanted = measure(words)
    assert wanted is not None
    with pytest.raises(InputError, match=said):
        wanted.of(map_)


# -- words -------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "words",
    ["depth:/a/b", "depth:/a/b=1000.0", "positions:/a/c=d.txt", "points:a:b.jpg:1.5,2.0:3.0,4.0=1.25", "factor=2.0"],
)
def test_words_come_back(words: str) -> None:
    assert parsed(words).text == words and absolute(words) == words


def test_paths_mean_the_same_from_everywhere(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.chdir(tmp_path)
    assert absolute("depth:d=500") == f"depth:{tmp_path.resolve() / 'd'}=500.0"
    assert parsed("points:a:b.jpg:1,2:3,4=1").frame == "a:b.jpg"


NO_WORDS = (
    *("", "5", "depth", "depth:", "depth=3", "factor:3", "factor=0", "factor=-1", "factor=nan", "camera-height=1,65"),
    *("points:a=1", "points:a:1,2:3=1", "points:a:1,2:3,4", "camera-height=1e9", "imu:file"),
)


@pytest.mark.parametrize("words", NO_WORDS)
def test_words_that_are_none(words: str) -> None:
    with pytest.raises(ConfigError, match="--scale"):
        parsed(words)


@pytest.mark.parametrize(
    ("words", "said"),
    [
        ("metres", "--scale: expected depth:FOLDER"),
        ("", "--scale: expected depth:FOLDER"),
        ("positions:nowhere.txt", "expected readable positions, got no such file"),
        ("depth:nowhere", "expected a folder of depth images, got"),
    ],
)
def test_a_run_is_refused_before_it_begins(
    words: str, said: str, room_clip: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["run", str(room_clip), "--out", str(tmp_path / "run"), "--scale", words]) == 2
    shown = " ".join(capsys.readouterr().err.split())
    assert said in shown and not (tmp_path / "run").exists()
