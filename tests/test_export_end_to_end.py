"""A run of the made room, exported: real tracks on what stands still, under the names of the room's own images."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

import mastd3r
from colmap_reader import Model, read_binary
from mastd3r.cli.main import main
from mastd3r.export.tracks import Tracks, read_tracks

Array = NDArray[Any]


@pytest.fixture(scope="module")
def run(room_clip: Path, tmp_path_factory: pytest.TempPathFactory) -> mastd3r.Reconstruction:
    out = tmp_path_factory.mktemp("exports") / "run"
    assert main(["run", str(room_clip), "--out", str(out), "--no-map", "--quiet"]) == 0
    return mastd3r.load(out)


@pytest.fixture(scope="module")
def tracks(run: mastd3r.Reconstruction) -> Tracks:
    return read_tracks(run.path / "tracks.npz")


@pytest.fixture(scope="module")
def exported(run: mastd3r.Reconstruction) -> Path:
    out = run.path.parent / "colmap"
    assert main(["export", str(run.path), "--to", "colmap", "--out", str(out)]) == 0
    return out


@pytest.fixture(scope="module")
def model(exported: Path) -> Model:
    return read_binary(exported / "sparse" / "0")


def test_tracks_are_seen_from_two_frames_or_more(tracks: Tracks) -> None:
    count = np.bincount(tracks.point, minlength=len(tracks.points_world))
    assert len(tracks.points_world) > 500 and count.min() >= 2 and count.mean() > 4
    assert (np.diff(tracks.timestamps_s) > 0).all() and len(set(tracks.frame.tolist())) == 24
    pairs = tracks.point.astype(int) * len(tracks.timestamps_s) + tracks.frame
    assert (np.diff(pairs) > 0).all()  # by point, then by time; none twice


def test_hardly_an_observation_lies_on_the_moving_ball(tracks: Tracks, room_clip: Path) -> None:
    """Against the room's true masks, of which nothing was known."""
    rows = [line.split() for line in (room_clip / "mask.txt").read_text().splitlines() if line[0] != "#"]
    on_ball = ball_px = 0
    for time_s, file in rows:
        moving = cv2.imread(str(room_clip / file), cv2.IMREAD_GRAYSCALE) > 127
        frame = np.flatnonzero(np.abs(tracks.timestamps_s - float(time_s)) < 1e-4)
        at = np.rint(tracks.px[np.isin(tracks.frame, frame)]).astype(int)
        on_ball += int(moving[at[:, 1].clip(0, 119), at[:, 0].clip(0, 159)].sum())
        ball_px += int(moving.sum())
    share = ball_px / (len(rows) * 160 * 120)
    assert share > 0.005 and on_ball / len(tracks.point) < 0.1 * share


def test_every_image_is_there_under_its_own_name(exported: Path, model: Model, room_clip: Path) -> None:
    names = sorted(p.name for p in (room_clip / "rgb").iterdir())
    assert [image.name for image in model.images.values()] == names and len(names) == 24
    assert all((exported / "images" / n).is_file() and (exported / "masks" / f"{n}.png").is_file() for n in names)


def test_errors_are_those_of_measurements(model: Model) -> None:
    """Neither zero, as reprojections would be, nor larger than matches are good."""
    errors_px = model.errors_px()
    assert 0.02 < errors_px.mean() < 1 and np.median(errors_px) < 0.5
    of_points = np.split(errors_px, np.cumsum([len(p.track) for p in model.points.values()])[:-1])
    np.testing.assert_allclose([p.error for p in model.points.values()], [e.mean() for e in of_points], atol=1e-6)


def test_colmap_reads_it_and_undistorts_every_image(exported: Path, model: Model, tmp_path: Path) -> None:
    pycolmap = pytest.importorskip("pycolmap")
    theirs = pycolmap.Reconstruction(str(exported / "sparse" / "0"))
    theirs.update_point_3d_errors()
    ours_px = np.mean([p.error for p in model.points.values()])
    assert theirs.num_reg_images() == 24
    assert theirs.compute_mean_reprojection_error() == pytest.approx(ours_px, rel=0.01)
    pycolmap.undistort_images(str(tmp_path / "flat"), str(exported / "sparse" / "0"), str(exported / "images"))
    assert len(list((tmp_path / "flat" / "images").iterdir())) == 24


def test_wrong_words_are_one_line(run: mastd3r.Reconstruction, tmp_path: Path, capsys: Any) -> None:
    for words, says in (
        (["--to", "colmap", "--source", str(tmp_path / "nowhere")], "got no such path"),
        (["--to", "plates"], "gaussians.ply"),
        (["--to", "tum", "--undistort"], "expected --to colmap, nerfstudio, got --to tum"),
    ):
        assert main(["export", str(run.path), "--out", str(tmp_path / "out"), *words]) == 2
        lines = capsys.readouterr().err.strip().splitlines()
        assert len(lines) == 1 and says in lines[0]
    assert not list(tmp_path.iterdir())
