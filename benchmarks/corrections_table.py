"""The section of the results page that benchmarks/corrections.py fills."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np

from mastd3r.registry import ALIGNMENT

ROWS = {"ours": "ours", "printed": "as printed"}


def corrections(path: Path) -> list[str]:
    """Lines of markdown; none where the file is not there."""
    if not path.is_file():
        return []
    data = json.loads(path.read_text())
    about, errors = data["about"], data["about"]["errors"]
    entries: list[dict[str, Any]] = list(data["entries"].values())
    seeds = sorted({e["seed"] for e in entries})
    names = ALIGNMENT.choices
    lines = [
        "",
        "## Corrections (Table IV) under a network's errors",
        "",
        f"By `python benchmarks/corrections.py --data {about['sequence'].upper()} --out "
        f"benchmarks/results/corrections.json --frames {about['frames']} --stride {about['stride']}`, "
        f"{data['made']['date']}, commit {data['made']['git_commit']}. "
        f"Sensor depth of {about['sequence']}, first {about['frames']} frames, each with a scale of its own "
        f"({errors['scale']:.0%}), bent ({errors['bend']:.0%}) and blurred over edges ({errors['bleed_px']:g} px), "
        f"{len(seeds)} seeds. ATE of the path as tracked, Sim(3), without the joint optimisation: mean [least, most] "
        "in metres. `as printed`: eq. (11)(12) with residuals in space alone, on SE(3).",
        "",
        "| fine stage | " + " | ".join(names) + " |",
        "|---|" + "---|" * len(names),
    ]
    for variant, title in ROWS.items():
        cells = []
        for name in names:
            found = [e["ate_rmse_m"] for e in entries if e["variant"] == variant and e["correction"] == name]
            cells.append(f"{np.mean(found):.4f} [{min(found):.4f}, {max(found):.4f}]" if found else "–")
        lines.append(f"| {title} | " + " | ".join(cells) + " |")
    return lines
