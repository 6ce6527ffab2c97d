"""Whole runs: a made clip against its exact truth, a real video, and a small map."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from helpers import data_path, write_video
from mastd3r.cli.main import main
from mastd3r.config import HOLDOUT_EVERY
from mastd3r.geometry.upright import down
from mastd3r.sources.synthetic import make_room_clip

SCORE = Path(__file__).resolve().parents[2] / "shared" / "tools" / "score.py"
LOOK = SCORE.with_name("splat_check.py")


def metrics_of(folder: Path) -> dict[str, Any]:
    data: dict[str, Any] = json.loads((folder / "metrics.json").read_text())
    return data


def rows(path: Path) -> np.ndarray:
    return np.loadtxt(path, ndmin=2)


def path_length(clip: Path) -> float:
    truth = rows(clip / "groundtruth.txt")[:, 1:4]
    return float(np.linalg.norm(np.diff(truth, axis=0), axis=1).sum())


def independent_score(run: Path, clip: Path) -> dict[str, Any]:
    if not SCORE.is_file():
        pytest.skip("the independent scorer is not at hand")
    done = subprocess.run([sys.executable, str(SCORE), str(run), str(clip)], capture_output=True, text=True, check=True)
    data: dict[str, Any] = json.loads(done.stdout)
    return data


def independent_look(run: Path, clip: Path, width: int) -> dict[str, Any]:
    """The splat file, drawn by code that shares nothing with ours."""
    if not LOOK.exists():
        pytest.skip(f"no {LOOK}")
    command = [sys.executable, str(LOOK), str(run), str(clip), "--width", str(width)]
    done = subprocess.run(command, capture_output=True, text=True, check=True)
    data: dict[str, Any] = json.loads(done.stdout)
    return data


@pytest.mark.slow
def test_the_room_at_its_usual_size(tmp_path: Path) -> None:
    """48 frames at 320x240 with a moving ball, nothing given: every frame posed, ATE within 1.5 % of the path."""
    clip = make_room_clip(tmp_path / "room", frames=48)
    out = tmp_path / "out"
    assert main(["run", str(clip), "--out", str(out), "--no-map", "--quiet"]) == 0
    metrics = metrics_of(out)
    assert metrics["frames"] == metrics["frames_posed"] == 48
    assert metrics["ate_rmse_all"] <= 0.015 * path_length(clip)
    assert metrics["mask_iou"] > 0.4 and metrics["mask_false_positive_ratio"] < 0.05
    assert metrics["focal_px"] == pytest.approx(300, rel=0.1)
    trajectory = rows(out / "trajectory.txt")
    assert trajectory.shape == (48, 8) and np.isfinite(trajectory).all()
    record = json.loads((out / "run.json").read_text())
    np.testing.assert_allclose(trajectory[0, 1:4], 0, atol=1e-6)  # the world is the first view's, turned upright
    first = Rotation.from_quat(trajectory[0, 4:]).as_matrix()
    np.testing.assert_allclose(first, record["world"]["upright_from_first"], atol=1e-6)
    kept = rows(out / "keyframes.txt")
    poses = np.tile(np.eye(4), (len(kept), 1, 1))
    poses[:, :3, :3] = Rotation.from_quat(kept[:, 4:]).as_matrix()
    np.testing.assert_allclose(down(poses)[0], [0, 1, 0], atol=1e-3)
    assert record["status"] == "complete" and record["camera"]["found"] == "from the video"
    for name in ("config.yaml", "keyframes.txt", "camera.json", "cloud.ply", "report.html"):
        assert (out / name).stat().st_size > 0
    assert len(list((out / "masks").iterdir())) == 48 and not (out / "gaussians.ply").exists()
    assert independent_score(out, clip)["ate_all"] == pytest.approx(metrics["ate_rmse_all"], rel=1e-3)


def test_the_same_seed_gives_the_same_bytes(room_clip: Path, tmp_path: Path) -> None:
    for name in ("a", "b"):
        out = tmp_path / name
        assert main(["run", str(room_clip), "--out", str(out), "--no-map", "--quiet", "--seed", "3"]) == 0
    for file in ("trajectory.txt", "keyframes.txt", "camera.json", "cloud.ply", "tracks.npz"):
        assert (tmp_path / "a" / file).read_bytes() == (tmp_path / "b" / file).read_bytes(), file


@pytest.mark.parametrize("correction", ["none", "coarse", "fine", "coarse-to-fine"])
def test_every_correction_runs_on_sensor_depth(room_clip: Path, tmp_path: Path, correction: str) -> None:
    """Depth pointmaps and a given lens: metric poses, so nothing but a rigid motion is left to align."""
    out = tmp_path / "out"
    words = ["--pointmaps", "depth", "--intrinsics", "150,150,79.5,59.5", "--correction", correction]
    assert main(["run", str(room_clip), "--out", str(out), "--no-map", "--quiet", "--end", "16", *words]) == 0
    assert metrics_of(out)["frames_posed"] == 16
    truth, found = rows(room_clip / "groundtruth.txt")[:16, 1:4], rows(out / "trajectory.txt")[:, 1:4]
    ratio = np.linalg.norm(found[-1] - found[0]) / np.linalg.norm(truth[-1] - truth[0])
    assert ratio == pytest.approx(1, abs=0.03)
    assert metrics_of(out)["ate_rmse_all"] < 0.03 * path_length(room_clip)


def test_a_real_video(tmp_path: Path) -> None:
    """24 frames of a handheld shot of two jumping children, as the mp4 that a phone gives."""
    folder = data_path("bedroom")
    names = [line.split()[1] for line in (folder / "rgb.txt").read_text().splitlines() if line[:1] != "#"]
    images = [cv2.imread(str(folder / name))[..., ::-1] for name in names[:96:4]]
    height, width = (n // 2 * 2 for n in images[0].shape[:2])
    small = [np.ascontiguousarray(image[:height, :width]) for image in images]
    times_ms = [133 * k for k in range(24)]
    video = write_video(tmp_path / "bedroom.mp4", small, times_ms)
    out = tmp_path / "out"
    assert main(["run", str(video), "--out", str(out), "--no-map", "--quiet"]) == 0
    metrics = metrics_of(out)
    assert metrics["frames"] == metrics["frames_posed"] == 24
    trajectory = rows(out / "trajectory.txt")
    assert np.isfinite(trajectory).all() and np.ptp(trajectory[:, 1:4], 0).max() > 0
    np.testing.assert_allclose(trajectory[:, 0] * 1000, times_ms, atol=1)
    assert 0.4 * width < metrics["focal_px"] < 3 * width
    assert 0.005 < metrics["mask_moving_ratio"] < 0.7
    assert "ate_rmse_all" not in metrics


@pytest.mark.usefixtures("short_flight")
def test_a_small_map(room_clip: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    changed = (
        "mapping.iterations=60",
        "mapping.width_px=160",
        "tracking.cell_px=5",
        "tracking.keyframe_motion_ratio=0.03",
    )
    sets = [word for c in changed for word in ("--set", c)]
    assert main(["run", str(room_clip), "--out", str(out), "--quiet", *sets]) == 0
    assert (out / "gaussians.ply").read_bytes().startswith(b"ply")
    times = [float(line.split()[0]) for line in (room_clip / "rgb.txt").read_text().splitlines()[1:]]
    holdout = {f"{t:.6f}.png" for t in times[::HOLDOUT_EVERY]}
    assert {p.name for p in (out / "renders").iterdir()} == holdout
    for name in holdout:
        render = cv2.imread(str(out / "renders" / name))
        assert render.shape == (120, 160, 3) and render.std() > 5
    assert "<html" in (out / "report.html").read_text().lower()
    metrics = metrics_of(out)
    assert metrics["holdout_frames"] == len(holdout) and metrics["gaussians"] > 1000
    for key in (
        "frames", "frames_posed", "keyframes", "ate_rmse_all", "psnr_holdout", "psnr_holdout_static", "psnr_mapped",
        "ssim_holdout", "mask_iou", "mask_false_positive_ratio", "mask_moving_ratio", "fps_tracking", "fps_total",
        "peak_rss_mib", "focal_px", "psnr_holdout_white", "psnr_holdout_fitted", "opaque_holdout",
    ):  # fmt: skip
        assert isinstance(metrics[key], int | float) and np.isfinite(metrics[key]), key
    record = json.loads((out / "run.json").read_text())
    assert record["processor_s"].keys() == record["timings_s"].keys()
    assert 0 < metrics["core_s_per_frame_tracking"] < metrics["core_s_per_frame"]
    assert {p.name for p in (out / "alpha").iterdir()} == holdout and metrics["opaque_holdout"] > 0.5
    assert metrics["psnr_holdout"] > 12 and metrics["psnr_mapped"] > 12
    what_is_shown_of_a_map(out, holdout, tmp_path)
    scored = independent_score(out, room_clip)
    assert scored["frames"] == scored["posed"] == metrics["frames_posed"]
    assert scored["ate_all"] == pytest.approx(metrics["ate_rmse_all"], rel=1e-3)
    assert scored["psnr"] == pytest.approx(metrics["psnr_holdout"], rel=1e-3)
    assert scored["mask_fp"] == pytest.approx(metrics["mask_false_positive_ratio"], rel=1e-2, abs=1e-4)
    file_alone = independent_look(out, room_clip, 160)
    assert file_alone["psnr_black"] == pytest.approx(metrics["psnr_holdout_static"], abs=0.5)
    assert file_alone["psnr_white"] == pytest.approx(metrics["psnr_holdout_white"], abs=0.5)
    assert file_alone["opaque"] == pytest.approx(metrics["opaque_holdout"], abs=0.03) and file_alone["near"] < 0.02


@pytest.mark.usefixtures("short_flight")
def test_refined_poses_are_those_of_the_trajectory(room_clip: Path, tmp_path: Path) -> None:
    """Where training moves the cameras, every frame is placed in the map, and the file is judged from there."""
    out = tmp_path / "out"
    changed = ("mapping.iterations=60", "mapping.width_px=160", "mapping.refine_poses=true", "tracking.cell_px=5")
    sets = [word for c in changed for word in ("--set", c)]
    assert main(["run", str(room_clip), "--out", str(out), "--quiet", *sets]) == 0
    facts = json.loads((out / "run.json").read_text())
    frames = metrics_of(out)["frames"]
    assert facts["placement"]["frames"] == frames >= facts["placement"]["placed"]
    assert rows(out / "trajectory.txt").shape == (frames, 8) and metrics_of(out)["ate_rmse_all"] < 0.1


def what_is_shown_of_a_map(out: Path, holdout: set[str], tmp_path: Path) -> None:
    """Depth images, flight and .spz of the run folder, and the same again by ``mastd3r export``."""
    facts = json.loads((out / "run.json").read_text())["map"]
    assert facts["device"] == "cpu" and facts["near"] > 0
    assert main(["export", str(out), "--to", "depth", "--out", str(tmp_path / "depth")]) == 0
    assert {p.name for p in (out / "depth").iterdir()} == holdout
    assert len(list((tmp_path / "depth").glob("*.png"))) == metrics_of(out)["frames_tracked"]
    said = json.loads((tmp_path / "depth" / "export.json").read_text())
    assert said["depth_png_per_unit"] == facts["depth_png_per_unit"]
    name = sorted(holdout)[1]
    kept, again = (cv2.imread(str(f / name), cv2.IMREAD_UNCHANGED) for f in (out / "depth", tmp_path / "depth"))
    assert kept.dtype == np.uint16 and (kept > 0).mean() > 0.5
    both = (kept > 0) & (again > 0)
    assert np.abs(kept[both] / again[both] - 1).mean() < 0.05  # the run's has the training's pose corrections
    seen = kept[kept > 0] / facts["depth_png_per_unit"]
    assert 0.3 * facts["median_depth"] < np.median(seen) < 3 * facts["median_depth"]
    for kind, file in (("spz", "gaussians.spz"), ("flight", "flight.mp4")):
        assert main(["export", str(out), "--to", kind, "--out", str(tmp_path / file)]) == 0
        sizes = [(folder / file).stat().st_size for folder in (out, tmp_path)]
        assert sizes[1] == pytest.approx(sizes[0], rel=0.05) and sizes[0] > 2000
