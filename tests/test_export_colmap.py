"""The COLMAP export: every image is there under its own name, the lens is theirs, tracks are measurements."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest
from PIL import Image

import mastd3r
from colmap_reader import Model, projected, read_binary, read_text
from helpers import blobs, write_video
from made_runs import NAMES, MadeRun, edited_record, made_run, moving_of, without_distortion
from mastd3r.camera.opencv_lens import OpenCvLens
from mastd3r.camera.pinhole import Camera
from mastd3r.config import SourceConfig
from mastd3r.errors import InputError
from mastd3r.export.lens_models import colmap_model
from mastd3r.geometry.se3 import inverse
from mastd3r.sources import open_source

BENT = Camera(90.0, 90.0, 47.0, 36.5, 96, 72, k1=-0.08, k2=0.01)
STRAIGHT = without_distortion(BENT)
LENSES = {
    "PINHOLE": STRAIGHT,
    "SIMPLE_RADIAL": Camera(90.0, 90.0, 47.0, 36.5, 96, 72, k1=-0.05),
    "RADIAL": BENT,
    "OPENCV": OpenCvLens(90.0, 92.0, 47.0, 36.5, 96, 72, (-0.08, 0.01, 0.002, -0.001)),
    "FULL_OPENCV": OpenCvLens(90.0, 90.0, 47.0, 36.5, 96, 72, (-0.08, 0.01, 0.002, -0.001, 0.01, 0.02, 0.01, 0.001)),
}


EXPORTED = (*NAMES[:4], f"{NAMES[4]}.png")  # COLMAP reads no WebP


def exported(run: MadeRun, root: Path, **options: object) -> tuple[Path, Model]:
    out = mastd3r.load(run.path).export("colmap", root / "out", **options)  # type: ignore[arg-type]
    return out, read_binary(out / "sparse" / "0")


@pytest.mark.parametrize("name", LENSES)
def test_their_projection_is_our_camera(name: str) -> None:
    model, parameters = colmap_model(LENSES[name])
    assert model == name
    points = np.random.default_rng(0).uniform([-1.5, -1.2, 4], [1.5, 1.2, 6], (50, 3))
    theirs = projected(model, np.array(parameters), points[:, :2] / points[:, 2:])
    np.testing.assert_allclose(theirs, LENSES[name].project(points) + 0.5, atol=1e-9)


def test_text_and_binary_say_the_same(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    out, binary = exported(made_run(tmp_path, BENT), tmp_path)
    assert "the lens is bent: images are undistorted to a pinhole of" in caplog.text
    text = read_text(out / "sparse" / "0")
    assert text.camera[:3] == binary.camera[:3] and np.allclose(text.camera[3], binary.camera[3], rtol=1e-11)
    assert list(text.images) == list(binary.images) and list(text.points) == list(binary.points)
    for n, image in binary.images.items():
        assert (text.images[n].name, text.images[n].point_ids) == (image.name, image.point_ids)
        np.testing.assert_allclose(text.images[n].cam_from_world, image.cam_from_world, atol=1e-10)
        np.testing.assert_allclose(text.images[n].px, image.px, atol=1e-6)
    for n, point in binary.points.items():
        assert (text.points[n].rgb, text.points[n].track) == (point.rgb, point.track)
        np.testing.assert_allclose(text.points[n].xyz, point.xyz, rtol=1e-10)
        assert text.points[n].error == pytest.approx(point.error, rel=1e-7)


@pytest.mark.parametrize("name", LENSES)
def test_a_reader_sees_what_was_measured(name: str, tmp_path: Path) -> None:
    """Poses, points and tracks are those of the run; the errors of points are what their reader computes."""
    run = made_run(tmp_path, LENSES[name])
    _, model = exported(run, tmp_path, undistort=False)
    assert model.camera[0] == name and len(model.images) == 5 and len(model.points) == len(run.tracks.points_world)
    for image, pose in zip(model.images.values(), run.trajectory.world_from_cam, strict=True):
        np.testing.assert_allclose(image.cam_from_world, inverse(pose), atol=1e-8)
    np.testing.assert_allclose(model.errors_px(), run.error_px, atol=1e-4)
    assert np.mean([p.error for p in model.points.values()]) == pytest.approx(run.error_px.mean(), rel=1e-3)
    assert [p.rgb for p in model.points.values()] == [tuple(c) for c in run.tracks.colors.tolist()]


@pytest.mark.parametrize("name", ["RADIAL", "OPENCV", "FULL_OPENCV"])
def test_a_bent_lens_becomes_a_pinhole(name: str, tmp_path: Path) -> None:
    """Pixels of the undistorted image lie on the ray that the photograph's lens has there; so do observations."""
    run = made_run(tmp_path, LENSES[name], noise_px=0.0)
    out, model = exported(run, tmp_path)
    camera = model.camera
    assert camera[0] == "PINHOLE" and model.errors_px().max() < 2e-4 and len(model.points) > 50
    fx, fy, cx, cy = camera[3]
    x, y = np.meshgrid(np.arange(camera[1]), np.arange(camera[2]))
    rays = np.stack([(x + 0.5 - cx) / fx, (y + 0.5 - cy) / fy, np.ones(x.shape)], -1)
    at = run.lens.project(rays).astype(np.float32)
    assert (at > -0.5).all() and (at < np.array([95.5, 71.5])).all()  # every pixel has data
    photograph = cv2.imread(str(run.photographs / "shots" / NAMES[3]))
    expected = cv2.remap(photograph, at, None, cv2.INTER_LINEAR)
    written = cv2.imread(str(out / "images" / NAMES[3]))
    assert np.abs(written.astype(int) - expected).max() <= 2


def test_images_keep_their_names_and_bytes(tmp_path: Path) -> None:
    run = made_run(tmp_path, STRAIGHT)
    out, model = exported(run, tmp_path)
    webp = Image.open(run.photographs / "shots" / NAMES[4]).convert("RGB")
    assert np.array_equal(Image.open(out / "images" / EXPORTED[4]), webp)
    assert [image.name for image in model.images.values()] == list(EXPORTED)
    for name in NAMES[:4]:
        assert (out / "images" / name).read_bytes() == (run.photographs / "shots" / name).read_bytes()


def test_an_image_that_was_turned_when_read_is_written_upright(tmp_path: Path) -> None:
    """COLMAP does not look at EXIF orientation; our lens is that of the upright image."""
    run = made_run(tmp_path, STRAIGHT)
    file = run.photographs / "shots" / NAMES[3]
    upright, turned = Image.open(file).convert("RGB"), Image.Exif()
    turned[0x0112] = 6  # to be turned clockwise by a quarter
    upright.transpose(Image.Transpose.ROTATE_90).save(file, exif=turned)
    out, _ = exported(run, tmp_path)
    written = Image.open(out / "images" / NAMES[3])
    assert np.array_equal(written, upright) and 0x0112 not in written.getexif()


@pytest.mark.parametrize("lens", [STRAIGHT, BENT])
def test_masks_are_black_where_things_move(lens: Camera, tmp_path: Path) -> None:
    out, model = exported(made_run(tmp_path, lens), tmp_path)
    for n, name in enumerate(EXPORTED):
        mask = cv2.imread(str(out / "masks" / f"{name}.png"), cv2.IMREAD_UNCHANGED)
        assert mask.shape == (model.camera[2], model.camera[1]) and set(np.unique(mask)) == {0, 255}
        middle = lens.project(lens.pinhole.rays(np.array([2 * (9 + 4 * n) + 0.0, 30.0])))  # of the square, as taken
        fx, fy, cx, cy = model.camera[3]
        ray = lens.rays(middle)
        u, v = (int(np.floor(f * r + c)) for f, r, c in zip((fx, fy), ray[:2], (cx, cy), strict=True))
        assert mask[v, u] == 0 and mask[-5, -5] == 255 and mask[5, -5] == 255
        moving = cv2.resize(moving_of(n, lens), (96, 72)) > 0.5
        assert moving.sum() < (mask == 0).sum() < 2.5 * moving.sum()


def test_measured_poses_alone_unless_all_are_asked_for(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    states = ("started", "tracked", "interpolated", "interpolated", "tracked")
    run = made_run(tmp_path, STRAIGHT, states)  # type: ignore[arg-type]
    out, model = exported(run, tmp_path)
    assert [i.name for i in model.images.values()] == [EXPORTED[n] for n in (0, 1, 4)]
    assert sum(p.is_file() for p in (out / "images").rglob("*")) == 3
    assert {len(p.track) for p in model.points.values()} == {3} and len(model.errors_px())
    assert "2 of 5 poses are interpolated, and left out" in caplog.text
    _, whole = exported(run, tmp_path, all_poses=True)
    assert [i.name for i in whole.images.values()] == list(EXPORTED)


def test_an_older_run_takes_names_from_the_source_and_points_from_the_cloud(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    run = made_run(tmp_path, STRAIGHT, tracked=False)
    edited_record(run.path, files=None)
    _, model = exported(run, tmp_path)
    assert [i.name for i in model.images.values()] == list(EXPORTED) and len(model.points) == 60
    assert {(p.error, len(p.track)) for p in model.points.values()} == {(-1.0, 0)}
    assert "images are named as the source's are" in caplog.text and "no tracks.npz" in caplog.text


def test_frames_of_a_video_are_extracted(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    run = made_run(tmp_path, STRAIGHT, times_s=np.arange(1, 6) / 25)
    video = write_video(tmp_path / "clip.mp4", blobs(7, 96, 72), [0, 40, 80, 120, 160, 200, 240])
    edited_record(run.path, files={}, source={"path": str(video), "kind": "video"})
    out, model = exported(run, tmp_path)
    names = [f"frame_{n:06d}.png" for n in range(1, 6)]
    assert [i.name for i in model.images.values()] == names == sorted(p.name for p in (out / "images").iterdir())
    frames = {f.index: f.image for f in open_source(video, SourceConfig()).frames()}
    assert np.array_equal(Image.open(out / "images" / names[2]), frames[3])
    assert not caplog.text


@pytest.mark.parametrize("what", ["empty", "text", "cut", "changed"])
def test_tracks_that_cannot_be_read_are_one_line(tmp_path: Path, what: str) -> None:
    run = made_run(tmp_path, STRAIGHT)
    file = run.path / "tracks.npz"
    whole = file.read_bytes()
    changed = whole[:200] + bytes(64) + whole[264:]
    file.write_bytes({"empty": b"", "text": b"tracks", "cut": whole[: len(whole) // 2], "changed": changed}[what])
    with pytest.raises(InputError, match=r"tracks\.npz: expected the tracks of a run, got") as caught:
        exported(run, tmp_path)
    assert "\n" not in str(caught.value) and not (tmp_path / "out").exists()


def test_photographs_that_moved_are_named(tmp_path: Path) -> None:
    run = made_run(tmp_path, STRAIGHT)
    moved = run.photographs.rename(tmp_path / "elsewhere")
    with pytest.raises(InputError, match=r"expected the photographs at its source\.path.*--source"):
        exported(run, tmp_path)
    assert sorted(p.name for p in tmp_path.iterdir()) == ["elsewhere", "run"]
    out, _ = exported(run, tmp_path, source=moved)
    assert (out / "images" / NAMES[0]).is_file()


def test_another_source_leaves_nothing(tmp_path: Path) -> None:
    run = made_run(tmp_path, STRAIGHT)
    rows = (run.photographs / "rgb.txt").read_text().splitlines(keepends=True)
    (run.photographs / "rgb.txt").write_text("".join(rows[:3]))
    with pytest.raises(InputError, match=r"got none for 2 of its poses, the first at 100\.100000 s"):
        exported(run, tmp_path)
    assert sorted(p.name for p in tmp_path.iterdir()) == ["photos", "run"]


def test_colmap_itself_reads_it(tmp_path: Path) -> None:
    """pycolmap: its own mean error is ours, and its undistortion writes every image."""
    pycolmap = pytest.importorskip("pycolmap")
    run = made_run(tmp_path, BENT)
    out, model = exported(run, tmp_path, undistort=False)
    theirs = pycolmap.Reconstruction(str(out / "sparse" / "0"))
    assert theirs.num_reg_images() == 5 and theirs.num_points3D() == len(model.points)
    assert theirs.compute_mean_reprojection_error() == pytest.approx(model.errors_px().mean(), rel=0.01)
    theirs.update_point_3d_errors()
    assert theirs.compute_mean_reprojection_error() == pytest.approx(model.errors_px().mean(), rel=0.01)
    pycolmap.undistort_images(str(tmp_path / "flat"), str(out / "sparse" / "0"), str(out / "images"))
    assert sum(p.is_file() for p in (tmp_path / "flat" / "images").rglob("*")) == 5
