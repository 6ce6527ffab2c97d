"""The flight's path, the video file, depth images, and the exports of a run's splat."""

from __future__ import annotations

from pathlib import Path

import av
import cv2
import numpy as np
import pytest

from mastd3r.errors import InputError, OutputError
from mastd3r.export.run_folder import write_depth_png
from mastd3r.export.video import write_video
from mastd3r.geometry.path import smoothed_path
from mastd3r.geometry.se3 import se3_exp
from mastd3r.offline.renders import FLIGHT_FPS, depth_png_per_unit, flight_path


def still_and_moving(count: int = 40) -> tuple[np.ndarray, np.ndarray]:
    """Times, and poses on a straight line that turn evenly about one axis."""
    times_s = np.arange(count) / 20
    poses = np.stack([se3_exp(np.array([0.1 * t, 0, 0.3 * t, 0, 0.4 * t, 0])) for t in times_s])
    poses[:, :3, 3] = np.stack([times_s, 0 * times_s, 2 * times_s], 1)
    return times_s, poses


def test_an_even_motion_stays_what_it_is() -> None:
    times_s, poses = still_and_moving()
    middle = slice(12, 28)
    smooth = smoothed_path(times_s, poses, times_s, 0.1)
    np.testing.assert_allclose(smooth[middle], poses[middle], atol=1e-6)
    rotation = smooth[:, :3, :3]
    np.testing.assert_allclose(
        rotation @ rotation.transpose(0, 2, 1), np.tile(np.eye(3), (len(rotation), 1, 1)), atol=1e-9
    )


@pytest.mark.parametrize("seed", range(5))
def test_a_shaking_hand_is_stilled(seed: int) -> None:
    times_s, poses = still_and_moving()
    rng = np.random.default_rng(seed)
    shaken = np.stack([pose @ se3_exp(0.02 * rng.standard_normal(6)) for pose in poses])
    jerk = [
        np.abs(np.diff(p[:, :3], n=2, axis=0)).mean() for p in (shaken, smoothed_path(times_s, shaken, times_s, 0.2))
    ]
    assert jerk[1] < 0.2 * jerk[0]


def test_a_gap_in_time_is_crossed() -> None:
    """Between two poses far apart in time the nearer one counts; nothing is divided by zero."""
    poses = np.stack([np.eye(4), np.eye(4)])
    poses[1, 0, 3] = 1.0
    path = smoothed_path(np.array([0.0, 100.0]), poses, np.array([0.0, 30.0, 70.0, 100.0]), 0.1)
    np.testing.assert_allclose(path[:, 0, 3], [0, 0, 1, 1], atol=1e-9)


def test_the_flight_takes_as_long_as_the_video_within_bounds() -> None:
    _, poses = still_and_moving()
    for length_s, expected_s in ((0.5, 2), (7, 7), (500, 10)):
        assert len(flight_path(np.linspace(0, length_s, 40), poses)) == expected_s * FLIGHT_FPS
    poses[3:30] = np.nan
    assert np.isfinite(flight_path(np.linspace(0, 7, 40), poses)).all()
    with pytest.raises(InputError, match="at least one pose"):
        flight_path(np.arange(40.0), np.full_like(poses, np.nan))


def test_a_video_holds_the_frames_that_were_written(tmp_path: Path) -> None:
    colors = np.linspace(0.1, 0.9, 9)
    frames = [np.tile(np.array([c, 0.5, 1 - c], np.float32), (47, 63, 1)) for c in colors]
    write_video(tmp_path / "v.mp4", iter(frames), 30)
    with av.open(str(tmp_path / "v.mp4")) as container:
        assert container.streams.video[0].average_rate == 30
        shown = [f.to_ndarray(format="rgb24") for f in container.decode(video=0)]
    assert len(shown) == 9 and shown[0].shape == (46, 62, 3)
    for color, image in zip(colors, shown, strict=True):
        assert np.abs(image.mean((0, 1)) / 255 - [color, 0.5, 1 - color]).max() < 0.03


def test_a_video_that_cannot_be_written_is_one_clear_line(tmp_path: Path) -> None:
    with pytest.raises(OutputError, match="expected to write a video"):
        write_video(tmp_path / "missing" / "v.mp4", iter([np.zeros((32, 32, 3), np.uint8)]), 30)


@pytest.mark.parametrize("median", [0.003, 1.0, 700.0])
def test_depth_images_hold_sixteen_median_depths(tmp_path: Path, median: float) -> None:
    per_unit = depth_png_per_unit(median)
    depth = np.array([[0.0, median, 15.9 * median, 100 * median]], np.float32)
    write_depth_png(tmp_path, 1.5, depth, per_unit)
    levels = cv2.imread(str(tmp_path / "1.500000.png"), cv2.IMREAD_UNCHANGED)
    assert levels.dtype == np.uint16 and levels[0, 0] == 0 and levels[0, 3] == 65535
    np.testing.assert_allclose(levels[0, 1:3] / per_unit, depth[0, 1:3], rtol=1e-3)
    with pytest.raises(OutputError, match="finite"):
        write_depth_png(tmp_path, 2.5, np.array([[np.nan]]), per_unit)
