"""Figures of a run folder, from its files alone: trajectory.txt, keyframes.txt, cloud.ply, masks/ and renders/."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from ..errors import InputError
from ..reading.files import exists, is_file, whole_bytes, whole_text
from ..reading.pictures import decoded
from ..types import Frame, State, Trajectory, Truth
from .image_error import psnr, ssim
from .mask_error import MaskError, TrueMasks, mask_error, read_mask
from .trajectory_error import AteResult, associate, ate_of_positions, ate_rmse, drift_distance, rpe, rpe_over_distance

Array = NDArray[Any]
PSNR_CEILING_DB = float(10 * np.log10(255**2 / 1e-9))  # stands for equal images, so that a mean exists
SAME_TIME_S = 0.001  # other systems round timestamps in ways of their own
OPAQUE = 0.95  # alpha above which nothing is seen through
FARTHEST, SHORTEST = 1e9, 1e-6  # of positions and quaternions in a file; others are no pose
MIN_STATIC_PX = 50  # fewer static pixels in a render say nothing


@dataclass(frozen=True)
class HoldoutError:
    """One render against the photograph that the map has never seen."""

    timestamp_s: float
    psnr_db: float
    ssim: float
    psnr_static_db: float | None  # over truly static pixels; None where truth has no masks
    ssim_static: float | None = None  # likewise
    white_db: float | None = None  # PSNR over white instead of black, the same pixels as the static one where it is
    fitted_db: float | None = None  # over black, after the best gain and bias a channel
    opaque: float | None = None  # share of those pixels with alpha above 0.95


@dataclass(frozen=True)
class Evaluation:
    """The flat figures, and what plots and pictures are made of."""

    metrics: dict[str, Any]
    ate: AteResult | None  # over all frames; None without truth
    holdout: tuple[HoldoutError, ...]


def evaluate_run(
    run_dir: Path, truth: Truth | None, frames: Iterable[Frame], timestamps_s: Array | None = None
) -> dict[str, Any]:
    """The flat metrics of a run folder; ``evaluate`` with its arguments and errors."""
    return evaluate(run_dir, truth, frames, timestamps_s).metrics


def evaluate(
    run_dir: Path, truth: Truth | None, frames: Iterable[Frame], timestamps_s: Array | None = None
) -> Evaluation:
    """Score the files of a run folder against a sequence, in one pass over its frames.

    ``frames`` gives the photographs, full size, in order; those with a file in renders/ are compared.
    ``timestamps_s`` (n,) are the times of the whole sequence where ``frames`` gives fewer. Figures that need
    truth are absent without it; a figure that truth cannot give is None and ``*_note`` says why.
    Raises InputError for a missing or malformed file and for renders of another sequence.
    """
    trajectory = read_poses(run_dir / "trajectory.txt")
    times, positions = trajectory.timestamps_s, trajectory.world_from_cam[:, :3, 3]
    moving = TrueMasks({_stamp(t): path for t, path in truth.moving_files.items()} if truth else {})
    renders = {p.stem: p for p in (run_dir / "renders").glob("*.png")}
    stamps = [] if timestamps_s is None else [_stamp(float(t)) for t in timestamps_s]
    holdout: list[HoldoutError] = []
    if renders or timestamps_s is None:  # else no photograph is asked for
        seen, holdout = _compare_renders(run_dir, renders, frames, moving)
        stamps = stamps or seen
    posed = {_stamp(float(t)) for t in times[np.isfinite(positions).all(1)]}
    metrics: dict[str, Any] = {"frames": len(stamps), "frames_posed": sum(s in posed for s in stamps)}
    ate = None
    if truth is not None and len(truth.timestamps_s):
        ate = _add_trajectory_error(metrics, trajectory, truth)
        _add_keyframe_error(metrics, run_dir, truth)
    _add_holdout(metrics, holdout)
    if is_file(run_dir / "cloud.ply"):
        metrics["cloud_mib"] = (run_dir / "cloud.ply").stat().st_size / 2**20
    _add_masks(metrics, _masks(run_dir, stamps, moving), has_truth=bool(moving))
    moving.tell()
    return Evaluation(metrics, ate, tuple(holdout))


def evaluate_trajectory(trajectory: Trajectory, truth: Truth | None, timestamps_s: Array) -> Evaluation:
    """Score poses alone, such as another system's, against a sequence whose frames have the times (n,).

    The same figures by the same code as those of ``evaluate``, over the poses that are finite; the others are counted.
    Raises InputError where truth has no poses, and where no pose has the time of a frame.
    """
    if truth is None or not len(truth.timestamps_s):
        raise InputError("expected a sequence with true poses, got one without")
    finite = np.isfinite(trajectory.world_from_cam).all((1, 2)) & np.isfinite(trajectory.timestamps_s)
    found = trajectory.rows(np.flatnonzero(finite))
    posed, _ = associate(timestamps_s, found.timestamps_s, SAME_TIME_S)
    if not len(posed):
        raise InputError(_why_no_time(timestamps_s, found.timestamps_s))
    metrics: dict[str, Any] = {"frames": len(timestamps_s), "frames_posed": len(posed)}
    if not finite.all():
        metrics["poses_not_finite"] = int((~finite).sum())
    return Evaluation(metrics, _add_trajectory_error(metrics, found, truth), ())


def _why_no_time(frames_s: Array, poses_s: Array) -> str:
    """What to say of poses none of which is at a frame's time."""
    wanted = f"expected poses at the times of the frames, {frames_s.min():.6f} to {frames_s.max():.6f} s"
    if not len(poses_s):
        return f"{wanted}, got none that are finite"
    got = f"{wanted}, got {poses_s.min():.6f} to {poses_s.max():.6f}"
    for name, unit in (("nanoseconds", 1e9), ("microseconds", 1e6), ("milliseconds", 1e3)):
        if len(associate(frames_s, poses_s / unit, 10 * SAME_TIME_S)[0]):
            return f"{got}: these look like {name}"
    return got


def read_positions(path: Path) -> tuple[Array, Array]:
    """Times (n,) and positions (n, 3) of a TUM trajectory file, in order of time. Raises InputError."""
    trajectory = read_poses(path)
    return trajectory.timestamps_s, trajectory.world_from_cam[:, :3, 3]


def read_poses(path: Path) -> Trajectory:
    """Every row of a TUM trajectory file, in order of time. Raises InputError."""
    lines = whole_text(path, "a readable trajectory file").splitlines()
    rows: list[list[float]] = []
    for number, line in enumerate(lines, 1):
        if not line.strip() or line.startswith("#"):
            continue
        words = line.split()
        try:
            rows.append([float(w) for w in words])
        except ValueError as e:
            raise InputError(f"{path} line {number}: expected numbers, got {line[:60]!r}") from e
        if len(words) != 8:
            raise InputError(f"{path} line {number}: expected 8 numbers, got {len(words)}")
        if not any(rows[-1][4:]):
            raise InputError(f"{path} line {number}: expected a quaternion, got one of length 0")
    data = np.array(rows, float).reshape(-1, 8)
    data = data[np.argsort(data[:, 0], kind="stable")]
    poses = np.tile(np.eye(4), (len(data), 1, 1))
    poses[:, :3, 3] = data[:, 1:4]
    known = np.isfinite(data).all(1) & (np.abs(data[:, 1:]) < FARTHEST).all(1) & (np.abs(data[:, 4:]).max(1) > SHORTEST)
    poses[known, :3, :3] = Rotation.from_quat(data[known, 4:]).as_matrix()
    poses[~known, :3] = np.nan
    tracked: State = "tracked"
    return Trajectory(data[:, 0], poses, (tracked,) * len(data), np.zeros(len(data), bool))


def _stamp(timestamp_s: float) -> str:
    """A timestamp as the run folder's file names write it."""
    return f"{timestamp_s:.6f}"


def _add_trajectory_error(metrics: dict[str, Any], trajectory: Trajectory, truth: Truth) -> AteResult:
    """ATE over all poses; RPE from each pose to the next, and over a distance, as drift a metre."""
    ate = ate_rmse(trajectory, truth)
    metrics["ate_rmse_all"] = ate.rmse
    if ate.reason:
        metrics["ate_rmse_all_note"] = ate.reason
        return ate
    step = rpe(trajectory, truth)
    metrics["rpe_translation_frame"] = step.translation_rmse
    metrics["rpe_rotation_frame_deg"] = _degrees(step.rotation_rmse_rad)
    distance = drift_distance(trajectory, truth)
    drift = rpe_over_distance(trajectory, truth, distance)
    metrics["rpe_translation_metre"] = None if drift.translation_rmse is None else drift.translation_rmse / distance
    metrics["rpe_rotation_metre_deg"] = _degrees(drift.rotation_rmse_rad, distance)
    if drift.reason:
        metrics["rpe_translation_metre_note"] = drift.reason
    else:
        metrics["rpe_distance"] = distance
    return ate


def _degrees(angle_rad: float | None, over: float = 1.0) -> float | None:
    return None if angle_rad is None else float(np.degrees(angle_rad)) / over


def _add_keyframe_error(metrics: dict[str, Any], run_dir: Path, truth: Truth) -> None:
    if not exists(run_dir / "keyframes.txt"):
        return
    times, positions = read_positions(run_dir / "keyframes.txt")
    kf = ate_of_positions(times, positions, truth.timestamps_s, truth.world_from_cam[:, :3, 3])
    metrics["ate_rmse_keyframes"] = kf.rmse
    if kf.reason:
        metrics["ate_rmse_keyframes_note"] = kf.reason


def _compare_renders(
    run_dir: Path, renders: dict[str, Path], frames: Iterable[Frame], moving: TrueMasks
) -> tuple[list[str], list[HoldoutError]]:
    """One pass over the frames: all their stamps, and the errors of those that have a render."""
    seen: list[str] = []
    holdout: list[HoldoutError] = []
    for frame in frames:
        stamp = _stamp(frame.timestamp_s)
        seen.append(stamp)
        if stamp in renders:
            truth = moving.read(stamp)
            holdout.append(
                _compare(frame, renders[stamp], truth, has_masks=bool(moving) and stamp not in moving.broken)
            )
    if renders and not holdout:
        raise InputError(
            f"{run_dir}/renders: expected timestamps of the sequence given, got {min(renders)} and others "
            f"of which none is among its {len(seen)} frames"
        )
    return seen, holdout


def _compare(frame: Frame, render_path: Path, moving: Array | None, has_masks: bool) -> HoldoutError:
    """A render of the file alone, over black, with the photograph; over white by alpha/ where that is."""
    render = decoded(whole_bytes(render_path, "a PNG image"), render_path, cv2.IMREAD_COLOR)
    size = (render.shape[1], render.shape[0])
    photograph = np.asarray(cv2.resize(frame.image, size, interpolation=cv2.INTER_AREA)) / 255
    splat = np.asarray(render)[..., ::-1] / 255
    whole, similar = psnr(splat, photograph), ssim(splat, photograph)
    if whole is None or similar is None:
        raise InputError(f"{render_path}: expected an image of some size, got {size}")
    static_db, static_similar = None, None
    if has_masks:
        static = np.ones(size[::-1], bool)
        if moving is not None:
            static = np.asarray(cv2.resize(moving, size, interpolation=cv2.INTER_NEAREST)) <= 127
        if static.sum() > MIN_STATIC_PX:
            static_db, static_similar = psnr(splat, photograph, static), ssim(splat, photograph, static)
    capped = None if static_db is None else min(static_db, PSNR_CEILING_DB)
    use = static if static_db is not None else np.ones(size[::-1], bool)
    fitted = psnr(_exposed(splat, photograph, use), photograph, use)
    alpha_path = render_path.parent.parent / "alpha" / render_path.name
    white = opaque = None
    if is_file(alpha_path) and (alpha := read_mask(alpha_path) / 255).shape == use.shape:
        white, opaque = psnr(splat + (1 - alpha)[..., None], photograph, use), float((alpha[use] > OPAQUE).mean())
    return HoldoutError(
        frame.timestamp_s, min(whole, PSNR_CEILING_DB), similar, capped, static_similar, white, fitted, opaque
    )


def _exposed(splat: Array, photograph: Array, use: Array) -> Array:
    """The render under the gain and bias of every channel that bring it closest to the photograph where ``use`` is."""
    out = np.empty_like(splat)
    for c in range(3):
        a, b = splat[use][:, c], photograph[use][:, c]
        gain = ((a - a.mean()) * (b - b.mean())).mean() / max(float(a.var()), 1e-9)
        out[..., c] = np.clip(gain * (splat[..., c] - a.mean()) + b.mean(), 0, 1)
    return out


def _add_holdout(metrics: dict[str, Any], holdout: list[HoldoutError]) -> None:
    if not holdout:
        return
    metrics["holdout_frames"] = len(holdout)
    metrics["psnr_holdout"] = float(np.mean([h.psnr_db for h in holdout]))
    metrics["ssim_holdout"] = float(np.mean([h.ssim for h in holdout]))
    where_known = {
        "psnr_holdout_static": [h.psnr_static_db for h in holdout],
        "ssim_holdout_static": [h.ssim_static for h in holdout],
        "psnr_holdout_white": [h.white_db for h in holdout],
        "psnr_holdout_fitted": [h.fitted_db for h in holdout],
        "opaque_holdout": [h.opaque for h in holdout],
    }
    for key, values in where_known.items():
        known = [v for v in values if v is not None]
        if known:
            metrics[key] = float(np.mean(known))


def _masks(run_dir: Path, stamps: list[str], moving: TrueMasks) -> MaskError:
    present = {p.stem for p in (run_dir / "masks").glob("*.png")}
    pairs = ((read_mask(run_dir / "masks" / f"{s}.png"), moving.read(s), s) for s in stamps if s in present)
    return mask_error((mask, true) for mask, true, s in pairs if s not in moving.broken)


def _add_masks(metrics: dict[str, Any], masks: MaskError, has_truth: bool) -> None:
    """Without true masks nobody knows what moves: then only the share called moving is a figure."""
    if not masks.n_frames:
        return
    metrics["mask_moving_ratio"] = masks.called_moving_ratio
    if has_truth:
        metrics["mask_iou"] = masks.iou
        metrics["mask_false_positive_ratio"] = masks.false_positive_ratio
