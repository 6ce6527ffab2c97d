"""The section of docs/results.md on live runs, of the JSON that benchmarks/live.py writes."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any


def live(path: Path) -> list[str]:
    """Lines of Markdown; none where nothing was measured."""
    if not path.is_file():
        return []
    entries: dict[str, dict[str, Any]] = json.loads(path.read_text())
    out = ["", "## Live", ""]
    out.append(
        f"By `python benchmarks/live.py --data DATA --out {path.as_posix()}`: sequences played as a camera through "
        "`mastd3r live`, causal masks written. Latency is from a frame's arrival until its pose and its mask are out. "
        "ATE as given: of the poses as they were given out, before any finish; at the end: after the joint solve."
    )
    out += ["", "| played | came | dropped | latency, median [ms] | 95 % [ms] | ATE as given [m] | of |"]
    out[-1] += " ATE at the end [m] |"
    out[-1] += " processor time [s] | date | commit | processor | load |"
    out.append("|---" * 13 + "|")
    for name, e in entries.items():
        made = e["made"]
        busy = " (busy)" if made["beside_other_jobs"] else ""
        cells = [
            name,
            e["frames_came"],
            f"{e['frames_dropped_ratio']:.1%}{busy}",
            f"{e['latency_ms_median']:.0f}{busy}",
            f"{e['latency_ms_95']:.0f}{busy}",
            _metres(e["ate_given"]),
            e["posed_given"],
            _metres(e["ate_end"]),
            e["cpu_s"],
            made["date"],
            made["commit"],
            made["processor"],
            made["load_before"],
        ]
        out.append("| " + " | ".join(map(str, cells)) + " |")
    return out


def _metres(value: float | None) -> str:
    return "–" if value is None else f"{value:.4f}"
