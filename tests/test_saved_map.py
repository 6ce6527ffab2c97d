"""Saved maps: what is kept of a run, images found where they were taken, others refused, bad maps said in a line."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

import mastd3r
from exact_room import HEIGHT, KEYFRAMES, LENS, QUERY, WIDTH, exact_run, room_views
from helpers import blobs
from made_runs import made_run
from mastd3r.camera.opencv_lens import OpenCvLens
from mastd3r.camera.pinhole import Camera
from mastd3r.cli.main import main
from mastd3r.errors import ConfigError, InputError
from mastd3r.geometry.se3 import inverse, so3_log, transform
from mastd3r.mapping.gaussian_arrays import GaussianArrays
from mastd3r.mapping.ply import write_gaussians_ply
from mastd3r.sources import synthetic
from mastd3r.tracking.localisation import Place, Unplaced
from mastd3r.types import State

Array = NDArray[Any]


@pytest.fixture(scope="module")
def views() -> list[synthetic.SyntheticView]:
    return room_views()


@pytest.fixture(scope="module")
def run(views: list[synthetic.SyntheticView], tmp_path_factory: pytest.TempPathFactory) -> Path:
    return exact_run(tmp_path_factory.mktemp("room"), views)


@pytest.fixture(scope="module")
def saved(run: Path, tmp_path_factory: pytest.TempPathFactory) -> mastd3r.SavedMap:
    return mastd3r.save_map(run, tmp_path_factory.mktemp("map") / "map")


def off(place: Place, true: Array) -> tuple[float, float]:
    """Metres and degrees."""
    between = inverse(true) @ place.world_from_cam
    return float(np.linalg.norm(between[:3, 3])), float(np.degrees(np.linalg.norm(so3_log(between[:3, :3]))))


def test_a_map_holds_the_keyframes_and_their_points(saved: mastd3r.SavedMap, views: Any) -> None:
    assert np.allclose(saved.poses, [views[k].world_from_cam for k in KEYFRAMES], atol=1e-6)
    assert saved.camera == LENS and saved.gaussians is None
    graph = saved.localiser.graph
    for n, k in enumerate(KEYFRAMES):
        v = graph.variables[n]
        known = graph.depth_info(n) > 0
        at = np.rint(v.px[known]).astype(int)
        assert known.mean() > 0.8
        assert np.median(np.abs(v.inv_depth[known] * views[k].depth_m[at[:, 1], at[:, 0]] - 1)) < 0.005
        assert not graph.keyframes[n].static[~known].any()


def test_information_of_depths_is_what_the_other_keyframes_measure(saved: mastd3r.SavedMap) -> None:
    """A point's information: a pixel's noise in each other keyframe along the way its projection takes."""
    graph, n, m = saved.localiser.graph, 0, 3
    v, info = graph.variables[n], graph.depth_info(n)
    row = int(np.argmax(info))
    total = 0.0
    for other in range(1, m + 1):
        between = graph.variables[other].cam_from_world @ inverse(v.cam_from_world)
        ends = [transform(between, LENS.rays(v.px[row]) / (v.inv_depth[row] + s)) for s in (-1e-5, 1e-5)]
        total += float((((LENS.project(ends[1]) - LENS.project(ends[0])) / 2e-5) ** 2).sum())
    assert info[row] == pytest.approx(total, rel=0.02)


def test_a_map_is_in_metres_where_the_run_knows_them(
    run: Path, saved: mastd3r.SavedMap, views: Any, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Poses, depths and splat, measured after the run by ``mastd3r scale``; and so is what is found in it."""
    measured = shutil.copytree(run, tmp_path / "run")
    none = np.zeros((1, 0, 3), np.float32)
    one = np.ones(1, np.float32)
    means, turned = np.array([[1, 2, 3]], np.float32), np.array([[1, 0, 0, 0]], np.float32)
    splat = GaussianArrays(means, 0.1 * means, turned, 0.5 * one, 0.1 * means, np.zeros(1, np.int32), none)
    write_gaussians_ply(measured / "gaussians.ply", splat)
    assert main(["scale", str(measured), "factor=2"]) == 0
    metric = mastd3r.save_map(measured, tmp_path / "map")
    assert (saved.unit, metric.unit) == ("map units", "m")
    np.testing.assert_allclose(metric.poses[:, :3, 3], 2 * saved.poses[:, :3, 3], atol=1e-6)
    for n in range(len(KEYFRAMES)):
        mine, theirs = (m.localiser.graph.variables[n].inv_depth for m in (metric, saved))
        np.testing.assert_allclose(mine, theirs / 2, rtol=1e-5)
    assert metric.gaussians is not None
    np.testing.assert_allclose(metric.gaussians.means, 2 * means)
    np.testing.assert_allclose(metric.gaussians.scales, 0.2 * means, rtol=1e-5)
    found = metric.localise(views[QUERY].frame.image)
    assert isinstance(found, Place)
    assert np.linalg.norm(found.world_from_cam[:3, 3] - 2 * views[QUERY].world_from_cam[:3, 3]) < 0.04
    image = tmp_path / "2.png"
    cv2.imwrite(str(image), views[QUERY].frame.image[..., ::-1])
    assert main(["localise", str(tmp_path / "map"), str(image), "--out", str(tmp_path / "found")]) == 0
    said = json.loads((tmp_path / "found" / "localised.json").read_text())
    assert said["unit"] == "m" and " m and " in capsys.readouterr().out.replace("\n", " ")


def test_an_image_is_found_where_it_was_taken(saved: mastd3r.SavedMap, views: Any) -> None:
    place = saved.localise(views[QUERY].frame.image)
    assert isinstance(place, Place) and len(place.keyframes) >= 2
    metres, degrees = off(place, views[QUERY].world_from_cam)
    assert metres < 0.02 and degrees < 0.3
    assert metres < 3 * place.position_sigma and degrees < 3 * place.rotation_sigma_deg
    assert place.position_sigma < 0.1
    again = saved.localise(views[QUERY].frame.image, near=place)
    assert isinstance(again, Place) and off(again, views[QUERY].world_from_cam)[0] < 0.02


def test_an_image_of_another_lens_is_found_too(saved: mastd3r.SavedMap, views: Any) -> None:
    """A longer focal length over a part of the picture, in larger pixels."""
    part = np.ascontiguousarray(views[QUERY].frame.image[10:130, 20:180])
    large = cv2.resize(part, (320, 240), interpolation=cv2.INTER_CUBIC)
    given = (2 * LENS.fx_px, 2 * LENS.fy_px, 2 * (LENS.cx_px - 20) + 0.5, 2 * (LENS.cy_px - 10) + 0.5)
    place = saved.localise(large, intrinsics=given)
    assert isinstance(place, Place)
    metres, degrees = off(place, views[QUERY].world_from_cam)
    assert metres < 0.04 and degrees < 0.6
    wrong = saved.localise(large)  # as if it were the map's lens
    assert not isinstance(wrong, Place) or off(wrong, views[QUERY].world_from_cam)[0] > 0.1


@pytest.mark.parametrize("kind", ["blank", "elsewhere"])
def test_images_of_other_places_are_refused(saved: mastd3r.SavedMap, kind: str) -> None:
    image = {
        "blank": np.full((HEIGHT, WIDTH, 3), 90, np.uint8),
        "elsewhere": blobs(1, WIDTH, HEIGHT)[0],
    }[kind]
    found = saved.localise(image)
    assert isinstance(found, Unplaced) and found.reason


def test_the_commands_write_poses_and_say_what_was_not_found(
    run: Path, views: Any, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    photos = tmp_path / "photos"
    photos.mkdir()
    cv2.imwrite(str(photos / "a.png"), views[QUERY].frame.image[..., ::-1])
    cv2.imwrite(str(photos / "b.png"), blobs(1, WIDTH, HEIGHT)[0])
    assert main(["save", str(run), "--map", str(tmp_path / "map")]) == 0
    words = ["localise", str(tmp_path / "map"), str(photos), "--out", str(tmp_path / "out"), "--quiet"]
    assert main(words) == 0, capfd.readouterr().err
    said = capfd.readouterr().out
    assert "a.png: found at" in said and "b.png: not found" in said and "found 1 of 2" in said
    record = json.loads((tmp_path / "out" / "localised.json").read_text())
    assert [i["state"] for i in record["images"]] == ["found", "not found"]
    row = np.loadtxt(tmp_path / "out" / "poses.txt")
    assert np.allclose(row[1:4], np.array(record["images"][0]["world_from_cam"])[:3, 3], atol=1e-6)
    assert np.linalg.norm(row[1:4] - views[QUERY].world_from_cam[:3, 3]) < 0.02


def test_a_lens_of_more_than_radial_terms_is_rectified(tmp_path: Path) -> None:
    """Points of the photograph stand where the pinhole shows them."""
    lens = OpenCvLens(300.0, 310.0, 158.0, 121.0, 320, 240, (-0.1, 0.02, 0.002, -0.003))
    made = made_run(tmp_path, lens, points=400, noise_px=0.0)
    saved = mastd3r.save_map(made.path, tmp_path / "map")
    assert saved.camera == lens
    graph = saved.localiser.graph
    for n, pose in enumerate(made.trajectory.keyframes().world_from_cam):
        known = graph.depth_info(n) > 0
        world = transform(pose, graph.camera().unproject(graph.variables[n].px, graph.variables[n].inv_depth))[known]
        away = np.linalg.norm(world[:, None] - made.tracks.points_world[None], axis=2).min(1)
        assert known.sum() > 80 and away.max() < 0.02


def test_features_without_descriptions_guessed_poses_and_images_of_another_shape(tmp_path: Path) -> None:
    states: tuple[State, ...] = ("started", "tracked", "interpolated", "tracked", "tracked")
    made = made_run(tmp_path, Camera.centred(300.0, 160, 120), states)
    (made.path / "config.yaml").write_text("features: orb\n")
    saved = mastd3r.save_map(made.path, tmp_path / "map")
    assert json.loads((tmp_path / "map" / "map.json").read_text())["features"] == ""
    assert np.allclose(saved.timestamps_s, made.trajectory.timestamps_s[[0, 4]])  # of keyframes 0, 2 and 4
    assert isinstance(saved.localise(blobs(6, 160, 120)[5]), Unplaced)
    with pytest.raises(InputError, match="of the map's lens, 160x120 or of that shape, got 160x160"):
        saved.localise(blobs(1, 160, 160)[0])
    with pytest.raises(ConfigError, match="--intrinsics"):
        saved.localise(blobs(1, 160, 160)[0], intrinsics=(-3.0,))


# -- files that are not what they should be --------------------------------------------------------------------------


@pytest.fixture(scope="module")
def small(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A map that is quickly written."""
    root = tmp_path_factory.mktemp("small")
    made = made_run(root, Camera.centred(300.0, 160, 120), points=60)
    mastd3r.save_map(made.path, root / "map")
    return root / "map"


def _edit(**fields: Any) -> Callable[[Path], None]:
    def change(folder: Path) -> None:
        record = json.loads((folder / "map.json").read_text()) | fields
        (folder / "map.json").write_text(json.dumps(record))

    return change


def _arrays(**fields: Callable[[Array], Array]) -> Callable[[Path], None]:
    def change(folder: Path) -> None:
        path = folder / "keyframes" / "000001.npz"
        arrays = dict(np.load(path))
        np.savez(path, **(arrays | {name: make(arrays[name]) for name, make in fields.items()}))

    return change


def _cut(folder: Path) -> None:
    path = folder / "keyframes" / "000000.npz"
    path.write_bytes(path.read_bytes()[:1000])


BAD: dict[str, tuple[Callable[[Path], None], str]] = {
    "version": (_edit(version=2), "expected version 1 of a saved map, got 2"),
    "not ours": (_edit(made_by="another"), "expected a map of mastd3r save, got one of 'another'"),
    "size": (_edit(size=[160]), "size: expected two whole numbers"),
    "unit": (_edit(unit="feet"), "unit: expected m or map units, got 'feet'"),
    "no keyframes": (_edit(keyframes=[]), "keyframes: expected a list of 1 to"),
    "pose": (_edit(keyframes=[{"timestamp_s": 0, "world_from_cam": [[2] * 4] * 4}]), "expected a rotation"),
    "gone": (lambda f: (f / "keyframes" / "000002.npz").unlink(), "000002.npz: expected a keyframe of a saved map"),
    "cut": (_cut, "000000.npz: expected a keyframe of a saved map"),
    "shape": (_arrays(inv_depth=lambda a: a[:-1]), "inv_depth: expected shape"),
    "type": (_arrays(px=lambda a: a.astype(np.float32)), "px of type <f4, not <f8"),
    "not finite": (_arrays(px=lambda a: a * np.nan), "expected finite numbers"),
    "behind": (_arrays(inv_depth=lambda a: -a), "expected points before the camera"),
    "another lens": (lambda f: (f / "camera.json").write_text("{}"), "camera.json"),
    "no map": (lambda f: (f / "map.json").unlink(), "expected a saved map (mastd3r save), got a folder without map"),
}


@pytest.mark.parametrize("name", BAD)
def test_a_damaged_map_is_one_line(small: Path, tmp_path: Path, capfd: pytest.CaptureFixture[str], name: str) -> None:
    damage, said = BAD[name]
    damage(shutil.copytree(small, tmp_path / "map"))
    code = main(["localise", str(tmp_path / "map"), str(tmp_path), "--out", str(tmp_path / "out")])
    err = capfd.readouterr().err.splitlines()
    assert code == 2 and len(err) == 1 and said in err[0], err
    assert not (tmp_path / "out").exists()


def test_nothing_of_the_users_is_overwritten(small: Path, tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    run = small.parent / "run"
    for name in ("notes.txt", "export.json"):
        target = tmp_path / name.partition(".")[0]
        target.mkdir()
        (target / name).write_text("{}")
        assert main(["save", str(run), "--map", str(target)]) == 2
        assert [p.name for p in target.iterdir()] == [name]
    assert main(["save", str(run), "--map", str(run / "map")]) == 2  # within what is read
    assert main(["export", str(run), "--to", "colmap", "--out", str(small)]) == 2  # an export is no map
    assert "mastd3r save" in (small / "map.json").read_text()
    capfd.readouterr()
    assert main(["localise", str(run), str(run), "--out", str(tmp_path / "o")]) == 2
    assert "got a run folder; mastd3r save" in capfd.readouterr().err


def test_a_run_without_points_is_no_map(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    made = made_run(tmp_path, Camera.centred(300.0, 160, 120), tracked=False)
    assert main(["save", str(made.path), "--map", str(tmp_path / "map")]) == 2
    assert "tracks.npz: expected the tracks of a run, got no such file" in capfd.readouterr().err
    assert not (tmp_path / "map").exists()
