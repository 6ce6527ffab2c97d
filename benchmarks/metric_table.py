"""The section of docs/results.md on metric scale, of the JSON that benchmarks/metric_scale.py writes."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any


def metric_scale(path: Path) -> list[str]:
    """Lines of Markdown; none where nothing was measured."""
    if not path.is_file():
        return []
    entries: dict[str, dict[str, Any]] = json.loads(path.read_text())
    measured = entries.pop("measured")
    made = entries.pop("made", {})
    out = ["", "## Metric scale", ""]
    out.append(
        f"By `python benchmarks/metric_scale.py --data DATA --out {path.as_posix()}`, {measured['when'][:10]}, commit "
        f"{measured['machine']['git_commit']}. Error: against the scale of the Sim(3) to the true poses. Truth of jam "
        "is itself sure to 6 % only; its lens, as street's, is hardly seen by the video: the sigma says so. Depth of "
        "kitchen: its sensor's metre is not that of its poses; in brackets the error in the sensor's own metre, "
        "which its images and the true poses alone say."
    )
    trials: dict[str, Any] = {}
    out += ["", "| sequence | way | m a map unit | true | error | sigma | supports |", "|---" * 7 + "|"]
    for name, ways in entries.items():
        for way, e in ways.items():
            if way == "sensor":
                continue
            if way == "noisy positions":
                trials[f"{way}, {name}"] = e
                continue
            if "refused" in e:
                out.append(f"| {name} | {way} | – | – | {e['refused']} | – | – |")
                continue
            own = e.get("error_ratio_in_the_sensors_metre")
            error = f"{e['error_ratio']:+.1%}" + ("" if own is None else f" ({own:+.1%})")
            figures = (
                f"{e['metres_per_unit']:.4g} | {e['true']:.4g} | {error} | {e['sigma_ratio']:.2%} | {e['supports']}"
            )
            out.append(f"| {name} | {way} | {figures} |")
    trials |= {f"{way}, made maps": e for way, e in made.items()}
    if trials:
        out += [
            "",
            "How often the true factor lies within one and two sigma: over maps that are made, and over noise on",
        ]
        out[-1] += " every fifth true position (2 % of the path's extent, a tenth wrong)."
        out += ["", "| way | trials | refused | within 1 sigma | within 2 sigma | error, RMS | sigma, median |"]
        out.append("|---" * 7 + "|")
        for way, e in trials.items():
            shares = f"{e['within_1_sigma']:.0%} | {e['within_2_sigma']:.0%}"
            errors = f"{e['error_rms']:.2%} | {e['sigma_median']:.2%}"
            out.append(f"| {way} | {e['trials']} | {e['refused']} | {shares} | {errors} |")
    return out
