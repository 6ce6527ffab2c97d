"""A video that goes on in a saved map: its frame, its lens, its lengths; or that it was not found there."""

from __future__ import annotations

import json
from dataclasses import fields, replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

import mastd3r
from exact_room import HEIGHT, LENS, QUERY, WIDTH, exact_run, photographs, room_views
from helpers import blobs
from made_runs import made_run
from mastd3r.camera.pinhole import Camera
from mastd3r.cli.main import main
from mastd3r.config import CameraConfig, Config, MappingConfig
from mastd3r.errors import ConfigError, InputError
from mastd3r.export.map_folder import read_map
from mastd3r.geometry.se3 import inverse, so3_log, transform
from mastd3r.mapping.carried import with_unseen
from mastd3r.mapping.gaussian_arrays import GaussianArrays
from mastd3r.offline.map_drawing import drawn
from mastd3r.pipeline import resume
from mastd3r.pointmap.geometric import GeometricPointmaps
from mastd3r.tracking.localisation import Place
from mastd3r.types import View

Array = NDArray[Any]
NO_SPLAT = Config(mapping=MappingConfig(enabled=False))
FPS, FRAMES = 8.0, 22  # of the second video: it looks at what the map has seen, and on


@pytest.fixture(scope="module")
def saved(tmp_path_factory: pytest.TempPathFactory) -> mastd3r.SavedMap:
    """A map in which everything is exact, in the true world."""
    root = tmp_path_factory.mktemp("map")
    return mastd3r.save_map(exact_run(root, room_views()), root / "map")


@pytest.fixture(scope="module")
def views() -> Any:
    return room_views(FRAMES, FPS)


@pytest.fixture(scope="module")
def video(views: Any, tmp_path_factory: pytest.TempPathFactory) -> Path:
    return photographs(tmp_path_factory.mktemp("video") / "photos", views)


@pytest.fixture(scope="module")
def run(saved: mastd3r.SavedMap, video: Path, tmp_path_factory: pytest.TempPathFactory) -> mastd3r.Reconstruction:
    return mastd3r.reconstruct(video, tmp_path_factory.mktemp("run") / "run", NO_SPLAT, map=saved)


def off(found: Array, true: Array) -> tuple[float, float]:
    """Metres and degrees."""
    between = inverse(true) @ found
    return float(np.linalg.norm(between[:3, 3])), float(np.degrees(np.linalg.norm(so3_log(between[:3, :3]))))


def test_it_is_in_the_frame_the_lens_and_the_lengths_of_the_map(
    run: mastd3r.Reconstruction, saved: mastd3r.SavedMap, views: Any
) -> None:
    away = np.array([off(pose, v.world_from_cam) for pose, v in zip(run.poses, views, strict=True)])
    assert away[:, 0].max() < 0.03 and away[:, 1].max() < 0.4  # also where the map has never looked
    np.testing.assert_allclose(run.camera.fx_px, LENS.fx_px, rtol=1e-9)
    assert set(run.states) <= {"started", "tracked"}
    said = run.continues
    assert said["found"] and said["placed"] == FRAMES and said["first_frame"] == 0 and said["keyframes"] == 4
    assert said["map"] == str(saved.path) and f"{FRAMES} of {FRAMES} images placed" in said["said"]
    record = json.loads((run.path / "run.json").read_text())
    assert record["source"]["map"] == str(saved.path) and record["camera"]["found"] == "given"
    assert record["graph"]["keyframes"] == run.metrics["keyframes"] == run.is_keyframe.sum() >= 1


def test_the_cloud_holds_the_points_of_both(run: mastd3r.Reconstruction, saved: mastd3r.SavedMap) -> None:
    known = np.concatenate([_points(kf, saved.eye.camera)[kf.depth_info > 0] for kf in saved.record.keyframes])
    points, colors = run.cloud.points_world, run.cloud.colors
    nearest = np.array([np.linalg.norm(known - p, axis=1).min() for p in points])
    assert (nearest < 0.02).sum() > 0.3 * len(known) and (nearest > 0.05).sum() > 20
    assert (np.ptp(colors.astype(int), axis=1) > 10).mean() > 0.5  # in colour


def _points(kf: Any, camera: Camera) -> Array:
    return np.asarray(transform(kf.world_from_cam, camera.unproject(kf.px, kf.inv_depth)))


def test_a_map_saved_of_it_holds_the_keyframes_of_both(
    run: mastd3r.Reconstruction, saved: mastd3r.SavedMap, views: Any, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    both = mastd3r.save_map(run, tmp_path / "both")
    old = len(saved.poses)
    assert len(both.poses) == old + run.is_keyframe.sum()
    np.testing.assert_allclose(both.poses[:old], saved.poses, atol=1e-12)
    for mine, theirs in zip(both.record.keyframes, saved.record.keyframes, strict=False):
        np.testing.assert_array_equal(mine.inv_depth, theirs.inv_depth)
        np.testing.assert_array_equal(mine.descriptors, theirs.descriptors)
    place = both.localise(views[-1].frame.image)
    assert isinstance(place, Place) and off(place.world_from_cam, views[-1].world_from_cam)[0] < 0.04
    assert main(["save", str(run.path), "--map", str(saved.path)]) == 2
    assert "without what is read" in capfd.readouterr().err


def test_it_needs_the_map_that_it_went_on_in(run: mastd3r.Reconstruction, tmp_path: Path) -> None:
    record = json.loads((run.path / "run.json").read_text())
    elsewhere = mastd3r.load(run.path).save(tmp_path / "copy")
    for change, said in (({"map": str(tmp_path / "gone")}, "no such folder"), ({"digest": "0"}, "got another one")):
        changed = record | {"continues": record["continues"] | change}
        (elsewhere / "run.json").write_text(json.dumps(changed))
        with pytest.raises(InputError, match=said):
            mastd3r.save_map(elsewhere, tmp_path / "map")


def test_stopped_it_goes_on_to_the_same_trajectory(
    run: mastd3r.Reconstruction,
    saved: mastd3r.SavedMap,
    video: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    from mastd3r.offline import checkpoints
    from mastd3r.offline.job import RunJob

    monkeypatch.setattr(checkpoints, "EVERY_S", 0.0)
    monkeypatch.setattr(checkpoints, "MOST_OF_TIME", 1.0)
    after = RunJob.after

    def stopped(job: RunJob, frame: Any) -> None:
        if job.frames == 15:
            raise KeyboardInterrupt
        after(job, frame)

    with monkeypatch.context() as patch:
        patch.setattr(RunJob, "after", stopped)
        with pytest.raises(KeyboardInterrupt):
            mastd3r.reconstruct(video, tmp_path / "run", NO_SPLAT, map=saved)
    left = mastd3r.load(tmp_path / "run")
    assert not left.is_complete and left.continues["found"] and len(left.poses) == 16
    done = resume(tmp_path / "run")
    assert any("resumed from the checkpoint at frame" in note for note in done.notes)
    np.testing.assert_array_equal(done.poses, run.poses)
    assert done.continues == run.continues


def test_a_still_camera_is_placed_in_a_map(saved: mastd3r.SavedMap, views: Any) -> None:
    """Its depth is known there; by itself it would be refused."""
    slam = mastd3r.Slam(NO_SPLAT, (LENS.width, LENS.height), map=saved)
    for n in range(4):
        result = slam.track(views[3].frame.image, n / 10)
        assert result.submap == 0 and result.world_from_cam is not None
    still = slam.finish()
    assert still.continues["placed"] == 4 and not still.is_keyframe.any()
    assert all(off(pose, views[3].world_from_cam)[0] < 0.01 for pose in still.poses)


def test_a_video_of_another_place_is_complete_in_a_frame_of_its_own(
    saved: mastd3r.SavedMap, views: Any, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    """The room upside down and mirrored is a place of its own."""
    other = [replace(v, frame=replace(v.frame, image=np.ascontiguousarray(v.frame.image[::-1]))) for v in views[:14]]
    photos = photographs(tmp_path / "photos", other)
    words = ["run", str(photos), "--map", str(saved.path), "--out", str(tmp_path / "run"), "--no-map", "--quiet"]
    assert main(words) == 0, capfd.readouterr().err
    assert capfd.readouterr().out.startswith("not found in the map map")
    run = mastd3r.load(tmp_path / "run")
    assert run.continues["found"] is False and run.continues["placed"] == 0 and run.continues["first_frame"] is None
    assert run.is_complete and run.is_keyframe[0] and run.metrics["keyframes"] == run.is_keyframe.sum()
    own = mastd3r.save_map(run, tmp_path / "own")
    assert len(own.poses) == run.is_keyframe.sum()  # nothing of the map


def test_in_a_map_in_metres_the_run_is_in_metres(video: Path, tmp_path: Path) -> None:
    source = exact_run(tmp_path, room_views())
    assert main(["scale", str(source), "factor=2"]) == 0
    metric = mastd3r.save_map(source, tmp_path / "map")
    config = replace(NO_SPLAT, source=replace(NO_SPLAT.source, end=5))
    run = mastd3r.reconstruct(video, tmp_path / "second", config, map=tmp_path / "map")
    assert run.scale["applied"] and run.scale["metres_per_unit"] == 1 and "of the map" in run.scale["said"]
    for pose, v in zip(run.poses, room_views(5, FPS), strict=True):
        assert np.linalg.norm(pose[:3, 3] - 2 * v.world_from_cam[:3, 3]) < 0.03
    assert mastd3r.save_map(run, tmp_path / "both").unit == metric.unit == "m"


def test_a_video_of_another_lens_goes_on_in_it(saved: mastd3r.SavedMap, views: Any, tmp_path: Path) -> None:
    """A longer focal length over a part of the picture, in larger pixels, and of another shape."""
    given = (2 * LENS.fx_px, 2 * LENS.fy_px, 2 * (LENS.cx_px - 20) + 0.5, 2 * (LENS.cy_px - 20) + 0.5)
    parts = [np.ascontiguousarray(v.frame.image[20:130, 20:180]) for v in views[:5]]
    large = [cv2.resize(part, (320, 220), interpolation=cv2.INTER_CUBIC) for part in parts]
    shown = [replace(v, frame=replace(v.frame, image=i)) for v, i in zip(views, large, strict=False)]
    config = replace(NO_SPLAT, camera=CameraConfig(intrinsics=given))
    run = mastd3r.reconstruct(photographs(tmp_path / "photos", shown), tmp_path / "run", config, map=saved)
    assert run.continues["placed"] == 5
    away = [off(pose, v.world_from_cam) for pose, v in zip(run.poses, views, strict=False)]
    assert np.max(away, axis=0)[0] < 0.06 and np.max(away, axis=0)[1] < 0.8
    both = mastd3r.save_map(run, tmp_path / "both")
    assert both.camera == run.camera and len(both.poses) >= len(saved.poses)
    assert isinstance(both.localise(views[QUERY].frame.image, intrinsics=(LENS.fx_px,)), Place)


def test_keyframes_as_another_camera_takes_them(saved: mastd3r.SavedMap) -> None:
    """Points stay where they are in the world; what it shows beyond the map moves; its own camera changes nothing."""
    own, provider = saved.eye.camera, GeometricPointmaps(240, 150, 10)
    assert drawn(saved.record, own, own, saved.eye.provider) is saved.record
    wider = Camera(120.0, 120.0, 119.5, 74.5, 240, 150)
    record = drawn(saved.record, own, wider, provider)
    assert record.size == (240, 150) and record.grid == (15, 24)
    for old, new in zip(saved.record.keyframes, record.keyframes, strict=True):
        known = new.depth_info > 0
        away = np.linalg.norm(_points(new, wider)[known, None] - _points(old, own)[None], axis=2).min(1)
        assert 50 < known.sum() < (old.depth_info > 0).sum() and away.max() < 1e-9
        assert (new.moving[:, :20] == 255).all() and new.moving[60:90, 100:140].max() < 255
        at = np.rint(new.px[known]).astype(int)
        there = np.rint(own.project(wider.rays(new.px[known]))).astype(int)
        gray = old.gray[np.clip(there[:, 1], 0, HEIGHT - 1), np.clip(there[:, 0], 0, WIDTH - 1)].astype(int)
        assert np.median(np.abs(new.gray[at[:, 1], at[:, 0]] - gray)) < 12


# -- the splat -------------------------------------------------------------------------------------------------------


def _splat(means: list[list[float]], sigma: float, color: float) -> GaussianArrays:
    n = len(means)
    turned = np.tile(np.array([1, 0, 0, 0], np.float32), (n, 1))
    values = (np.array(means), np.full((n, 3), sigma), turned, np.full(n, 0.99), np.full((n, 3), color), np.zeros(n))
    rows = [
        np.asarray(v, np.int32 if f.name == "kf_id" else np.float32)
        for f, v in zip(fields(GaussianArrays), values, strict=False)
    ]
    return GaussianArrays(*rows, np.zeros((n, 0, 3), np.float32))


def test_of_the_old_splat_stays_what_the_new_views_do_not_show() -> None:
    camera = Camera.centred(60.0, 80, 60)
    wall = _splat([[x, y, 4.0] for x in np.arange(-4, 4.1, 0.2) for y in np.arange(-3, 3.1, 0.2)], 0.15, 0.5)
    static = np.ones((60, 80), np.float16)
    static[:, 60:] = 0.0  # something moves there: the view has no say
    view = View(0.0, np.zeros((60, 80, 3), np.uint8), static, np.eye(4), camera, 0)
    old = {
        "beside the picture": ([6.0, 0, 4], True),
        "behind the camera": ([0.0, 0, -2], True),
        "at the wall": ([-1.0, 0.1, 4.05], False),
        "before it": ([-0.5, -0.5, 2.0], False),
        "behind it": ([0.0, 0.3, 6.0], True),
        "where something moves": ([1.9, 0, 4.0], True),
    }
    kept = with_unseen(wall, _splat([at for at, _ in old.values()], 0.05, 1.0), [view], 0.01)
    means = kept.means[len(wall.means) :].tolist()
    for name, (at, stays) in old.items():
        assert (np.float32(at).tolist() in means) == stays, name
    large = with_unseen(wall, _splat([[6.0, 0, 4]], 3.0, 1.0), [view], 0.01)
    assert len(large.means) == len(wall.means)  # beside the picture, and drawn in it


# -- what cannot be --------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def small(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A map of 160x120 that is quickly written."""
    root = tmp_path_factory.mktemp("small")
    mastd3r.save_map(made_run(root, Camera.centred(300.0, 160, 120)).path, root / "map")
    return root / "map"


BAD: dict[str, tuple[list[str], str]] = {
    "realtime": (["--realtime"], "--map: expected a splat that is made after tracking, got --realtime"),
    "scale": (["--scale", "factor=2"], "--map: expected no --scale"),
    "pointmaps": (["--pointmaps", "depth"], "--map: expected --pointmaps geometric"),
    "shape": ([], "expected images of the map's lens, 160x120 or of that shape, got 160x160"),
}


@pytest.mark.parametrize("name", BAD)
def test_what_a_map_cannot_serve_is_one_line(
    small: Path, tmp_path: Path, capfd: pytest.CaptureFixture[str], name: str
) -> None:
    words, said = BAD[name]
    (tmp_path / "photos").mkdir()
    for n, image in enumerate(blobs(3, 160, 160 if name == "shape" else 120)):
        cv2.imwrite(str(tmp_path / "photos" / f"{n}.png"), image)
    given = [
        "run",
        str(tmp_path / "photos"),
        "--map",
        str(small),
        "--out",
        str(tmp_path / "out"),
        "--quiet",
        "--no-map",
    ]
    if name == "realtime":
        given.remove("--no-map")
    code = main([*given, *words])
    err = capfd.readouterr().err.splitlines()
    assert code == 2 and len(err) == 1 and said in err[0], err
    assert not (tmp_path / "out").exists()


def test_a_run_writes_neither_into_a_map_nor_around_it(
    small: Path, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    photos = small.parent / "photos"
    before = {p: p.read_bytes() for p in small.rglob("*") if p.is_file()}
    for out in (small, small / "run", small.parent):
        assert main(["run", str(photos), "--map", str(small), "--out", str(out), "--no-map", "--quiet"]) == 2
        err = capfd.readouterr().err.splitlines()
        assert len(err) == 1 and "what is read" in err[0]
    assert {p: p.read_bytes() for p in small.rglob("*") if p.is_file()} == before


def test_no_map_and_no_live_run_in_one(small: Path, saved: mastd3r.SavedMap, tmp_path: Path) -> None:
    with pytest.raises(InputError, match="expected a saved map"):
        mastd3r.reconstruct(small.parent / "photos", tmp_path / "run", NO_SPLAT, map=tmp_path / "nothing")
    with pytest.raises(ConfigError, match="live: expected no map"):
        mastd3r.Slam(NO_SPLAT, (200, 150), live=True, map=saved)
    older = read_map(small)
    assert all(len(kf.color) == len(kf.px) for kf in older.keyframes)
