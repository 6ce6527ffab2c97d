"""Loaders of the public datasets, each on a miniature of its layout: exact, or one line that says what is wrong."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

import miniatures
from mastd3r.config import SourceConfig
from mastd3r.errors import InputError
from mastd3r.sources import open_source
from mastd3r.sources.bonn import T_M, T_ROS, world_from_cam
from mastd3r.sources.open import LAYOUTS
from mastd3r.types import Source
from miniatures import ALL as MAKERS
from miniatures import Miniature

AUTO = SourceConfig()
WITH_DEPTH = ["tum", "bonn", "7scenes", "replica"]


def opened(made: Miniature, **options: object) -> Source:
    return open_source(made.folder, AUTO, want_depth=True, **options)


@pytest.mark.parametrize("kind", MAKERS)
def test_a_miniature_comes_back_exactly(tmp_path: Path, kind: str) -> None:
    made = MAKERS[kind](tmp_path)
    source = opened(made)
    assert source.kind == kind and source.length == len(made.images)
    assert source.notes[0].startswith(f"{kind}: ")  # what was found, and why
    frames = list(source.frames())
    for i, (frame, image) in enumerate(zip(frames, made.images, strict=True)):
        assert frame.index == i
        np.testing.assert_array_equal(frame.image, image)
    np.testing.assert_allclose(
        [f.timestamp_s for f in frames], made.times_s, rtol=0, atol=2.5e-7
    )  # a double since 1970
    truth = source.truth()
    assert truth is not None
    np.testing.assert_allclose(truth.timestamps_s, made.truth_times_s, rtol=0, atol=2.5e-7)
    scale = max(1.0, float(np.abs(made.world_from_cam[:, :3, 3]).max()))
    # OXTS: latitudes in degrees as doubles are good to 1e-9 m
    np.testing.assert_allclose(
        truth.world_from_cam, made.world_from_cam, rtol=0, atol=5e-9 if kind == "kitti-raw" else 1e-12 * scale
    )
    assert source.calibration == made.calibration
    assert truth.focal_px == (made.calibration[0] if made.calibration else None)
    assert [f.index for f in open_source(made.folder, SourceConfig(start=1, stride=2)).frames()] == list(
        range(1, len(frames), 2)
    )


@pytest.mark.parametrize("kind", MAKERS)
def test_depth_where_there_is_some(tmp_path: Path, kind: str) -> None:
    made = MAKERS[kind](tmp_path)
    source = opened(made)
    assert source.has_depth == (kind in WITH_DEPTH)
    for frame in source.frames():
        if kind not in WITH_DEPTH or (kind == "bonn" and frame.index == 2):
            assert frame.depth_m is None
        else:
            assert frame.depth_m is not None and frame.depth_m.dtype == np.float32
            np.testing.assert_array_equal(frame.depth_m, made.depth_m[frame.index])
    assert all(f.depth_m is None for f in open_source(made.folder, AUTO).frames())


@pytest.mark.parametrize("kind", MAKERS)
def test_the_folders_name_does_not_matter(tmp_path: Path, kind: str) -> None:
    """What a folder is called must not decide what it is: every kind under the name of another."""
    made = MAKERS[kind](tmp_path / "made")
    other = {"tum": "rgbd_bonn_kitti"}.get(kind, "rgbd_dataset_freiburg2_euroc")
    if kind == "kitti-odometry":  # its poses lie outside, under the name of the sequence
        return
    renamed = made.folder.rename(made.folder.with_name(other))
    source = open_source(renamed, AUTO)
    assert source.kind == kind and source.calibration == made.calibration


def test_every_layout_has_a_miniature() -> None:
    assert [layout.kind for layout in LAYOUTS] == list(MAKERS)


@pytest.mark.parametrize("camera", ["freiburg1", "freiburg2", "freiburg3"])
def test_the_camera_of_the_tum_benchmark_is_named_in_the_list(tmp_path: Path, camera: str) -> None:
    made = miniatures.tum_rgbd(tmp_path, camera, count=1)
    source = opened(made)
    focal = {"freiburg1": 517.306408, "freiburg2": 520.908620, "freiburg3": 535.4}[camera]
    assert source.calibration[0] == focal and len(source.calibration) == (4 if camera == "freiburg3" else 9)
    assert camera in source.notes[0]
    plain = (made.folder / "rgb.txt").read_text().replace(".bag", "").replace("rgbd_dataset", "my")
    (made.folder / "rgb.txt").write_text(plain)
    source = opened(made)  # the folder's name still says freiburg, its files do not
    assert source.kind == "tum" and source.calibration == ()


@pytest.mark.parametrize("kind", ["tum", "bonn", "kitti-raw", "euroc", "replica"])
def test_pictures_that_were_resized_have_no_lens(tmp_path: Path, kind: str) -> None:
    made = MAKERS[kind](tmp_path)
    for path in (p for p in made.folder.rglob("*") if p.suffix in (".png", ".jpg")):
        Image.open(path).resize((64, 48)).save(path)
    source = open_source(made.folder, SourceConfig(kind=kind))
    truth = source.truth()
    assert source.calibration == () and truth is not None and truth.focal_px is None
    assert any("the pictures are 64x48: it is not used" in n for n in source.notes)


def test_truth_of_the_tum_benchmark_is_nearest_in_time(tmp_path: Path) -> None:
    """Poses at 100 Hz, frames at 30: the evaluation's association takes the nearest within 20 ms."""
    from mastd3r.evaluation.trajectory_error import associate

    made = miniatures.tum_rgbd(tmp_path)
    truth = opened(made).truth()
    assert truth is not None
    rows, true_rows = associate(made.times_s, truth.timestamps_s, 0.02)
    assert list(rows) == [0, 1, 2]
    nearest = np.abs(made.truth_times_s[None] - made.times_s[:, None]).argmin(1)
    np.testing.assert_array_equal(true_rows, nearest)


def test_bonns_transformation_is_the_published_one() -> None:
    """T_g = T_ros T_0 T_ros T_m of the dataset's script, but for the scale of T_m's linear part."""
    markers = miniatures.random_poses(5, seed=11)
    ours = world_from_cam(markers)
    for marker, cam in zip(markers, ours, strict=True):
        published = T_ROS @ marker @ T_ROS @ T_M
        np.testing.assert_allclose(cam[:3, 3], published[:3, 3], atol=1e-12)
        scale = np.cbrt(np.linalg.det(published[:3, :3]))
        assert scale == pytest.approx(1.0593, abs=1e-4)
        np.testing.assert_allclose(cam[:3, :3] * scale, published[:3, :3], atol=2e-4)
        np.testing.assert_allclose(cam[:3, :3] @ cam[:3, :3].T, np.eye(3), atol=1e-12)


def test_bonns_absent_files_are_left_out_and_counted(tmp_path: Path) -> None:
    made = miniatures.bonn(tmp_path)
    assert any("depth.txt: 1 of 12 files are absent" in n for n in opened(made).notes)
    for stem in sorted((made.folder / "rgb").iterdir())[3:6]:
        stem.unlink()
    with pytest.raises(InputError, match=r"rgb\.txt: expected files beside its 12 lines, 3 of them are not there"):
        opened(made)


def test_seven_scenes_says_that_depth_is_not_registered(tmp_path: Path) -> None:
    source = opened(miniatures.seven_scenes(tmp_path))
    assert any("not registered" in n for n in source.notes) and any("30 frames a second" in n for n in source.notes)


def test_kitti_odometry_in_grey_and_without_poses(tmp_path: Path) -> None:
    made = miniatures.kitti_odometry(tmp_path, camera=0)
    source = opened(made)
    truth = source.truth()
    assert truth is not None and "image_0 (left grey)" in source.notes[0]
    np.testing.assert_allclose(truth.world_from_cam, made.world_from_cam, atol=1e-12)
    np.testing.assert_array_equal(next(source.frames()).image, made.images[0])
    shutil.rmtree(tmp_path / "dataset" / "poses")  # sequences 11 to 21 have none
    source = opened(made)
    truth = source.truth()
    assert truth is not None and len(truth.timestamps_s) == 0 and truth.focal_px == 721.5377
    assert any(n.startswith("no poses") for n in source.notes)


def test_kitti_raw_without_calibration_is_still_a_sequence_of_images(tmp_path: Path) -> None:
    made = miniatures.kitti_raw(tmp_path)
    (made.folder.parent / "calib_cam_to_cam.txt").unlink()
    source = opened(made)
    assert source.truth() is None and source.calibration == () and len(list(source.frames())) == 4
    assert any(n.startswith("no calibration: calib_cam_to_cam.txt") for n in source.notes)


def test_euroc_may_be_named_by_its_inner_folder(tmp_path: Path) -> None:
    made = miniatures.euroc(tmp_path)
    source = open_source(made.folder / "mav0", AUTO)
    assert source.kind == "euroc" and source.name == "MH_01_easy"


# -- what is wrong is said -------------------------------------------------------------------------------------------


def unlink(*names: str) -> Callable[[Path], None]:
    def act(folder: Path) -> None:
        for name in names:
            (folder / name).unlink()

    return act


def write(name: str, text: str) -> Callable[[Path], None]:
    return lambda folder: (folder / name).write_text(text) and None


def cut(name: str, lines: int) -> Callable[[Path], None]:
    """Drop the last lines of a file, as an interrupted copy does."""

    def act(folder: Path) -> None:
        kept = (folder / name).read_text().splitlines()[:-lines]
        (folder / name).write_text("\n".join(kept) + "\n")

    return act


def swap(name: str, old: str, new: str) -> Callable[[Path], None]:
    def act(folder: Path) -> None:
        text = (folder / name).read_text()
        assert old in text
        (folder / name).write_text(text.replace(old, new))

    return act


DAMAGE = {
    "raw: an image is missing": (
        "kitti-raw", unlink("image_02/data/0000000002.png"),
        r"expected 4 images, got 3; .* 2",
    ),
    "raw: a packet is missing": ("kitti-raw", unlink("oxts/data/0000000003.txt"), r"expected 4 packets, got 3; .* 3"),
    "raw: a packet is cut": (
        "kitti-raw", write("oxts/data/0000000001.txt", "49.0 8.4 116"),
        r"0000000001\.txt line 1: expected lat lon",
    ),
    "raw: a time is none": (
        "kitti-raw", write("image_02/timestamps.txt", "noon\n"),
        r"timestamps\.txt line 1: expected 'YYYY",
    ),
    "raw: no velodyne calibration": (
        "kitti-raw", unlink("../calib_velo_to_cam.txt"),
        r"calib_velo_to_cam\.txt: expected a text file",
    ),
    "raw: a key is missing": (
        "kitti-raw", swap("../calib_cam_to_cam.txt", "P_rect_02", "P_rect_01"),
        r"expected a line 'P_rect_02",
    ),
    "raw: no rotation": (
        "kitti-raw", write("../calib_imu_to_velo.txt", "R: 1 0 0 0 1 0 0 0 2\nT: 0 0 0\n"),
        "expected a rotation",
    ),
    "odometry: poses are cut": ("kitti-odometry", cut("../../poses/03.txt", 1), r"03\.txt: expected 4 poses .* got 3"),
    "odometry: a pose is cut": (
        "kitti-odometry", write("../../poses/03.txt", "1 0 0 0 1\n"),
        r"03\.txt line 1: expected a \(3, 4\) matrix \(12 numbers\), got 5",
    ),
    "odometry: times are cut": ("kitti-odometry", cut("times.txt", 1), r"expected 3 poses .* got 4"),
    "odometry: an image is missing": (
        "kitti-odometry", unlink("image_2/000001.png"),
        r"expected 4 images, got 3; .* 1",
    ),
    "odometry: no calibration": (
        "kitti-odometry", unlink("calib.txt"),
        r"calib\.txt: expected a text file, got no such file",
    ),
    "odometry: calibration is cut": (
        "kitti-odometry", swap("calib.txt", "P2: 721.5377", "P2: "),
        r"line 3: expected 12 numbers after P2",
    ),
    "7scenes: a pose is missing": (
        "7scenes", unlink("frame-000001.pose.txt"),
        r"frame-000001\.pose\.txt: expected a pose",
    ),
    "7scenes: a pose is cut": (
        "7scenes", cut("frame-000002.pose.txt", 1),
        r"frame-000002\.pose\.txt: expected 4 lines of 4 numbers, got 3",
    ),
    "7scenes: a pose is words": (
        "7scenes", write("frame-000000.pose.txt", "lost\n"),
        r"line 1: expected a row of a \(4, 4\) matrix",
    ),
    "euroc: no sensor.yaml": (
        "euroc", unlink("mav0/cam0/sensor.yaml"),
        r"sensor\.yaml: expected the camera's calibration",
    ),
    "euroc: broken yaml": ("euroc", write("mav0/cam0/sensor.yaml", "T_BS: ["), r"sensor\.yaml: expected readable YAML"),
    "euroc: a cut matrix": (
        "euroc", swap("mav0/cam0/sensor.yaml", "0.0, 0.0, 0.0, 1.0]", "0.0]"),
        r"expected T_BS of 16 numbers",
    ),
    "euroc: another lens": (
        "euroc", swap("mav0/cam0/sensor.yaml", "radial-tangential", "equidistant"),
        "expected distortion_model radial-tangential, got 'equidistant'",
    ),
    "euroc: a bad list": (
        "euroc", write("mav0/cam0/data.csv", "#t,f\nlater,a.png\n"),
        r"data\.csv line 2: expected 'nanoseconds,filename'",
    ),
    "euroc: an image is missing": (
        "euroc", unlink("mav0/cam0/data/1403636579813555584.png"),
        r"1403636579813555584\.png: expected an image",
    ),
    "euroc: a pose is cut": (
        "euroc", write("mav0/state_groundtruth_estimate0/data.csv", "#h\n1403636579763555584,1,2\n"),
        r"data\.csv line 2: expected nanoseconds, position",
    ),
    "replica: poses are cut": ("replica", cut("traj.txt", 1), r"traj\.txt: expected 3 poses, one an image, got 2"),
    "replica: images are cut": ("replica", unlink("results/frame000002.jpg"), r"expected 3 images, got 2; .* 2"),
    "replica: no camera": (
        "replica", unlink("../cam_params.json"),
        r"expected cam_params\.json in the folder or beside it",
    ),
    "replica: a camera without scale": (
        "replica", swap("../cam_params.json", '"scale"', '"skale"'),
        "expected 'camera' with w, h, .*'scale'",
    ),
    "replica: no matrix": (
        "replica", write("traj.txt", "1 2 3\n"),
        r"traj\.txt line 1: expected a \(4, 4\) matrix \(16 numbers\), got 3",
    ),
}  # fmt: skip


@pytest.mark.parametrize("case", DAMAGE)
def test_damage_is_refused_with_what_was_expected(tmp_path: Path, case: str) -> None:
    kind, damage, message = DAMAGE[case]
    made = MAKERS[kind](tmp_path)
    damage(made.folder)
    with pytest.raises(InputError, match=message):
        opened(made)


@pytest.mark.parametrize("kind", MAKERS)
def test_a_picture_cut_short(tmp_path: Path, kind: str) -> None:
    made = MAKERS[kind](tmp_path)
    pictures = sorted(p for p in made.folder.rglob("*") if p.suffix in (".png", ".jpg") and "depth" not in str(p.name))
    pictures = [p for p in pictures if "depth" not in p.parts and "image_00" not in p.parts]
    pictures[-1].write_bytes(pictures[-1].read_bytes()[:60])
    with pytest.raises(InputError, match=rf"{pictures[-1].name}: expected a readable image"):
        list(opened(made).frames())


def test_depth_of_another_size(tmp_path: Path) -> None:
    made = miniatures.replica(tmp_path)
    Image.fromarray(np.ones((10, 10), np.uint16)).save(made.folder / "results" / "depth000001.png")
    with pytest.raises(InputError, match=r"depth000001\.png: expected 1200x680 .* got 10x10"):
        list(opened(made).frames())


# -- which kind it is ------------------------------------------------------------------------------------------------


def test_a_folder_above_the_sequences_names_them(tmp_path: Path) -> None:
    for make in MAKERS.values():
        make(tmp_path / make.__name__)
    with pytest.raises(
        InputError, match="expected one sequence, got a folder that holds 7; name one of them: bonn/rgbd"
    ):
        open_source(tmp_path, AUTO)
    with pytest.raises(InputError, match=r"holds 1; name one of them: 2011_09_26/2011_09_26_drive_0001_sync$"):
        open_source(tmp_path / "kitti_raw", AUTO)


def test_files_of_two_kinds_are_refused_unless_the_user_says(tmp_path: Path) -> None:
    made = miniatures.seven_scenes(tmp_path)
    shutil.copytree(miniatures.tum_rgbd(tmp_path / "other", count=1).folder, made.folder, dirs_exist_ok=True)
    with pytest.raises(
        InputError, match=r"could be tum \(rgb\.txt is there\) or 7scenes \(frame-.*say which with --kind"
    ):
        opened(made)
    assert open_source(made.folder, SourceConfig(kind="7scenes")).length == 3
    assert open_source(made.folder, SourceConfig(kind="tum")).length == 1


def test_the_kind_may_be_forced(tmp_path: Path) -> None:
    made = miniatures.tum_rgbd(tmp_path)
    forced = open_source(made.folder, SourceConfig(kind="bonn"))
    assert forced.kind == "bonn" and "as --kind says" in forced.notes[0]
    with pytest.raises(InputError, match="expected a video file, as --kind video says, got a folder"):
        open_source(made.folder, SourceConfig(kind="video"))
    with pytest.raises(InputError, match=r"times\.txt: expected|expected image_2 or image_0"):
        open_source(made.folder, SourceConfig(kind="kitti-odometry"))
    picture = next((made.folder / "rgb").iterdir())
    with pytest.raises(InputError, match="expected a folder, as --kind tum says, got a file"):
        open_source(picture, SourceConfig(kind="tum"))
    assert open_source(made.folder / "rgb", SourceConfig(kind="images")).kind == "images"


def test_a_folder_of_nothing_known_lists_what_is_expected(tmp_path: Path) -> None:
    (tmp_path / "readme.md").write_text("hello")
    with pytest.raises(InputError) as refused:
        open_source(tmp_path, AUTO)
    assert all(layout.expected in str(refused.value) for layout in LAYOUTS) and "readme.md" in str(refused.value)
