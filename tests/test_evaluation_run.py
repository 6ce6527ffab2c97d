"""A run folder's figures: held to the independent scorer where it is present, and to what was put in."""

from __future__ import annotations

import json
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from mastd3r.errors import InputError
from mastd3r.evaluation.evaluate import PSNR_CEILING_DB, evaluate, evaluate_run, read_positions
from mastd3r.export.run_folder import RunFolder
from mastd3r.export.trajectory_files import write_tum
from mastd3r.types import Frame, Trajectory, Truth

SCORER = Path(__file__).parents[1] / "../shared/tools/score.py"
N = 24


@dataclass
class Sequence:
    """A small sequence on disk in TUM layout, and the same in memory."""

    path: Path
    images: list[np.ndarray]
    times_s: np.ndarray
    truth: Truth

    def frames(self) -> Iterator[Frame]:
        for i, image in enumerate(self.images):
            yield Frame(i, float(self.times_s[i]), image)


def make_sequence(path: Path) -> Sequence:
    """Smooth random pictures, a random walk, and a square that moves over the frames 4 to 19."""
    rng = np.random.default_rng(0)
    for name in ("rgb", "mask"):
        (path / name).mkdir(parents=True)
    times = 5 + np.arange(N) / 30
    poses = np.tile(np.eye(4), (N, 1, 1))
    poses[:, :3, 3] = rng.normal(0, 0.1, (N, 3)).cumsum(0)
    poses[:, :3, :3] = Rotation.from_rotvec(rng.normal(0, 0.1, (N, 3))).as_matrix()
    images, moving, listing = [], {}, []
    for i, t in enumerate(times):
        image = (255 * cv2.GaussianBlur(rng.random((96, 128, 3)), (0, 0), 3)).astype(np.uint8)
        cv2.imwrite(str(path / "rgb" / f"{t:.6f}.png"), image[..., ::-1])
        listing.append(f"{t:.6f} rgb/{t:.6f}.png\n")
        if 4 <= i < 20:
            mask = np.zeros((96, 128), np.uint8)
            mask[20:60, 4 * i : 4 * i + 30] = 255
            moving[float(t)] = str(path / "mask" / f"{t:.6f}.png")
            cv2.imwrite(moving[float(t)], mask)
        images.append(image)
    (path / "rgb.txt").write_text("# timestamp filename\n" + "".join(listing))
    walk = Trajectory(times, poses, ("tracked",) * N, np.zeros(N, bool))
    write_tum(path / "groundtruth.txt", walk)
    return Sequence(path, images, times, Truth(times, poses, moving))


def make_run(path: Path, sequence: Sequence) -> RunFolder:
    """A plausible run: noisy scaled poses but for two frames, soft masks at half size, blurred renders."""
    rng = np.random.default_rng(1)
    folder = RunFolder(path)
    poses = sequence.truth.world_from_cam.copy()
    poses[:, :3, 3] = 0.3 * poses[:, :3, 3] + rng.normal(0, 0.005, (N, 3)) + 7
    poses[[3, 4]] = np.nan
    states = ("tracked",) * 3 + ("lost",) * 2 + ("tracked",) * (N - 5)
    folder.write_trajectory(Trajectory(sequence.times_s, poses, states, np.arange(N) % 3 == 0))
    for i, t in enumerate(sequence.times_s):
        probability = cv2.GaussianBlur(rng.random((48, 64)), (0, 0), 2) * 0.9
        if 4 <= i < 20:
            probability[12:30, 2 * i : 2 * i + 14] = 0.9
        folder.write_mask(float(t), probability)
        if i % 4 == 0:
            small = cv2.resize(sequence.images[i], (80, 60), interpolation=cv2.INTER_AREA)
            folder.write_render(float(t), np.clip(small / 255 + rng.normal(0, 0.05, small.shape), 0, 1))
    return folder


@pytest.fixture
def sequence(tmp_path: Path) -> Sequence:
    return make_sequence(tmp_path / "sequence")


@pytest.fixture
def run(tmp_path: Path, sequence: Sequence) -> RunFolder:
    return make_run(tmp_path / "run", sequence)


def test_agrees_with_the_independent_scorer(run: RunFolder, sequence: Sequence) -> None:
    if not SCORER.exists():
        pytest.skip(f"no scorer at {SCORER}")
    ours = evaluate_run(run.path, sequence.truth, sequence.frames())
    command = [sys.executable, str(SCORER), str(run.path), str(sequence.path)]
    theirs = json.loads(subprocess.run(command, check=True, capture_output=True, text=True).stdout)
    same = {
        "frames": "frames",
        "frames_posed": "posed",
        "ate_rmse_all": "ate_all",
        "ate_rmse_keyframes": "ate_keyframes",
        "mask_iou": "mask_iou",
        "mask_false_positive_ratio": "mask_fp",
        "psnr_holdout": "psnr",
        "holdout_frames": "renders",
    }
    assert {k: ours[k] for k in same} == pytest.approx({k: theirs[v] for k, v in same.items()}, rel=1e-7)
    assert ours["frames_posed"] == N - 2
    assert 0 < ours["mask_iou"] < 1
    assert ours["mask_false_positive_ratio"] > 0


def test_without_truth_only_what_can_be_known(run: RunFolder, sequence: Sequence) -> None:
    metrics = evaluate_run(run.path, None, sequence.frames())
    assert set(metrics) == {
        "frames", "frames_posed", "holdout_frames", "psnr_holdout", "ssim_holdout", "psnr_holdout_fitted",
        "mask_moving_ratio",
    }  # fmt: skip


def test_a_see_through_render_is_told_apart_from_an_opaque_one(run: RunFolder, sequence: Sequence) -> None:
    """Half of the pixels let through 30 %: over black that is darker, over white lighter, and the share is said."""
    for old in (run.path / "renders").glob("*.png"):
        old.unlink()
    i = 8
    t, image = float(sequence.times_s[i]), sequence.images[i] / 255
    alpha = np.ones(image.shape[:2])
    alpha[:, : image.shape[1] // 2] = 0.7
    run.write_render(t, image * alpha[..., None])
    run.write_alpha(t, alpha)
    truth = Truth(sequence.truth.timestamps_s, sequence.truth.world_from_cam)
    metrics = evaluate_run(run.path, truth, sequence.frames())
    black, white = (-10 * np.log10(((image * alpha[..., None] + b * (1 - alpha[..., None]) - image) ** 2).mean())
                    for b in (0.0, 1.0))  # fmt: skip
    assert metrics["psnr_holdout"] == pytest.approx(black, abs=0.3)
    assert metrics["psnr_holdout_white"] == pytest.approx(white, abs=0.3)
    assert metrics["opaque_holdout"] == pytest.approx(0.5)


def test_a_gain_and_a_bias_are_fitted_beside(run: RunFolder, sequence: Sequence) -> None:
    for old in (run.path / "renders").glob("*.png"):
        old.unlink()
    t, image = float(sequence.times_s[8]), sequence.images[8] / 255
    run.write_render(t, 0.7 * image + 0.1)
    metrics = evaluate_run(run.path, None, sequence.frames())
    assert metrics["psnr_holdout_fitted"] > max(35, metrics["psnr_holdout"] + 10)


def test_truth_without_masks_does_not_call_anything_a_false_positive(run: RunFolder, sequence: Sequence) -> None:
    truth = Truth(sequence.truth.timestamps_s, sequence.truth.world_from_cam)
    metrics = evaluate_run(run.path, truth, sequence.frames())
    assert "mask_iou" not in metrics
    assert "mask_false_positive_ratio" not in metrics
    assert "psnr_holdout_static" not in metrics
    assert metrics["mask_moving_ratio"] > 0


def test_static_psnr_ignores_what_moved(run: RunFolder, sequence: Sequence) -> None:
    """The moving square painted away in a render: only the whole-image figure falls."""
    i = 8
    t = float(sequence.times_s[i])
    render = sequence.images[i].copy()
    moving = cv2.imread(sequence.truth.moving_files[t], 0) > 127
    render[moving] = 255 - render[moving]
    for old in (run.path / "renders").glob("*.png"):
        old.unlink()
    run.write_render(t, render)
    result = evaluate(run.path, sequence.truth, sequence.frames())
    assert result.metrics["psnr_holdout_static"] == pytest.approx(PSNR_CEILING_DB)
    assert result.metrics["psnr_holdout"] < 40
    assert [h.timestamp_s for h in result.holdout] == [t]


def test_holdout_photographs_alone_are_enough(run: RunFolder, sequence: Sequence) -> None:
    few = (f for f in sequence.frames() if f.index % 4 == 0)
    assert evaluate_run(run.path, sequence.truth, few, sequence.times_s) == evaluate_run(
        run.path, sequence.truth, sequence.frames()
    )


def test_a_camera_that_never_moved_is_a_note_not_a_crash(run: RunFolder, sequence: Sequence) -> None:
    still = np.tile(np.eye(4), (N, 1, 1))
    run.write_trajectory(Trajectory(sequence.times_s, still, ("tracked",) * N, np.arange(N) % 3 == 0))
    metrics = evaluate_run(run.path, sequence.truth, sequence.frames())
    assert metrics["ate_rmse_all"] is None
    assert "never moves" in metrics["ate_rmse_all_note"]
    assert "never moves" in metrics["ate_rmse_keyframes_note"]


def test_the_wrong_sequence_is_refused(run: RunFolder, sequence: Sequence) -> None:
    others = (Frame(f.index, f.timestamp_s + 100, f.image) for f in sequence.frames())
    with pytest.raises(InputError, match="of which none is among its 24 frames"):
        evaluate_run(run.path, sequence.truth, others)


@pytest.mark.parametrize(
    ("content", "says"),
    [
        (None, "readable"),
        ("1.0 2 3 four 0 0 0 1\n", "line 1"),
        ("# ok\n1.0 2 3\n", "line 2: expected 8 numbers"),
    ],
)
def test_bad_trajectory_files_are_named(tmp_path: Path, content: str | None, says: str) -> None:
    path = tmp_path / "trajectory.txt"
    if content is not None:
        path.write_text(content)
    with pytest.raises(InputError, match=says):
        read_positions(path)


def test_a_broken_render_is_named(run: RunFolder, sequence: Sequence) -> None:
    path = min((run.path / "renders").glob("*.png"))
    path.write_bytes(path.read_bytes()[:40])
    with pytest.raises(InputError, match=path.name):
        evaluate_run(run.path, sequence.truth, sequence.frames())


def test_a_run_that_wrote_no_pictures_is_scored(tmp_path: Path, sequence: Sequence) -> None:
    path = tmp_path / "bare"
    path.mkdir()
    (path / "trajectory.txt").write_text("")
    metrics = evaluate_run(path, sequence.truth, sequence.frames())
    assert (metrics["frames"], metrics["frames_posed"], metrics["ate_rmse_all"]) == (N, 0, None)
    assert "got 0" in metrics["ate_rmse_all_note"]


def test_without_renders_no_photograph_is_read(run: RunFolder, sequence: Sequence) -> None:
    for old in (run.path / "renders").glob("*.png"):
        old.unlink()

    def refused() -> Iterator[Frame]:
        raise AssertionError("a photograph was asked for")
        yield  # a generator

    whole = evaluate_run(run.path, sequence.truth, sequence.frames())
    assert evaluate_run(run.path, sequence.truth, refused(), sequence.times_s) == whole
