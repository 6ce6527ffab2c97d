"""The section of docs/results.md on long videos in segments, of the JSON that benchmarks/segments.py writes."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any


def segments(path: Path) -> list[str]:
    """Lines of Markdown; none where nothing was measured."""
    if not path.is_file():
        return []
    entries: dict[str, dict[str, Any]] = json.loads(path.read_text())
    out = ["", "## A long video in segments", ""]
    out.append(
        f"By `python benchmarks/segments.py --data DATA --out {path.as_posix()}`: kitchen forwards and backwards, "
        "three times, whole and in six segments with 40 frames in common, by tasks in processes or on a Ray cluster of "
        "this machine. No map. Wall time is the whole command's; processor time that of all processes and threads. A "
        "whole run adds next to no keyframes where it has been before, while each segment has its own."
    )
    out += ["", "| way | tracked | of | ATE [m] | keyframes | wall [s] | tracking [s] | joint optimisation [s] |"]
    out[-1] += " masks [s] | processor [s] | peak memory [MiB] | date | commit | processor | load before |"
    out.append("|---" * 15 + "|")
    for way, e in entries.items():
        if "error" in e:
            out.append(f"| {way} | failed: {e['error']} |" + " |" * 13)
            continue
        made, stages = e["made"], e["stages_s"]
        busy = "–" if e["processor_s"] is None else f"{sum(e['processor_s'].values()):.0f}"
        cells = [way, e["tracked"], e["frames"], f"{e['ate_m']:.4f}", e["keyframes"], f"{e['wall_s']:.0f}"]
        cells += [f"{stages.get(k, 0):.0f}" for k in ("tracking", "joint optimisation", "masks")]
        cells += [busy, f"{e['peak_rss_mib']:.0f}", made["date"], made["commit"]]
        cells += [f"{made['processor']}, {made['cores']} cores", made["load_before"]]
        out.append("| " + " | ".join(map(str, cells)) + " |")
    return out
