"""The tables of benchmarks/masks.py, for docs/results.md."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any


def masks(path: Path) -> list[str]:
    """Ablation, false positives, cost, and what masks do for the pose; nothing where the file is not there."""
    if not path.is_file():
        return []
    found: dict[str, dict[str, dict[str, Any]]] = json.loads(path.read_text())
    out = ["", "## Masks", ""]
    out += [f"By `python benchmarks/masks.py --data DATA --out {path.as_posix()}`. IoU at P > 0.5, mean over frames in"]
    ends = [v["frames"] for e in found.get("ablation", {}).values() for v in e.values() if "frames" in v]
    most = max((last - first for first, last in ends), default=0)
    out += ["which at least 1 % of the pixels move; in brackets, pixels called moving that are not. Variants are"]
    out += [f"compared on {most} frames in the middle of each sequence. Commits and dates are in the file."]
    return [*out, *_ablation(found.get("ablation", {})), *_static(found.get("static", {})), *_poses(found)]


def _ablation(entries: dict[str, dict[str, Any]]) -> list[str]:
    if not entries:
        return []
    variants = list(dict.fromkeys(v for e in entries.values() for v in e if isinstance(e[v], dict)))
    out = ["", "| variant | " + " | ".join(entries) + " |", "|---" * (len(entries) + 1) + "|"]
    for variant in variants:
        out.append(f"| {variant} | " + " | ".join(_iou(e.get(variant)) for e in entries.values()) + " |")
    return out


def _iou(figures: dict[str, Any] | None) -> str:
    if figures is None or figures["iou"] is None:
        return "–"
    return f"{figures['iou']:.3f} ({figures['false_positives']:.3f})"


def _static(entries: dict[str, dict[str, Any]]) -> list[str]:
    if not entries:
        return []
    out = ["", "| sequence, no semantics | share called moving |", "|---|---|"]
    return out + [f"| {name} | {e['moving']:.4f} |" for name, e in entries.items()]


def _poses(found: dict[str, dict[str, dict[str, Any]]]) -> list[str]:
    out: list[str] = []
    for name, e in found.get("cost", {}).items():
        out += ["", f"Cost in {name}: tracking with masks takes {1e3 * e['frame_s']['with']:.0f} ms a frame, without"]
        out[-1] += f" {1e3 * e['frame_s']['without']:.0f} ms: {e['share']:.0%} of it, and {e['share_cpu']:.0%} of the"
        out[-1] += f" processor's time ({e['git_commit']}, {e['processor']}, {e['cores']} cores)."
    groups: dict[str, list[dict[str, Any]]] = {}
    for part in ("twin", "off", "perfect"):
        for name, e in found.get(part, {}).items():
            groups.setdefault(name.split(", start")[0], []).append(e)
    if groups:
        out += ["", "Poses of tracking and the joint optimisation, before the final masks weigh the matches of frames:"]
        out += ["", "| kitchen_walk | ATE all [m], mean over starts (least–most) | starts |", "|---|---|---|"]
    for name, entries in groups.items():
        ate = [e["ate_rmse_all"] for e in entries]
        spread = f" ({min(ate):.4f}–{max(ate):.4f})" if len(ate) > 1 else ""
        out.append(f"| {name} | {sum(ate) / len(ate):.4f}{spread} | {len(ate)} |")
    return out
