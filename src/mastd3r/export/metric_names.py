"""How the figures of metrics.json are named and written for people."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

# key -> (what it is, number format, unit)
NAMES: dict[str, tuple[str, str, str]] = {
    "frames": ("Frames read", "d", ""),
    "frames_posed": ("Frames with a pose", "d", ""),
    "frames_tracked": ("Frames tracked", "d", ""),
    "frames_interpolated": ("Frames whose pose is interpolated", "d", ""),
    "frames_lost": ("Frames without a pose", "d", ""),
    "poses_not_finite": ("Rows of the trajectory that are no pose", "d", ""),
    "keyframes": ("Keyframes", "d", ""),
    "ate_rmse_all": ("ATE, all frames (RMSE after Sim(3))", ".4f", "m"),
    "ate_rmse_keyframes": ("ATE, keyframes", ".4f", "m"),
    "rpe_translation_frame": ("RPE a frame, translation", ".4f", "m"),
    "rpe_rotation_frame_deg": ("RPE a frame, rotation", ".3f", "deg"),
    "rpe_translation_metre": ("RPE a metre, translation", ".4f", "m/m"),
    "rpe_rotation_metre_deg": ("RPE a metre, rotation", ".3f", "deg/m"),
    "rpe_distance": ("RPE a metre: measured over", "g", "m"),
    "holdout_frames": ("Holdout frames", "d", ""),
    "psnr_holdout": ("PSNR of the file alone, over black, holdout frames", ".2f", "dB"),
    "psnr_holdout_static": ("PSNR of the file alone, holdout frames, static pixels", ".2f", "dB"),
    "psnr_holdout_white": ("PSNR of the file alone, over white (static pixels where known)", ".2f", "dB"),
    "psnr_holdout_fitted": ("PSNR after a gain and bias a view (static pixels where known)", ".2f", "dB"),
    "opaque_holdout": ("Opaque pixels, holdout frames (static where known)", ".2%", ""),
    "psnr_mapped": ("PSNR of the file alone, mapped frames", ".2f", "dB"),
    "ssim_holdout": ("SSIM, holdout frames", ".3f", ""),
    "ssim_holdout_static": ("SSIM, holdout frames, static pixels", ".3f", ""),
    "mask_iou": ("Mask IoU at P > 0.5", ".3f", ""),
    "mask_false_positive_ratio": ("Static pixels called moving", ".2%", ""),
    "mask_moving_ratio": ("Pixels called moving", ".2%", ""),
    "fps_tracking": ("Tracking speed", ".2f", "frames/s"),
    "fps_total": ("Speed of the whole run", ".2f", "frames/s"),
    "core_s_per_frame_tracking": ("Processor time of all threads a frame, tracking", ".3f", "s"),
    "core_s_per_frame": ("Processor time of all threads a frame, all stages", ".3f", "s"),
    "frames_came": ("Frames that came from the camera", "d", ""),
    "frames_dropped": ("Frames of those that were dropped", "d", ""),
    "frames_dropped_ratio": ("Share of frames dropped", ".2%", ""),
    "live_s": ("Live for", ".1f", "s"),
    "fps_camera": ("Speed of the camera", ".2f", "frames/s"),
    "fps_live": ("Speed of the live loop", ".2f", "frames/s"),
    "latency_ms_median": ("Latency of pose and mask, median", ".0f", "ms"),
    "latency_ms_95": ("Latency of pose and mask, 95 % of frames", ".0f", "ms"),
    "pose_latency_ms_median": ("Latency of the pose, median", ".0f", "ms"),
    "pose_latency_ms_95": ("Latency of the pose, 95 % of frames", ".0f", "ms"),
    "peak_rss_mib": ("Peak memory", ".0f", "MiB"),
    "peak_gpu_mib": ("Peak memory of the accelerator", ".0f", "MiB"),
    "focal_px": ("Focal length at full width", ".1f", "px"),
    "focal_sigma_ratio": ("Focal length, 1 sigma", ".1%", ""),
    "gaussians": ("Gaussians", ",d", ""),
    "cloud_accuracy_m": ("Cloud, accuracy: mean distance to the sensor's points", ".4f", "m"),
    "cloud_completeness_m": ("Cloud, completeness: mean distance of the sensor's points to it", ".4f", "m"),
    "cloud_accuracy_median_m": ("Cloud, accuracy, median", ".4f", "m"),
    "cloud_completeness_median_m": ("Cloud, completeness, median", ".4f", "m"),
    "cloud_accuracy_rmse_m": ("Cloud, accuracy, RMSE", ".4f", "m"),
    "cloud_completeness_rmse_m": ("Cloud, completeness, RMSE", ".4f", "m"),
    "cloud_recall_5cm": ("Cloud: the sensor's points within 5 cm of it", ".1%", ""),
    "cloud_f_score_5cm": ("Cloud, F-score at 5 cm", ".3f", ""),
    "cloud_accuracy_m_registered": ("Cloud registered by ICP, accuracy", ".4f", "m"),
    "cloud_completeness_m_registered": ("Cloud registered by ICP, completeness", ".4f", "m"),
    "cloud_accuracy_median_m_registered": ("Cloud registered by ICP, accuracy, median", ".4f", "m"),
    "cloud_completeness_median_m_registered": ("Cloud registered by ICP, completeness, median", ".4f", "m"),
    "cloud_accuracy_rmse_m_registered": ("Cloud registered by ICP, accuracy, RMSE", ".4f", "m"),
    "cloud_completeness_rmse_m_registered": ("Cloud registered by ICP, completeness, RMSE", ".4f", "m"),
    "cloud_recall_5cm_registered": ("Cloud registered by ICP: the sensor's points within 5 cm", ".1%", ""),
    "cloud_f_score_5cm_registered": ("Cloud registered by ICP, F-score at 5 cm", ".3f", ""),
    "cloud_registered_scale": ("Scale that the ICP finds beside the trajectory's", ".4f", ""),
    "cloud_judged_ratio": ("Cloud: points where the sensor looked", ".1%", ""),
    "cloud_mib": ("Size of cloud.ply", ".2f", "MiB"),
}


def described(key: str) -> str:
    """What a figure is, in words; an unknown key as it stands."""
    if key in NAMES:
        return NAMES[key][0]
    if key.endswith("_note"):
        return f"Why no {described(key.removesuffix('_note'))}"
    return key.replace("_", " ")


def in_order(metrics: Mapping[str, Any]) -> list[tuple[str, Any]]:
    """The figures in the order of NAMES; a note follows its figure, unknown keys come last as they stand."""
    order = {key: i for i, key in enumerate(NAMES)}
    return sorted(metrics.items(), key=lambda item: order.get(item[0].removesuffix("_note"), len(order)))


def shown(key: str, value: Any) -> str:
    """A figure with its unit; a dash where there is none."""
    if value is None:
        return "–"
    _, form, unit = NAMES.get(key, ("", "", ""))
    if isinstance(value, bool | str):
        return str(value)
    if not form:
        return f"{value:.4g}" if isinstance(value, float) else str(value)
    number = int(value) if form.endswith("d") else value
    return f"{number:{form}} {unit}".rstrip()


def summary_line(metrics: Mapping[str, Any]) -> str:
    """The run in one line. What moves is not in the splat: where truth tells what is static, PSNR is over that."""
    parts = []
    if metrics.get("frames"):
        if "frames_tracked" not in metrics:
            parts.append(f"{metrics.get('frames_posed', 0)} of {metrics['frames']} frames posed")
        else:
            others = [f"{metrics[f'frames_{s}']} {s}" for s in ("interpolated", "lost") if metrics[f"frames_{s}"]]
            rest = f" ({', '.join(others)})" if others else ""
            parts.append(f"{metrics['frames_tracked']} of {metrics['frames']} frames tracked{rest}")
    static = metrics.get("psnr_holdout_static") is not None
    psnr = {"psnr_holdout_static": "PSNR of what is static"} if static else {"psnr_holdout": "PSNR"}
    short = {"ate_rmse_all": "ATE"} | psnr | {"mask_iou": "mask IoU", "fps_total": "", "peak_rss_mib": ""}
    for key, name in short.items():
        if metrics.get(key) is not None:
            parts.append(f"{name} {shown(key, metrics[key])}".strip())
    return " · ".join(parts)
