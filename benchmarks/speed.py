"""Seconds a frame, ours and an anchor's side by side: wall and processor time of all threads, in one run.

usage: python benchmarks/speed.py --data DIR --out benchmarks/results/speed.json [--only SEQUENCE …]
       [--anchor-python PYTHON]

Ours: ``mastd3r run SEQUENCE --no-map``, all options as they come. The anchor: pycolmap on the same images, SIFT on the
CPU, sequential matching, incremental mapping with a shared simple radial camera. Each is a process of its own, one
after the other, so that a ratio holds on a busy machine too. ``--anchor-python`` names an interpreter with pycolmap
(default: this one); without it there is no anchor, and the file says so.
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
from mastd3r.sources import open_source

SEQUENCES = ("kitchen", "kitchen_walk", "lobby", "lobby_walk", "street", "jam", "tsukuba")
KEPT = ("ate_rmse_all", "mask_iou", "frames_tracked", "frames_interpolated", "keyframes", "fps_tracking")
KEPT_COSTS = ("core_s_per_frame_tracking", "core_s_per_frame", "peak_rss_mib")
ANCHOR = """
import json, sys
from pathlib import Path
import pycolmap
images, work = Path(sys.argv[1]), Path(sys.argv[2])
database = work / "database.db"
reader = {"camera_mode": pycolmap.CameraMode.SINGLE}
pycolmap.extract_features(database, images, device=pycolmap.Device.cpu, **reader)
pycolmap.match_sequential(database, device=pycolmap.Device.cpu)
found = pycolmap.incremental_mapping(database, images, work)
counts = sorted((m.num_reg_images() for m in found.values()), reverse=True)
print(json.dumps({"version": pycolmap.__version__, "posed": sum(counts), "models": len(counts), "largest": counts[:1]}))
"""


def main() -> int:
    """Measure, print and write after every sequence."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--data", type=Path, required=True)
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--only", nargs="+", default=list(SEQUENCES))
    parser.add_argument("--anchor-python", default=sys.executable)
    args = parser.parse_args()
    found = json.loads(args.out.read_text()) if args.out.is_file() else {}
    for name in args.only:
        with tempfile.TemporaryDirectory() as work:
            entry: dict[str, Any] = {"ours": _ours(args.data / name, Path(work) / "run")}
        print(name, json.dumps(entry), flush=True)
        with tempfile.TemporaryDirectory() as work:
            entry["anchor"] = _anchor(args.anchor_python, args.data / name, Path(work), entry["ours"]["frames"])
        anchor_s = entry["anchor"].get("s_per_frame")
        entry["ratio"] = None if anchor_s is None else anchor_s / entry["ours"]["s_per_frame"]
        found[name] = entry | {"date": datetime.now(UTC).isoformat(timespec="seconds"), "machine": machine_info()}
        print(name, json.dumps(entry), flush=True)
        args.out.parent.mkdir(parents=True, exist_ok=True)
        args.out.write_text(json.dumps(found, indent=2) + "\n")
    return 0


def _ours(sequence: Path, out: Path) -> dict[str, Any]:
    command = [sys.executable, "-m", "mastd3r", "run", str(sequence), "--out", str(out), "--no-map", "--quiet"]
    _, costs = _measured(command)
    metrics = json.loads((out / "metrics.json").read_text())
    frames = sum(metrics[f"frames_{state}"] for state in ("tracked", "interpolated", "lost"))
    kept = {key: metrics.get(key) for key in (*KEPT, *KEPT_COSTS)}
    return {"command": "mastd3r run SEQUENCE --no-map", "frames": frames, **_a_frame(costs, frames), **kept}


def _anchor(python: str, sequence: Path, work: Path, frames: int) -> dict[str, Any]:
    """pycolmap on the frames that ours read, in images of their own name; {"missing": why} without it."""
    source = open_source(sequence, SourceConfig())
    images = work / "images"
    images.mkdir()
    for file in (source.files or {}).values():  # type: ignore[attr-defined]
        (images / file.name).symlink_to(file.resolve())
    try:
        told, costs = _measured([python, "-c", ANCHOR, str(images), str(work)], check=False)
    except OSError as e:
        return {"missing": f"{python}: {e.strerror}"}
    if costs["exit"] != 0:
        return {"missing": (told.strip().splitlines() or ["it ended without a word"])[-1]}
    return {**json.loads(told.strip().splitlines()[-1]), **_a_frame(costs, frames)}


def _measured(command: list[str], *, check: bool = True) -> tuple[str, dict[str, float]]:
    """What a process wrote, and its wall and processor seconds, children's included."""
    began, before = time.perf_counter(), os.times()
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    after = os.times()
    if check and done.returncode != 0:
        raise SystemExit(f"{' '.join(command)}: exit {done.returncode}: {done.stderr.strip()[-500:]}")
    busy = after.children_user + after.children_system - before.children_user - before.children_system
    text = done.stdout if done.returncode == 0 else done.stderr
    return text, {"s": time.perf_counter() - began, "core_s": busy, "exit": done.returncode}


def _a_frame(costs: dict[str, float], frames: int) -> dict[str, float]:
    return {"s_per_frame": costs["s"] / frames, "core_s_per_frame_of_all": costs["core_s"] / frames}


if __name__ == "__main__":
    raise SystemExit(main())
