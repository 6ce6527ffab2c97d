"""The made room: its truth is exact and its pictures can be matched."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest
from PIL import Image

from mastd3r.config import SourceConfig
from mastd3r.errors import OutputError
from mastd3r.sources import frame_is_blank, open_source, synthetic
from mastd3r.sources.room import ROOM_HIGH, ROOM_LOW, Room, ball_pose, camera_pose
from mastd3r.sources.synthetic import SyntheticView, make_room_clip, room_camera, synthetic_frames


@pytest.fixture(scope="module")
def views() -> list[SyntheticView]:
    return list(synthetic_frames(8))


def flow_px(a: SyntheticView, b: SyntheticView) -> np.ndarray:
    """Exact motion of the static points of ``a`` into ``b``, (h, w, 2)."""
    camera = room_camera()
    grid = camera.pixel_grid()
    b_from_a = np.linalg.inv(b.world_from_cam) @ a.world_from_cam
    points = camera.rays(grid) * a.depth_m[..., None]
    return camera.project(points @ b_from_a[:3, :3].T + b_from_a[:3, 3]) - grid


def test_dense_flow_agrees_with_depth_and_poses(views: list[SyntheticView]) -> None:
    dis = cv2.DISOpticalFlow_create(cv2.DISOPTICAL_FLOW_PRESET_MEDIUM)
    for a, b in ((views[0], views[1]), (views[2], views[6])):
        grey = [cv2.cvtColor(v.frame.image, cv2.COLOR_RGB2GRAY) for v in (a, b)]
        error = np.linalg.norm(dis.calc(grey[0], grey[1], None) - flow_px(a, b), axis=-1)
        still = cv2.dilate(a.moving.astype(np.uint8), np.ones((9, 9))) == 0
        assert np.median(error[still]) < 0.3
        assert np.percentile(error[still], 90) < 1.0


def test_static_points_keep_their_colour_and_the_ball_does_not(views: list[SyntheticView]) -> None:
    a, b = views[0], views[6]
    at = (room_camera().pixel_grid() + flow_px(a, b)).astype(np.float32)
    grey = [cv2.cvtColor(v.frame.image, cv2.COLOR_RGB2GRAY).astype(np.float32) for v in (a, b)]
    off = np.abs(cv2.remap(grey[1], at[..., 0], at[..., 1], cv2.INTER_LINEAR) - grey[0])
    inside = (at > 1).all(-1) & (at[..., 0] < 318) & (at[..., 1] < 238)
    still = inside & (cv2.dilate(a.moving.astype(np.uint8), np.ones((15, 15))) == 0)
    assert np.median(off[still]) < 4
    assert np.median(off[inside & a.moving]) > 12


def test_depth_and_mask_lie_on_the_ball(views: list[SyntheticView]) -> None:
    for v in views:
        assert 0.02 < v.moving.mean() < 0.10
        points = room_camera().rays(room_camera().pixel_grid()) * v.depth_m[..., None]
        world = points @ v.world_from_cam[:3, :3].T + v.world_from_cam[:3, 3]
        centre, _ = ball_pose(v.frame.timestamp_s)
        away = np.linalg.norm(world - centre, axis=-1)
        np.testing.assert_allclose(away[v.moving], 0.34, atol=1e-3)
        assert away[~v.moving].min() > 0.34
        assert (world > ROOM_LOW - 1e-3).all() and (world < ROOM_HIGH + 1e-3).all()


def test_the_walk_is_smooth_and_long_enough() -> None:
    poses = np.array([camera_pose(i / 30) for i in range(90)])
    steps = np.linalg.norm(np.diff(poses[:, :3, 3], axis=0), axis=1)
    assert 1.5 < steps.sum() < 2.2 and steps.max() < 0.04
    np.testing.assert_allclose(
        poses[:, :3, :3] @ poses[:, :3, :3].transpose(0, 2, 1), np.tile(np.eye(3), (90, 1, 1)), atol=1e-9
    )
    np.testing.assert_allclose(np.linalg.det(poses[:, :3, :3]), 1)
    turn = np.einsum("nji,njk->nik", poses[:-1, :3, :3], poses[1:, :3, :3])
    angle = np.degrees(np.arccos((np.trace(turn, axis1=1, axis2=2).clip(max=3) - 1) / 2))
    assert angle.max() < 1.5 and angle.sum() > 10


def test_the_same_seed_gives_the_same_pixels(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(synthetic, "Room", Room)  # a new one every time
    third = next(v for v in synthetic_frames(3, 160, 120, 3, every=2) if v.frame.index == 2)
    np.testing.assert_array_equal(third.frame.image, [*synthetic_frames(3, 160, 120, 3)][2].frame.image)
    first, again, other = (next(synthetic_frames(1, 160, 120, seed)) for seed in (3, 3, 4))
    np.testing.assert_array_equal(first.frame.image, again.frame.image)
    assert (first.frame.image != other.frame.image).mean() > 0.5
    assert not frame_is_blank(first.frame.image)


def test_the_written_clip_is_a_whole_tum_folder(tmp_path: Path) -> None:
    make_room_clip(tmp_path / "room", frames=4, width=160, height=120, seed=1)
    source = open_source(tmp_path / "room", SourceConfig(), want_depth=True)
    truth = source.truth()
    assert (source.kind, source.size, source.length) == ("tum", (160, 120), 4)
    assert truth is not None and truth.focal_px == 150
    for f, v in zip(source.frames(), synthetic_frames(4, 160, 120, 1), strict=True):
        np.testing.assert_array_equal(f.image, v.frame.image)
        np.testing.assert_allclose(f.depth_m, v.depth_m, atol=1.01e-4)
        np.testing.assert_allclose(truth.world_from_cam[f.index], v.world_from_cam, atol=1e-6)
        assert f.timestamp_s == pytest.approx(v.frame.timestamp_s, abs=1e-6)
        with Image.open(truth.moving_files[f.timestamp_s]) as mask:
            np.testing.assert_array_equal(np.asarray(mask) > 127, v.moving)


def test_a_clip_that_cannot_be_written(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("in the way")
    with pytest.raises(OutputError, match="expected to write the demo's clip"):
        make_room_clip(tmp_path / "file" / "room", frames=1, width=64, height=48)
