"""The rows of docs/results.md on a walk without end, of the JSON that benchmarks/endless.py writes."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any


def endless(path: Path) -> list[str]:
    """Lines of Markdown; none where nothing was measured."""
    if not path.is_file():
        return []
    e: dict[str, Any] = json.loads(path.read_text())
    out = ["", f"By `python benchmarks/endless.py --frames {e['frames']} --work DIR --out {path.as_posix()}`: a walk"]
    out[-1] += (
        " along a corridor that is ray-cast as it goes, 320 x 240, 5 cm a frame, and never comes back, so that every"
        " loop that is believed between places 20 m apart is a false one. Its ceiling's tiles repeat every 1.2 m."
        " Processor time is that of all threads. Ending: loops looked for and pairs matched after the last frame."
    )
    head = ("frames", "states", "keyframes", "tracking, core-s a frame, by quarter", "last / first", "ending")
    head += ("joint solve, core-s a frame", "memory at each quarter [MiB]", "peak [MiB]", "ATE [m]", "of the path")
    head += ("loops believed, false, refused", "date", "commit", "processor")
    out += ["", "| " + " | ".join(head) + " |", "|---" * len(head) + "|"]
    cells = [
        e["frames"],
        ", ".join(f"{n} {state}" for state, n in e["states"].items()),
        e["keyframes_at_quarters"][-1],
        ", ".join(f"{c:.3f}" for c in e["core_s_per_frame_by_quarter"]),
        f"{e['last_quarter_by_first']:.2f}",
        f"{e['core_s_per_frame_ending']:.3f}",
        f"{e['core_s_per_frame_solve']:.3f}",
        ", ".join(map(str, e["memory_mib_at_quarters"])),
        e["peak_rss_mib"],
        f"{e['ate_rmse_all']:.2f} of {e['path_m']:.0f}",
        f"{e['drift_ratio']:.2%}",
        f"{e['loops_believed']}, {e['loops_false']}, {e['loops_refused']}",
        e["date"],
        e["machine"]["git_commit"],
        e["machine"]["processor"] + (", beside other jobs" if e.get("beside_other_jobs") else ""),
    ]
    out.append("| " + " | ".join(map(str, cells)) + " |")
    return out
