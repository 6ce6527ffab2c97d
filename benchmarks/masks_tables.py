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
    out += ["which at least 1 % of the pixels move; in brackets, pixels called moving that are not. Variants are"]
    out += ["compared on 48 frames in the middle of each sequence. Commits and dates are in the file."]
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
        out += ["", f"Cost in {name}: {e['share']:.1%} of the time of tracking, measured in one process."]
    rows = [(n, e) for part in ("twin", "perfect", "off") for n, e in found.get(part, {}).items()]
    if rows:
        out += ["", "| kitchen_walk | ATE all [m] | posed |", "|---|---|---|"]
    for name, e in rows:
        label = "the true masks given" if name == "kitchen_walk" else name
        ate = "–" if e["ate_rmse_all"] is None else f"{e['ate_rmse_all']:.4f}"
        out.append(f"| {label} | {ate} | {e['frames_posed']} |")
    return out
