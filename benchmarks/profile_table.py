"""The tables of docs/results.md that say where the time goes, of the JSON that benchmarks/profile_run.py writes."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

SHOWN = 0.015  # share of a stage, below: among the others


def profile(path: Path) -> list[str]:
    """Lines of Markdown; none where nothing was measured."""
    if not path.is_file():
        return []
    entries: dict[str, dict[str, Any]] = json.loads(path.read_text())
    out = ["", "### Where the time goes", ""]
    out.append(
        f"By `python benchmarks/profile_run.py --data DATA --out {path.as_posix()}`: share of the samples of all "
        "threads at work, by the innermost function of the package; kernels and libraries count for who calls them."
    )
    for name, e in entries.items():
        made = f"{e['frames']} frames, {e['keyframes']} keyframes; {e['date']}, {e['machine']['git_commit']}"
        out += [
            "",
            f"{name}: {made}, {e['machine']['processor']}.",
            "",
            "| stage | core-s a frame | shares |",
            "|---|---|---|",
        ]
        for stage, s in e["stages"].items():
            shares = ", ".join(f"{v:.0%} `{k}`" for k, v in s["shares"].items() if v >= SHOWN and k != "other")
            out.append(f"| {stage} | {s['core_s_per_frame']:.3f} | {shares} |")
    return out
