"""Loaders of the public datasets, each on a miniature of its layout: exact, or one line that says what is wrong."""

from __future__ import annotations

import shutil
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


def test_evo_reads_the_same_poses_from_the_same_files(tmp_path: Path) -> None:
    """evo's readers of the three formats, moved to the camera here by the matrices as they are printed."""
    from evo.tools import file_interface as evo

    made = miniatures.euroc(tmp_path / "euroc")
    bodies = evo.read_euroc_csv_trajectory(made.folder / "mav0" / "state_groundtruth_estimate0" / "data.csv")
    same_poses(made, np.array(bodies.poses_se3) @ miniatures.T_BS, bodies.timestamps)
    made = miniatures.kitti_odometry(tmp_path / "kitti", camera=0)
    same_poses(made, np.array(evo.read_kitti_poses_file(made.folder.parents[1] / "poses" / "03.txt").poses_se3))
    made = miniatures.tum_rgbd(tmp_path / "tum")
    cameras = evo.read_tum_trajectory_file(made.folder / "groundtruth.txt")
    same_poses(made, np.array(cameras.poses_se3), cameras.timestamps)


def same_poses(made: Miniature, poses: np.ndarray, times_s: np.ndarray | None = None) -> None:
    truth = opened(made).truth()
    assert truth is not None
    np.testing.assert_allclose(truth.world_from_cam, poses, rtol=0, atol=1e-9)
    if times_s is not None:
        np.testing.assert_allclose(truth.timestamps_s, times_s, rtol=0, atol=2.5e-7)
