"""The section of docs/results.md on saved maps, of the JSON that benchmarks/localise.py writes."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

HEAD = (
    "By `python benchmarks/localise.py --data DATA --out {path} --stride {stride}`: a map of the first frames of a "
    "sequence, later images looked for in it one by one. Near: within 2 cm and 1 degree of the truth, after one Sim(3) "
    "over the poses of the map's own frames. Wrong: off by more than 10 cm or 5 degrees, or found in a place where it "
    "was not taken. Within 2 sigma: by the uncertainty that is said; errors of the map are in the error and not in the "
    "sigma. By fifths: found and near of each fifth of the images in order of time, as the camera leaves the map."
)


def localise(path: Path) -> list[str]:
    """Lines of Markdown; none where nothing was measured."""
    if not path.is_file():
        return []
    entries: dict[str, dict[str, Any]] = json.loads(path.read_text())
    stride = max(e["made"]["stride"] for e in entries.values())
    out = ["", "## Saved maps", "", HEAD.format(path=path.as_posix(), stride=stride), ""]
    out.append("| map: images | of | found | near | wrong | median [m] | 95 % [m] | median [deg] | within 2 sigma |")
    out[-1] += " by fifths, found/near | core-s an image | date | commit | processor |"
    out.append("|---" * 14 + "|")
    for name, e in entries.items():
        made = e["made"]
        fifths = ", ".join(f"{found}/{near}" for _, _, found, near in e.get("by_seconds", []))
        cells = [
            name,
            e["images"],
            e["found"],
            e.get("near", "–"),
            e["wrong"],
            *(f"{e[k]:.4f}" if k in e else "–" for k in ("median_m", "percentile_95_m")),
            f"{e['median_deg']:.2f}" if "median_deg" in e else "–",
            f"{e['within_2_sigma_position']:.0%}" if "within_2_sigma_position" in e else "–",
            fifths or "–",
            e["core_s_an_image"],
            made["date"],
            made["commit"],
            made["processor"],
        ]
        out.append("| " + " | ".join(map(str, cells)) + " |")
    return out
