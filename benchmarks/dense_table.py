"""The section of docs/results.md on the dense cloud and the mesh, from the JSON of benchmarks/dense.py."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

HEAD = """## Dense cloud and mesh

By `python benchmarks/dense.py --run RUN --sequence kitchen --out {source}`, {date}, {processor}, {cores} cores, commit
{commit}. Against every fifth of the sensor's depth images, clouds thinned to 1 cm, distances cut at 0.5 m; centimetres,
mean (median). Once under the Sim(3) of the trajectory, once after an ICP with scale.
"""
COLUMNS = (
    "accuracy, trajectory's Sim(3)", "completeness", "accuracy, after ICP", "completeness, after ICP",
    "within 5 cm", "F-score at 5 cm",
)  # fmt: skip
SPLAT = "mesh of the splat's depth"
SENSOR = ("sensor's other frames", "mesh of the sensor's depth", "mesh of the sensor's depth, divided")
ROWS = {"sparse": "`cloud.ply`", "dense": "`cloud_dense.ply`", "mesh": "mesh", SPLAT: SPLAT, **{n: n for n in SENSOR}}


def dense(path: Path) -> list[str]:
    """Markdown lines; none where the file is not there."""
    if not path.is_file():
        return []
    found: dict[str, Any] = json.loads(path.read_text())
    made = found["machine"]
    head = HEAD.format(
        source=f"benchmarks/results/{path.name}",
        date=found["date"],
        processor=made["processor"],
        cores=made["cores"],
        commit=made["git_commit"],
    )
    lines = ["", *head.splitlines(), "", "| | " + " | ".join(COLUMNS) + " |", "|---" * (len(COLUMNS) + 1) + "|"]
    lines += [_row(title, found[name]) for name, title in ROWS.items() if name in found]
    cloud, mesh, sensor = found["dense"], found["mesh"], found["sensor_scale"]
    lines += [
        "",
        f"The dense cloud has {cloud['points']:,} points, on {cloud['covered_ratio']:.0%} of the static pixels of "
        f"{cloud['keyframes']} views; {cloud['seconds']:.0f} s beside other work, {cloud['cpu_s']:.0f} s of processor "
        f"time. The mesh has {mesh['triangles']:,} triangles, {mesh['seconds']:.0f} s more, {mesh['cpu_s']:.0f} s of "
        "processor time.",
        "The sensor's depth images agree best with one another under the true poses when they are divided by "
        f"{sensor['scale']:.2f} (mean difference {1000 * sensor['difference_m']:.1f} mm, "
        f"{1000 * sensor['difference_at_1_m']:.1f} mm undivided): no cloud can be right in both, and the ICP finds a "
        f"scale of {cloud['cloud_registered_scale']:.3f}.",
        "The last rows are the sensor's own depth at the true poses in place of the estimate: one surface cannot be "
        "complete against depth images that lie beside one another.",
    ]
    return lines


def _row(title: str, e: dict[str, Any]) -> str:
    def cm(key: str, suffix: str) -> str:
        return f"{100 * e[f'cloud_{key}_m{suffix}']:.2f} ({100 * e[f'cloud_{key}_median_m{suffix}']:.2f})"

    cells = [cm(key, suffix) for suffix in ("", "_registered") for key in ("accuracy", "completeness")]
    cells += [f"{e['cloud_recall_5cm_registered']:.0%}", f"{e['cloud_f_score_5cm_registered']:.3f}"]
    return f"| {title} | " + " | ".join(cells) + " |"
