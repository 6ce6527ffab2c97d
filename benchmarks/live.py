"""Sequences played as a camera through the live loop: frames dropped, latency, ATE of the poses as given; writes JSON.

    python benchmarks/live.py --data DATA --out benchmarks/results/live.json [--sequences kitchen] [--fps 15 5]
        [--beside-other-jobs]

Each is a process of its own, ``mastd3r live SEQUENCE --pace FPS --no-map``, which warms up before the camera is
read. ATE "as given" is that of trajectory_live.txt, before any finish; "at the end" that of
trajectory.txt, after the joint optimisation. Entries of an existing file that are not measured again stay.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import tempfile
import time
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from mastd3r import evaluate_trajectory
from mastd3r.errors import InputError
from mastd3r.export.machine import machine_info

KEPT = (
    "frames", "frames_came", "frames_dropped", "frames_dropped_ratio", "fps_camera", "fps_live", "latency_ms_median",
    "latency_ms_95", "pose_latency_ms_median", "pose_latency_ms_95", "keyframes", "peak_rss_mib",
)  # fmt: skip


def measured(sequence: Path, fps: float, folder: Path) -> dict[str, Any]:
    """One live run and its figures."""
    out = folder / f"{sequence.name}-{fps:g}"
    words = ["live", str(sequence), "--pace", f"{fps:g}", "--out", str(out), "--no-map", "--quiet"]
    before, began = _children_s(), time.perf_counter()
    subprocess.run([sys.executable, "-m", "mastd3r", *words], check=True, stdout=subprocess.DEVNULL)
    metrics = json.loads((out / "metrics.json").read_text())
    entry = {key: metrics.get(key) for key in KEPT}
    entry["wall_s"] = round(time.perf_counter() - began, 1)
    entry["cpu_s"] = round(_children_s() - before, 1)
    for key, name in (("given", "trajectory_live.txt"), ("end", "trajectory.txt")):
        try:
            scored = evaluate_trajectory(out / name, "tum", sequence)
            entry[f"ate_{key}"], entry[f"posed_{key}"] = scored["ate_rmse_all"], scored["frames_posed"]
        except InputError as e:  # a camera that found no start has given no pose
            entry[f"ate_{key}"], entry[f"posed_{key}"], entry[f"ate_{key}_note"] = None, 0, str(e)
    return entry


def _children_s() -> float:
    """Processor seconds of processes that have ended."""
    times = os.times()
    return times.children_user + times.children_system


def main() -> int:
    """All sequences at all rates."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--data", type=Path, required=True)
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--sequences", nargs="+", default=["kitchen"])
    parser.add_argument("--fps", type=float, nargs="+", default=[15.0, 5.0])
    parser.add_argument("--beside-other-jobs", action="store_true", help="the machine was not this benchmark's alone")
    args = parser.parse_args()
    entries: dict[str, Any] = json.loads(args.out.read_text()) if args.out.is_file() else {}
    machine = machine_info()
    with tempfile.TemporaryDirectory() as folder:
        for name in args.sequences:
            for fps in args.fps:
                load = os.getloadavg()[0]
                entry = measured(args.data / name, fps, Path(folder))
                entry["made"] = {
                    "date": datetime.now(UTC).date().isoformat(),
                    "commit": machine["git_commit"],
                    "processor": machine["processor"],
                    "cores": machine["cores"],
                    "load_before": round(load, 1),
                    "beside_other_jobs": args.beside_other_jobs,
                }
                entries[f"{name} at {fps:g} frames/s"] = entry
                print(name, fps, json.dumps(entry))
                args.out.write_text(json.dumps(entries, indent=1) + "\n")
    return 0


if __name__ == "__main__":
    sys.exit(main())
