"""Image folders and TUM-layout folders, good and bad."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from helpers import blobs, data_path
from mastd3r.config import SourceConfig
from mastd3r.errors import ConfigError, InputError
from mastd3r.sources import frame_is_blank, open_source
from mastd3r.sources.image_folder import natural_key
from mastd3r.sources.semantic_maps import nearest_time

ALL = SourceConfig()
ORIENTATION = 0x0112


def image_folder(folder: Path, count: int = 12) -> tuple[Path, list[np.ndarray]]:
    folder.mkdir()
    images = blobs(count)
    for i, image in enumerate(images):
        Image.fromarray(image).save(folder / f"img{i}.png")
    return folder, images


def tum_folder(folder: Path, count: int = 5, step_s: float = 0.1) -> tuple[Path, list[np.ndarray]]:
    (folder / "rgb").mkdir(parents=True)
    (folder / "depth").mkdir()
    images = blobs(count)
    rgb, depth, poses = ["# timestamp filename"], [], []
    for i, image in enumerate(images):
        t = 100 + step_s * i
        Image.fromarray(image).save(folder / "rgb" / f"{i}.png")
        Image.fromarray(np.full((48, 64), 1000 * (i + 1), np.uint16)).save(folder / "depth" / f"{i}.png")
        rgb.append(f"{t:.6f} rgb/{i}.png")
        depth.append(f"{t + 0.015:.6f} depth/{i}.png")
        poses.append(f"{t:.6f} {i} 0 0 0 0 0.70710678 0.70710678")
    (folder / "rgb.txt").write_text("\n".join(rgb) + "\n")
    (folder / "depth.txt").write_text("\n".join(depth) + "\n")
    (folder / "groundtruth.txt").write_text("\n".join(poses) + "\n")
    return folder, images


def test_images_come_in_natural_order(tmp_path: Path) -> None:
    folder, images = image_folder(tmp_path / "shots")
    (folder / "notes.txt").write_text("not an image")
    (folder / "._img3.png").write_bytes(b"left by another system")
    source = open_source(str(folder), ALL)
    assert (source.kind, source.name, source.size, source.length) == ("images", "shots", (64, 48), 12)
    for f, image in zip(source.frames(), images, strict=True):
        np.testing.assert_array_equal(f.image, image)
        assert f.timestamp_s == f.index / 30
    assert any("30 frames a second" in n for n in source.notes)
    part = open_source(folder, SourceConfig(start=2, end=100, stride=4))
    assert [f.index for f in part.frames()] == [2, 6, 10] and part.length == 3


def test_natural_key() -> None:
    names = ["B2.jpg", "a10.jpg", "a9.jpg", "a09b.jpg", "b1.jpg", "10.png", "9.png"]
    expected = ["9.png", "10.png", "a9.jpg", "a09b.jpg", "a10.jpg", "b1.jpg", "B2.jpg"]
    assert sorted(names, key=natural_key) == expected


def test_exif_orientation(tmp_path: Path) -> None:
    image = blobs(1)[0]
    exif = Image.Exif()
    exif[ORIENTATION] = 6  # turn clockwise by a quarter to show
    for name in ("a.png", "b.WEBP"):
        Image.fromarray(image).save(tmp_path / name, exif=exif, lossless=True)
    source = open_source(tmp_path, ALL)
    frames = list(source.frames())
    assert source.size == (48, 64) and len(frames) == 2
    for f in frames:
        np.testing.assert_array_equal(f.image, np.rot90(image, -1))


def test_image_modes_become_rgb(tmp_path: Path) -> None:
    grey = blobs(1)[0][..., 0]
    Image.fromarray(grey).save(tmp_path / "0.png")
    Image.fromarray(grey.astype(np.uint16) * 257).save(tmp_path / "1.png")
    Image.fromarray(np.dstack([grey, grey, grey, np.full_like(grey, 9)])).save(tmp_path / "2.png")
    Image.fromarray(grey).convert("LA").save(tmp_path / "3.png")
    Image.fromarray(grey).convert("P").save(tmp_path / "4.png")
    frames = list(open_source(tmp_path, ALL).frames())
    assert len(frames) == 5
    for f in frames:
        np.testing.assert_array_equal(f.image, np.dstack([grey] * 3))


def test_one_image_is_given(tmp_path: Path) -> None:
    folder, _ = image_folder(tmp_path / "one", count=1)
    assert len(list(open_source(folder, ALL).frames())) == 1


@pytest.mark.parametrize("path", ["nowhere", "nowhere.mp4"])
def test_a_missing_path(tmp_path: Path, path: str) -> None:
    with pytest.raises(InputError, match=f"{path}: expected .* got no such path"):
        open_source(tmp_path / path, ALL)


def test_folders_without_images(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="empty folder"):
        open_source(tmp_path, ALL)
    image_folder(tmp_path / "rgb")
    with pytest.raises(InputError, match="its folder rgb has images"):
        open_source(tmp_path, ALL)


def test_a_single_image_is_no_video(tmp_path: Path) -> None:
    folder, _ = image_folder(tmp_path / "shots")
    with pytest.raises(InputError, match="got a single image"):
        open_source(folder / "img0.png", ALL)


def test_the_kind_is_found_by_looking(tmp_path: Path) -> None:
    folder, _ = image_folder(tmp_path / "tum_dataset.mp4")
    assert open_source(folder, ALL).kind == "images"
    folder, _ = tum_folder(tmp_path / "video")
    assert open_source(folder, ALL).kind == "tum"


@pytest.mark.parametrize("kind", ["images", "tum"])
@pytest.mark.parametrize("damage", ["cut", "text", "empty"])
def test_an_unreadable_frame_in_the_middle(tmp_path: Path, kind: str, damage: str) -> None:
    make = image_folder if kind == "images" else tum_folder
    folder, _ = make(tmp_path / "shots", count=5)
    bad = folder / ("img3.png" if kind == "images" else "rgb/3.png")
    data = bad.read_bytes()
    bad.write_bytes({"cut": data[: len(data) // 2], "text": b"not an image", "empty": b""}[damage])
    source = open_source(folder, ALL)
    whole, _ = make(tmp_path / "whole", count=5)
    before = {f.index: f.timestamp_s for f in open_source(whole, ALL).frames()}
    for _ in range(2):
        frames = {f.index: f.timestamp_s for f in source.frames()}
        assert list(frames) == [0, 1, 2, 4] and source.length == 4
        assert all(frames[i] == before[i] for i in frames)
        told = f"images that cannot be read are left out: 1 of 5, the first is {bad.name}"
        assert [n for n in source.notes if "cannot be read" in n] == [told]


@pytest.mark.parametrize("kind", ["images", "tum"])
def test_a_first_frame_that_is_broken_and_all_that_are(tmp_path: Path, kind: str) -> None:
    make = image_folder if kind == "images" else tum_folder
    folder, _ = make(tmp_path / "shots", count=3)
    files = [folder / (f"img{i}.png" if kind == "images" else f"rgb/{i}.png") for i in range(3)]
    files[0].write_bytes(files[0].read_bytes()[:100])
    source = open_source(folder, ALL)
    assert source.size == (64, 48) and [f.index for f in source.frames()] == [1, 2]
    for path in files[1:]:
        path.write_bytes(b"not an image")
    with pytest.raises(InputError, match=rf"{files[0].name}: expected a readable image, .* none of the 3 images"):
        open_source(folder, ALL)


def test_a_broken_depth_file_leaves_its_frame_without(tmp_path: Path) -> None:
    folder, _ = tum_folder(tmp_path / "seq")
    bad = folder / "depth" / "2.png"
    bad.write_bytes(bad.read_bytes()[:60])
    source = open_source(folder, ALL, want_depth=True)
    assert [f.depth_m is not None for f in source.frames()] == [True, True, False, True, True]
    assert "depth files that cannot be read are taken as none: 1, the first is 2.png" in source.notes


@pytest.mark.parametrize("kind", ["images", "tum"])
def test_frames_of_different_sizes(tmp_path: Path, kind: str) -> None:
    make = image_folder if kind == "images" else tum_folder
    folder, _ = make(tmp_path / "shots", count=4)
    first, bad = ("img0.png", "img2.png") if kind == "images" else ("rgb/0.png", "rgb/2.png")
    Image.fromarray(blobs(1, width=32, height=20)[0]).save(folder / bad)
    given = 0
    with pytest.raises(InputError, match=rf"{bad}: expected 64x48 pixels as in .*{first}, got 32x20"):
        for _ in open_source(folder, ALL).frames():
            given += 1
    assert given == 2


def test_tum_depth_truth_and_association(tmp_path: Path) -> None:
    folder, images = tum_folder(tmp_path / "seq")
    (folder / "info.json").write_text(json.dumps({"fx": 500.5, "depth_scale": 2000}))
    source = open_source(folder, SourceConfig(start=1, stride=2), want_depth=True)
    frames = list(source.frames())
    assert source.kind == "tum" and source.has_depth and not source.has_semantic
    assert [f.index for f in frames] == [1, 3]
    for f in frames:
        np.testing.assert_array_equal(f.image, images[f.index])
        assert f.timestamp_s == pytest.approx(100 + 0.1 * f.index)
        assert f.depth_m is not None and f.depth_m.dtype == np.float32 and f.depth_m.shape == (48, 64)
        np.testing.assert_allclose(f.depth_m, 1000 * (f.index + 1) / 2000)
    truth = source.truth()
    assert truth is not None and truth.focal_px == 500.5 and truth.moving_files == {}
    np.testing.assert_allclose(truth.world_from_cam[3] @ [1, 0, 0, 1], [3, 1, 0, 1], atol=1e-6)
    assert all(f.depth_m is None for f in open_source(folder, ALL).frames())


def test_tum_depth_scale_is_assumed_aloud(tmp_path: Path) -> None:
    folder, _ = tum_folder(tmp_path / "seq")
    source = open_source(folder, ALL, want_depth=True)
    first = next(source.frames())
    assert first.depth_m is not None and first.depth_m[0, 0] == pytest.approx(0.2)
    assert any("5000" in n for n in source.notes)


def test_depth_beyond_20_ms_belongs_to_nobody(tmp_path: Path) -> None:
    folder, _ = tum_folder(tmp_path / "seq")
    (folder / "depth.txt").write_text("100.021 depth/0.png\n100.119 depth/1.png\n")
    depth = [f.depth_m is not None for f in open_source(folder, ALL, want_depth=True).frames()]
    assert depth == [False, True, False, False, False]


def test_depth_that_is_not_finite_is_none_and_counted(tmp_path: Path) -> None:
    folder, _ = tum_folder(tmp_path / "seq", count=2)
    depth = np.full((48, 64), 1.5)
    depth[0, :3], depth[1, 0], depth[2, 0] = np.nan, np.inf, -1
    np.save(folder / "depth" / "0.npy", depth)
    Image.fromarray(depth.astype(np.float32)).save(folder / "depth" / "1.tiff")
    (folder / "depth.txt").write_text("100.0 depth/0.npy\n100.1 depth/1.tiff\n")
    source = open_source(folder, ALL, want_depth=True)
    for _ in range(2):
        for f in source.frames():
            assert f.depth_m is not None and np.isfinite(f.depth_m).all()
            assert np.count_nonzero(f.depth_m == 0) == 5 and f.depth_m.max() == 1.5
        assert [n for n in source.notes if "not finite" in n] == [
            "depth: 8 values that are not finite are taken as none"
        ]


def test_depth_of_another_size(tmp_path: Path) -> None:
    folder, _ = tum_folder(tmp_path / "seq")
    Image.fromarray(np.ones((24, 32), np.uint16)).save(folder / "depth" / "1.png")
    with pytest.raises(InputError, match=r"depth/1\.png: expected 64x48 .* got 32x24"):
        list(open_source(folder, ALL, want_depth=True).frames())


@pytest.mark.parametrize(
    ("name", "text", "message"),
    [
        ("rgb.txt", "1.0 rgb/0.png\n0.9 rgb/1.png\n", r"rgb\.txt line 2: expected a time after 1\.0"),
        ("rgb.txt", "# head\n1.0 rgb/0.png\n\n1.0 rgb/1.png\n", r"rgb\.txt line 4: expected a time after"),
        ("rgb.txt", "1.0 rgb/0.png\nsoon rgb/1.png\n", r"rgb\.txt line 2: expected 'timestamp_s filename'"),
        ("rgb.txt", "nan rgb/0.png\n", r"rgb\.txt line 1: expected"),
        ("rgb.txt", "1.0\n", r"rgb\.txt line 1: expected"),
        ("rgb.txt", "# nothing\n", r"rgb\.txt: expected lines"),
        ("rgb.txt", "1.0 rgb/0.png\n2.0 rgb/99.png\n", r"rgb\.txt line 2: .* got no rgb/99\.png"),
        ("depth.txt", "1.0\n", r"depth\.txt line 1: expected"),
        ("info.json", "{", r"info\.json: expected JSON"),
        ("info.json", '{"depth_scale": 0}', r"info\.json: expected depth_scale above 0, got 0"),
    ],
)
def test_bad_lists(tmp_path: Path, name: str, text: str, message: str) -> None:
    folder, _ = tum_folder(tmp_path / "seq")
    (folder / name).write_text(text)
    with pytest.raises(InputError, match=message):
        open_source(folder, ALL, want_depth=True)


@pytest.mark.parametrize(
    "row",
    [
        "1 0 0 0 0 0 0 0",
        "1 nan 0 0 0 0 0 1",
        "1 0 0 0 0 0 0",
        "1 0 0 x 0 0 0 1",
        "1 1e200 0 0 0 0 0 1",
        "0 5 0 0 0 0 0 1",
    ],
)
def test_rows_of_truth_that_are_no_poses_are_left_out(tmp_path: Path, row: str) -> None:
    folder, _ = tum_folder(tmp_path / "seq")
    (folder / "groundtruth.txt").write_bytes(f"\ufeff0,0,0,0,0,0,0,1\r\n{row}\r\n2 7 0 0 0 0 0 1\r\n".encode())
    source = open_source(folder, ALL)
    truth = source.truth()
    assert truth is not None and truth.timestamps_s.tolist() == [0.0, 2.0]
    assert truth.world_from_cam[:, 0, 3].tolist() == [0.0, 7.0]
    said = [n for n in source.notes if n.startswith("truth:")]
    assert len(said) == 1 and "1 rows" in said[0] and "groundtruth.txt line 2" in said[0]


@pytest.mark.parametrize("content", [b"", b"# nothing\n", b"\xff\xfe\x00"])
def test_truth_without_a_pose_is_none(tmp_path: Path, content: bytes) -> None:
    folder, _ = tum_folder(tmp_path / "seq")
    (folder / "groundtruth.txt").write_bytes(content)
    source = open_source(folder, ALL)
    truth = source.truth()
    assert truth is None or len(truth.timestamps_s) == 0
    assert any("truth" in n for n in source.notes) == (content[:1] == b"\xff")


def test_windows(tmp_path: Path) -> None:
    folder, _ = tum_folder(tmp_path / "seq")
    with pytest.raises(InputError, match="expected a start before its 5 frames end, got start 5"):
        open_source(folder, SourceConfig(start=5))
    with pytest.raises(ConfigError, match=r"source\.stride: expected 1 or more, got 0"):
        open_source(folder, SourceConfig(stride=0))


@pytest.mark.parametrize("names", [["0", "1", "2"], ["0000", "0001", "0002"], ["100.0", "100.11", "100.2"]])
def test_maps_of_the_user(tmp_path: Path, names: list[str]) -> None:
    folder, _ = tum_folder(tmp_path / "seq")
    maps = tmp_path / "maps"
    maps.mkdir()
    for k, name in enumerate(names):
        Image.fromarray(np.full((24, 32), 51 * (k + 1), np.uint8)).save(maps / f"{name}.png")
    source = open_source(folder, SourceConfig(start=1), semantic_dir=maps)
    semantic = {f.index: f.semantic for f in source.frames()}
    assert source.has_semantic and semantic[3] is None and semantic[4] is None
    for i in (1, 2):
        assert semantic[i].dtype == np.float32 and semantic[i].shape == (24, 32)
        np.testing.assert_allclose(semantic[i], 0.2 * (i + 1), atol=1e-6)
    unread = open_source(folder, ALL, semantic_dir=maps, want_semantic=False)
    assert unread.has_semantic and all(f.semantic is None for f in unread.frames())


def test_bad_maps_of_the_user(tmp_path: Path) -> None:
    folder, _ = image_folder(tmp_path / "shots")
    with pytest.raises(InputError, match="maps: expected a folder of probability maps"):
        open_source(folder, ALL, semantic_dir=tmp_path / "maps")
    (tmp_path / "maps").mkdir()
    with pytest.raises(InputError, match="got none"):
        open_source(folder, ALL, semantic_dir=tmp_path / "maps")
    np.save(tmp_path / "maps" / "zebra.npy", np.zeros((4, 4)))
    with pytest.raises(InputError, match=r"got zebra\.npy"):
        open_source(folder, ALL, semantic_dir=tmp_path / "maps")
    (tmp_path / "maps" / "zebra.npy").unlink()
    np.save(tmp_path / "maps" / "img1.npy", np.full((4, 4), 7.0))
    with pytest.raises(InputError, match=r"img1\.npy: expected probabilities in 0\.\.1, got 7 \.\. 7"):
        list(open_source(folder, ALL, semantic_dir=tmp_path / "maps").frames())


def test_nearest_time_is_the_nearest() -> None:
    rng = np.random.default_rng(1)
    times, wanted = np.sort(rng.uniform(0, 3, 40)), rng.uniform(-0.1, 3.1, 200)
    at = nearest_time(times, wanted)
    gaps = np.abs(times[None] - wanted[:, None])
    np.testing.assert_array_equal(at, np.where(gaps.min(1) <= 0.02, gaps.argmin(1), -1))
    assert (nearest_time(np.empty(0), wanted) == -1).all()


def test_blank_frames() -> None:
    rng = np.random.default_rng(0)
    assert frame_is_blank(np.zeros((48, 64, 3), np.uint8))
    assert frame_is_blank(np.rint(rng.normal(128, 1.5, (48, 64, 3))).astype(np.uint8))
    assert not frame_is_blank(blobs(1)[0])


def test_kitchen() -> None:
    folder = data_path("kitchen")
    source = open_source(folder, ALL)
    truth = source.truth()
    assert source.length == 400 and source.size == (640, 480) and source.has_depth
    assert truth is not None and truth.world_from_cam.shape == (400, 4, 4)
    assert truth.focal_px == pytest.approx(519, abs=1)
    assert any("200 of 400" in n for n in source.notes)
    source = open_source(folder, SourceConfig(start=190, end=210, stride=4), want_depth=True)
    depth = [f.depth_m for f in source.frames()]
    assert [d is not None for d in depth] == [True] * 3 + [False] * 2
    assert depth[0] is not None and 0.5 < np.median(depth[0][depth[0] > 0]) < 5


@pytest.mark.parametrize("name", ["kitchen_walk", "kitchen_walk_close"])
def test_people_in_the_kitchen(name: str) -> None:
    source = open_source(data_path(name), SourceConfig(stride=40))
    truth = source.truth()
    assert truth is not None and source.has_semantic
    for f in source.frames():
        with Image.open(truth.moving_files[f.timestamp_s]) as mask:
            moving = np.asarray(mask.resize((320, 240))) > 127
        assert f.semantic is not None and f.semantic.shape == (240, 320)
        if moving.mean() > 0.05:  # the maps are of a real network: they find the people, not to the pixel
            assert f.semantic[moving].mean() > f.semantic[~moving].mean() + 0.4


def test_street_is_grey_and_comes_as_rgb() -> None:
    frame = next(open_source(data_path("street"), ALL).frames())
    assert frame.image.shape == (370, 1226, 3)
    assert (frame.image[..., 0] == frame.image[..., 2]).all() and not frame_is_blank(frame.image)
