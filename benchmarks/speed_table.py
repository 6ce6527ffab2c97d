"""The section of docs/results.md on speed, of the JSON that benchmarks/speed.py writes."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any


def speed(path: Path) -> list[str]:
    """Lines of Markdown; none where nothing was measured."""
    if not path.is_file():
        return []
    entries: dict[str, dict[str, Any]] = json.loads(path.read_text())
    out = ["", "## Speed", ""]
    out.append(
        f"By `python benchmarks/speed.py --data DATA --out {path.as_posix()}`: `mastd3r run SEQUENCE --no-map` from "
        "the start of its process to the end, reading, masks, cloud and report included; core s: processor time of "
        "all threads. The anchor is pycolmap on the same images, right after it on the same machine."
    )
    out += ["", "| sequence | frames | s a frame | core s a frame | tracking [frames/s] | tracking, core s a frame |"]
    out[-1] += " peak memory [MiB] | ATE all | keyframes | anchor, s a frame | times faster | date | commit |"
    out[-1] += " processor |"
    out.append("|---" * 14 + "|")
    for name, e in entries.items():
        ours, anchor, machine = e["ours"], e["anchor"], e["machine"]
        missing = "not measured" if "missing" in anchor else None
        cells = [
            name,
            ours["frames"],
            f"{ours['s_per_frame']:.3f}",
            f"{ours['core_s_per_frame_of_all']:.3f}",
            f"{ours['fps_tracking']:.1f}",
            f"{ours['core_s_per_frame_tracking']:.3f}",
            f"{ours['peak_rss_mib']:.0f}",
            f"{ours['ate_rmse_all']:.4f}",
            ours["keyframes"],
            missing or f"{anchor['s_per_frame']:.3f} ({anchor['posed']} posed in {anchor['models']} models)",
            "–" if e["ratio"] is None else f"{e['ratio']:.1f}",
            e["date"][:10],
            machine["git_commit"],
            f"{machine['processor']}, {machine['cores']} cores",
        ]
        out.append("| " + " | ".join(map(str, cells)) + " |")
    return out
