"""The map's sections of docs/results.md, from the JSON of map_losses.py, loop_correction.py and bench_gpu_map.py."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np

LOSSES = ("plain", "mask", "uncertainty", "full")


def map_sections(folder: Path) -> list[str]:
    """Lines of all sections whose JSON is in ``folder``."""
    makers = {
        "map_losses.json": losses,
        "loop_correction.json": loop_correction,
        "gpu_map.json": gpu_map,
    }
    return [line for name, make in makers.items() if (folder / name).is_file() for line in make(folder / name)]


def losses(path: Path) -> list[str]:
    """Table V, and the ablation of the default."""
    data: dict[str, Any] = json.loads(path.read_text())
    s, rows = data["schedule"], data["rows"]
    out = ["", "## The map's losses (Table V)", ""]
    out.append(
        f"{s['sequence']}, tracked once, renders of the holdout frames against the CLEAN frames of {s['clean']}: whole "
        f"image, and only the pixels that a person hides. A schedule of {s['iterations']} steps and "
        f"{s['max_gaussians']:,} Gaussians, shorter than the default. Mean and range over the seeds. By "
        f"`python benchmarks/map_losses.py --data DATA --out {path.as_posix()} --iterations {s['iterations']} "
        f"--gaussians {s['max_gaussians']}`."
    )
    out += ["", "| loss | seeds | PSNR whole [dB] | PSNR hidden [dB] | SSIM whole | commit |", "|---" * 6 + "|"]
    for loss in LOSSES:
        found = [row for name, row in rows.items() if name.startswith(f"{loss}, seed")]
        if found:
            spread = [_spread([r[key] for r in found]) for key in ("psnr_whole", "psnr_hidden")]
            similar, commits = np.mean([r["ssim_whole"] for r in found]), sorted({str(r["git_commit"]) for r in found})
            out.append(f"| {loss} | {len(found)} | {spread[0]} | {spread[1]} | {similar:.3f} | {', '.join(commits)} |")
    parts = {name.removeprefix("ablation: "): row for name, row in rows.items() if name.startswith("ablation: ")}
    if parts:
        out += ["", "What each part of the default is worth, same schedule, one seed:", ""]
        out += ["| map | PSNR whole [dB] | PSNR hidden [dB] | SSIM whole |", "|---" * 4 + "|"]
        for name, r in parts.items():
            figures = f"{r['psnr_whole']:.2f} | {r['psnr_hidden']:.2f} | {r['ssim_whole']:.3f}"
            out.append(f"| {name} | {figures} |")
    return out


def loop_correction(path: Path) -> list[str]:
    """Before, after, and left behind."""
    e: dict[str, Any] = json.loads(path.read_text())
    out = ["", "## A loop correction under a trained map", ""]
    out.append(
        f"{e['sequence']}, {e['keyframes']} keyframes bent by up to {100 * e['moved_m']:.0f} cm, map trained for "
        f"{e['iterations']} steps of {e['max_gaussians']:,} Gaussians, then every keyframe put right (simulated) "
        f"in {e['correction_s']:.1f} s. "
        f"By `python benchmarks/loop_correction.py --data DATA --out {path.as_posix()} --iterations {e['iterations']} "
        f"--gaussians {e['max_gaussians']}`, commit {e['git_commit']}. Bound right after it: {e['bound_db']} dB below "
        f"before, {'held' if e['holds'] else 'not held'}."
    )
    out += ["", "| holdout PSNR | dB |", "|---|---|", f"| before the correction | {e['before_db']:.2f} |"]
    out.append(f"| right after it | {e['after_db']:.2f} |")
    out += [f"| {steps} steps later | {figure:.2f} |" for steps, figure in e["refined_db"].items()]
    if "after_tracked_db" in e:
        out.append(f"| before, from tracked poses without the map's corrections | {e['before_tracked_db']:.2f} |")
        out.append(f"| right after, from tracked poses without them | {e['after_tracked_db']:.2f} |")
    out.append(f"| right after it, every Gaussian with its anchor alone | {e['anchors_only_db']:.2f} |")
    out.append(f"| corrected poses, map left behind | {e['map_left_behind_db']:.2f} |")
    return out


def gpu_map(path: Path) -> list[str]:
    """The two backends on one machine."""
    e: dict[str, Any] = json.loads(path.read_text())
    out = ["", "## The map on an accelerator", ""]
    out.append(
        f"{e['device'] or 'no accelerator'} and {e['machine']['cores']} cores of {e['machine']['processor']}, torch "
        f"{e['packages']['torch']}, gsplat {e['packages']['gsplat']}, map of `{e['run']}`, {e['date']}. "
        f"By `python benchmarks/bench_gpu_map.py RUN --out {path.as_posix()}`."
    )
    near = e.get("agreement", {})
    if "color_mean_worst_view" in near:
        out += [
            "",
            f"{near['views']} holdout views of {near['gaussians']:,} Gaussians drawn by both, mean difference: ",
        ]
        out[-1] += f"colour {near['color_mean']:.1e} (worst view {near['color_mean_worst_view']:.1e}, bound "
        out[-1] += f"{near['bound']:.0e}), depth {near['depth_ratio_mean']:.1e} of its median, "
        out[-1] += f"alpha {near['alpha_mean']:.1e}."
    devices = [k.removeprefix("mapping_") for k in e if k.startswith("mapping_")]
    out += ["", "| | " + " | ".join(devices) + " |", "|---" * (len(devices) + 1) + "|"]
    rows = {
        "training, steps/s": ("mapping_{}", "steps_per_s", ".1f"),
        "holdout PSNR after those steps [dB]": ("mapping_{}", "psnr_end_db", ".2f"),
        "forward + backward over the map [ms]": ("map_pass_{}", "forward_backward_ms", ".2f"),
        "worst relative gradient error": ("gradients_{}", "worst", ".1e"),
        "peak memory on the device [MiB]": ("mapping_{}", "peak_allocated_mib", ".0f"),
    }
    for title, (part, key, form) in rows.items():
        values = [e.get(part.format(d), {}).get(key) for d in devices]
        out.append(f"| {title} | " + " | ".join("–" if v is None else format(v, form) for v in values) + " |")
    out += ["", *(f"- {k} failed: {v['error']}" for k, v in e.items() if isinstance(v, dict) and "error" in v)]
    return out


def _spread(values: list[float]) -> str:
    return f"{np.mean(values):.2f} ({min(values):.2f} to {max(values):.2f})"
