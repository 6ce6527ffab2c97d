"""The section of docs/results.md on videos that go on in a saved map, of the JSON of benchmarks/two_videos.py."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

HEAD = (
    "By `python benchmarks/two_videos.py --data DATA --out {path}`: a map of some frames of a sequence, and others "
    "that go on in it (`mastd3r run --map`). ATE of two: poses of both runs together, after one Sim(3) for all of "
    "them; of one: a run over all frames at once. Unit of the truth, as above. Placed: images of the second video "
    "in the map's frame; a video of another place must have none."
)


def two_videos(path: Path) -> list[str]:
    """Lines of Markdown; none where nothing was measured."""
    if not path.is_file():
        return []
    entries: dict[str, dict[str, Any]] = json.loads(path.read_text())
    out = ["", "## A second video in the map of the first", "", HEAD.format(path=path.as_posix()), ""]
    out.append(
        "| map, video | keyframes of the map | new | placed | of | found first at | ATE of two | of one | ratio |"
    )
    out[-1] += " core-s a frame | date | commit | processor |"
    out.append("|---" * 13 + "|")
    for name, e in entries.items():
        made, at = e["made"], e["first_frame"]
        cells = [
            name,
            e["map_keyframes"],
            e["new_keyframes"],
            e["placed"],
            e["images"],
            "–" if at is None else f"frame {at}",
            *(f"{e[k]:.4f}" if k in e else "–" for k in ("ate_m", "ate_one_run_m")),
            f"{e['ratio']:.2f}" if "ratio" in e else "–",
            f"{e['core_s_per_frame']:.3f}",
            made["date"],
            made["commit"],
            made["processor"],
        ]
        out.append("| " + " | ".join(map(str, cells)) + " |")
    return out
