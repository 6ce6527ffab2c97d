"""The section of docs/results.md on the splat file, from the JSON of benchmarks/splats.py."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

HEAD = """## The splat file alone

By `python benchmarks/splats.py --data DATA --out {source} --check CHECKER`: a renderer that shares no code with this
project draws `gaussians.ply` from the poses of `trajectory.txt` at every eighth frame, which the map has never seen;
nothing is fitted, nothing near is cut away. *gain*: after one gain a view. *opaque*: share of the pixels with alpha
above 0.95; *near*: share whose depth is below a third of the view's median. Pixels are those that the true mask calls
static, or all of the clean photograph (kitchen_walk). *ours*: `psnr_holdout_static` or `psnr_holdout` and
`ssim_holdout` of metrics.json at the width of the renders.
"""
COLUMNS = (
    "width [px]", "Gaussians", "over black [dB]", "over white [dB]", "gain [dB]", "opaque", "near", "ours [dB]", "SSIM",
    "map [s]", "ATE all", "peak [MiB]", "commit",
)  # fmt: skip


def splats(path: Path) -> list[str]:
    """Markdown lines; none where the file is not there."""
    if not path.is_file():
        return []
    entries: dict[str, dict[str, Any]] = json.loads(path.read_text())
    lines = [HEAD.format(source=f"benchmarks/results/{path.name}"), "| run | " + " | ".join(COLUMNS) + " |"]
    lines.append("|---" * (len(COLUMNS) + 1) + "|")
    for name, e in entries.items():
        c, m = e["checked"], e["metrics"]
        ours = m.get("psnr_holdout_static", m.get("psnr_holdout"))
        ate = m.get("ate_rmse_all")
        lines.append(
            f"| {name} | {e['width_px']} | {c['gaussians']:,} | {c['psnr_black']:.2f} | {c['psnr_white']:.2f} "
            f"| {c['psnr_best_gain']:.2f} | {c['opaque']:.4f} | {c['near']:.4f} | {ours:.2f} | {m['ssim_holdout']:.3f} "
            f"| {e['timings_s'].get('map', 0):.0f} | {'–' if ate is None else f'{ate:.4f}'} "
            f"| {m['peak_rss_mib']:.0f} | {e['git_commit']} |"
        )
    lines += ["", "Commands: " + "; ".join(f"{n}: `{e['command']}`" for n, e in entries.items()) + ".", ""]
    return lines
