"""A long video whole and in segments: accuracy, wall and processor time, here and on a Ray cluster of this machine.

    python benchmarks/segments.py --data DATA --out benchmarks/results/segments.json [--only WAY …]

The video: frames 0 to LAST of a sequence forwards, then backwards, TIMES times; its truth is that of the sequence.
Ways: whole; segments (tasks in processes, as many as cores); ray (the same by ``--ray local``; needs the extra
[cluster]). No map. Entries of an existing file that are not measured again stay.
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

from mastd3r.config import SourceConfig
from mastd3r.export.machine import machine_info
from mastd3r.export.trajectory_files import write_tum
from mastd3r.sources import open_source
from mastd3r.types import Trajectory

SEQUENCE, TIMES, SEGMENTS, FPS = "kitchen", 3, 6, 30.0
WAYS = ("whole", "segments", "ray")


def palindrome(data: Path, folder: Path, last: int | None) -> int:
    """The video as a TUM-layout folder of links; how many frames."""
    import numpy as np

    source = open_source(data / SEQUENCE, SourceConfig(end=last))
    truth, files = source.truth(), source.files  # type: ignore[attr-defined]
    frames = [(f.index, f.timestamp_s) for f in source.frames()]
    assert truth is not None
    poses = [truth.world_from_cam[int(np.argmin(np.abs(truth.timestamps_s - t)))] for _, t in frames]
    order = [*range(len(frames)), *reversed(range(len(frames)))] * TIMES
    times_s = np.arange(len(order)) / FPS
    (folder / "rgb").mkdir(parents=True)
    lines = []
    for n, k in enumerate(order):
        image = Path(files[frames[k][0]]).resolve()
        link = folder / "rgb" / f"{n:05d}{image.suffix}"
        link.symlink_to(image)
        lines.append(f"{times_s[n]:.6f} rgb/{link.name}\n")
    (folder / "rgb.txt").write_text("".join(lines))
    told = Trajectory(
        times_s, np.stack([poses[k] for k in order]), ("tracked",) * len(order), np.ones(len(order), bool)
    )
    write_tum(folder / "groundtruth.txt", told)
    return len(order)


def measured(way: str, video: Path, run: Path, frames: int) -> dict[str, Any]:
    """One way, as the command line does it."""
    words = ["--no-map", "--quiet"]
    if way != "whole":
        words += ["--segment-frames", str(frames // SEGMENTS)]
    if way == "ray":
        words += ["--ray", "local", "--task-cores", "1"]
    load = os.getloadavg()[0]
    began = time.monotonic()
    argv = [sys.executable, "-m", "mastd3r", "run", str(video), "--out", str(run), *words]
    done = subprocess.run(argv, capture_output=True, text=True, check=False)
    wall_s = time.monotonic() - began
    if done.returncode:
        return {"error": (done.stderr.strip().splitlines() or ["no message"])[-1]}
    record, metrics = (json.loads((run / name).read_text()) for name in ("run.json", "metrics.json"))
    busy = record.get("processor_s") or {}
    return {
        "command": f"mastd3r run VIDEO --out RUN {' '.join(words)}",
        "frames": metrics["frames"],
        "tracked": metrics["frames_tracked"],
        "ate_m": metrics["ate_rmse_all"],
        "keyframes": metrics["keyframes"],
        "wall_s": round(wall_s, 1),
        "stages_s": {k: round(v, 1) for k, v in record["timings_s"].items()},
        "processor_s": None if None in busy.values() else {k: round(v, 1) for k, v in busy.items()},
        "peak_rss_mib": metrics["peak_rss_mib"],
        "joints": (record.get("segments") or {}).get("joints"),
        "made": {
            "date": f"{datetime.now(UTC):%Y-%m-%d}",
            "commit": machine_info()["git_commit"],
            "processor": machine_info()["processor"],
            "cores": machine_info()["cores"],
            "load_before": round(load, 2),
        },
    }


def main() -> int:
    """Measure, and write after each way."""
    p = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    p.add_argument("--data", type=Path, required=True)
    p.add_argument("--out", type=Path, required=True)
    p.add_argument("--only", nargs="+", choices=WAYS, default=WAYS)
    p.add_argument("--last", type=int, help="frames of the sequence (default all)")
    args = p.parse_args()
    entries = json.loads(args.out.read_text()) if args.out.is_file() else {}
    with tempfile.TemporaryDirectory() as folder:
        frames = palindrome(args.data, Path(folder) / "video", args.last)
        for way in args.only:
            entries[way] = measured(way, Path(folder) / "video", Path(folder) / way, frames)
            print(way, json.dumps(entries[way]))
            args.out.write_text(json.dumps(entries, indent=1) + "\n")
    return 0


if __name__ == "__main__":
    sys.exit(main())
