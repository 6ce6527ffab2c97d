"""What is wrong with a dataset, and which kind a folder is: one line that says what was expected."""

from __future__ import annotations

import re
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
from mastd3r.sources.open import LAYOUTS
from miniatures import ALL as MAKERS

AUTO = SourceConfig()


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
    "replica: no camera": (
        "replica", unlink("../cam_params.json"),
        r"expected cam_params\.json in the folder or beside it",
    ),
    "replica: a camera without scale": (
        "replica", swap("../cam_params.json", '"scale"', '"skale"'),
        "expected 'camera' with w, h, .*'scale'",
    ),
}  # fmt: skip
DAMAGED_TRUTH = {
    "raw: a packet is missing": ("kitti-raw", unlink("oxts/data/0000000003.txt"), r"expected 4 packets, got 3; .* 3"),
    "raw: a packet is cut": (
        "kitti-raw", write("oxts/data/0000000001.txt", "49.0 8.4 116"),
        r"0000000001\.txt line 1: expected lat lon",
    ),
    "odometry: poses are cut": ("kitti-odometry", cut("../../poses/03.txt", 1), r"03\.txt: expected 4 poses .* got 3"),
    "odometry: a pose is cut": (
        "kitti-odometry", write("../../poses/03.txt", "1 0 0 0 1\n"),
        r"03\.txt line 1: expected a \(3, 4\) matrix \(12 numbers\), got 5",
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
    "euroc: a pose is cut": (
        "euroc", write("mav0/state_groundtruth_estimate0/data.csv", "#h\n1403636579763555584,1,2\n"),
        r"data\.csv line 2: expected nanoseconds, position",
    ),
    "replica: poses are cut": ("replica", cut("traj.txt", 1), r"traj\.txt: expected 3 poses, one an image, got 2"),
    "replica: no matrix": (
        "replica", write("traj.txt", "1 2 3\n"),
        r"traj\.txt line 1: expected a \(4, 4\) matrix \(16 numbers\), got 3",
    ),
    "odometry: times are cut": ("kitti-odometry", cut("times.txt", 1), r"expected 3 poses .* got 4"),
    "replica: images are cut": ("replica", unlink("results/frame000002.jpg"), r"expected 2 poses, one an image, got 3"),
}  # fmt: skip


@pytest.mark.parametrize("case", DAMAGE)
def test_damage_is_refused_with_what_was_expected(tmp_path: Path, case: str) -> None:
    kind, damage, message = DAMAGE[case]
    made = MAKERS[kind](tmp_path)
    damage(made.folder)
    with pytest.raises(InputError, match=message):
        open_source(made.folder, AUTO, want_depth=True)


@pytest.mark.parametrize("case", DAMAGED_TRUTH)
def test_damaged_truth_stops_nobody_and_is_told_at_once(tmp_path: Path, case: str) -> None:
    kind, damage, message = DAMAGED_TRUTH[case]
    made = MAKERS[kind](tmp_path)
    damage(made.folder)
    source = open_source(made.folder, AUTO, want_depth=True)
    assert any(re.search(f"truth is left out: .*{message}", note) for note in source.notes)
    truth = source.truth()
    assert truth is None or len(truth.timestamps_s) == 0
    assert len(list(source.frames())) == source.length


@pytest.mark.parametrize("kind", MAKERS)
def test_a_picture_cut_short(tmp_path: Path, kind: str) -> None:
    made = MAKERS[kind](tmp_path)
    pictures = sorted(p for p in made.folder.rglob("*") if p.suffix in (".png", ".jpg") and "depth" not in str(p.name))
    pictures = [p for p in pictures if "depth" not in p.parts and "image_00" not in p.parts]
    whole = {f.index: f.timestamp_s for f in open_source(made.folder, AUTO).frames()}
    pictures[-1].write_bytes(pictures[-1].read_bytes()[:60])
    source = open_source(made.folder, AUTO, want_depth=True)
    assert {f.index: f.timestamp_s for f in source.frames()} == dict(list(whole.items())[:-1])
    assert any(n.startswith("images that cannot be read") and pictures[-1].name in n for n in source.notes)


def test_depth_of_another_size(tmp_path: Path) -> None:
    made = miniatures.replica(tmp_path)
    Image.fromarray(np.ones((10, 10), np.uint16)).save(made.folder / "results" / "depth000001.png")
    with pytest.raises(InputError, match=r"depth000001\.png: expected 1200x680 .* got 10x10"):
        list(open_source(made.folder, AUTO, want_depth=True).frames())


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
        open_source(made.folder, AUTO, want_depth=True)
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
