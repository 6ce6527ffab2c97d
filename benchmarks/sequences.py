"""Run real sequences with default options and write their figures as JSON, one entry a sequence and variant.

usage: python benchmarks/sequences.py --data DIR --out results.json [--runs DIR] [--only NAME …]
Finished entries of an existing file are kept; delete the file to start again.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

from mastd3r.export.machine import machine_info

# name -> (sequence folder, options)
ENTRIES: dict[str, tuple[str, list[str]]] = {
    "kitchen": ("kitchen", []),
    "kitchen, no map": ("kitchen", ["--no-map"]),
    "street": ("street", ["--no-map"]),
    "kitchen, depth pointmaps": ("kitchen", ["--pointmaps", "depth", "--end", "200", "--no-map"]),
    "kitchen_walk": ("kitchen_walk", []),
    "kitchen_walk, no semantics": ("kitchen_walk", ["--semantics", "none", "--no-map"]),
    "kitchen_walk, people": ("kitchen_walk", ["--semantics", "people", "--no-map"]),
    "kitchen_walk_close": ("kitchen_walk_close", ["--no-map"]),
    "kitchen_walk_close, no semantics": ("kitchen_walk_close", ["--semantics", "none", "--no-map"]),
    "kitchen_walk_close, people": ("kitchen_walk_close", ["--semantics", "people", "--no-map"]),
    "kitchen_walk_close, no semantics, causal masks": (
        "kitchen_walk_close",
        ["--semantics", "none", "--masks", "causal", "--no-map"],
    ),
    "lobby": ("lobby", ["--no-map"]),
    "lobby_walk": ("lobby_walk", ["--no-map"]),
    "lobby_walk, no semantics": ("lobby_walk", ["--semantics", "none", "--no-map"]),
    "lobby_walk, people": ("lobby_walk", ["--semantics", "people", "--no-map"]),
    "jam": ("jam", ["--no-map"]),
    "tsukuba": ("tsukuba", ["--no-map"]),
    "street, map": ("street", []),
    "lobby, map": ("lobby", []),
    "jam, map": ("jam", []),
    "kitchen, realtime": ("kitchen", ["--realtime"]),
    "cabinet": ("cabinet", ["--no-map"]),
    "bedroom": ("bedroom", ["--no-map"]),
    "cafe": ("cafe", ["--no-map"]),
    "car": ("car", ["--no-map"]),
    "cafe, people": ("cafe", ["--semantics", "people", "--no-map"]),
    "bedroom, people": ("bedroom", ["--semantics", "people", "--no-map"]),
    "car, people": ("car", ["--semantics", "people", "--no-map"]),
    "car, no semantics": ("car", ["--semantics", "none", "--no-map"]),
}


def main() -> int:
    """Run what is missing; the file is rewritten after every entry."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--data", type=Path, required=True, help="folder that holds the sequences")
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--runs", type=Path, default=Path("runs"))
    parser.add_argument("--only", nargs="*", default=None)
    args = parser.parse_args()
    done: dict[str, Any] = json.loads(args.out.read_text()) if args.out.is_file() else {}
    for name, (sequence, options) in ENTRIES.items():
        if name in done or (args.only is not None and name not in args.only):
            continue
        folder = args.data / sequence
        if not folder.is_dir():
            print(f"{name}: {folder} is not there, left out", file=sys.stderr)
            continue
        done[name] = _one(name, folder, options, args.runs)
        args.out.write_text(json.dumps(done, indent=1) + "\n")
    return 0


def _one(name: str, folder: Path, options: list[str], runs: Path) -> dict[str, Any]:
    out = runs / name.replace(", ", "-").replace(" ", "_")
    words = ["run", str(folder), "--out", str(out), "--quiet", *options]
    began = time.perf_counter()
    ended = subprocess.run([sys.executable, "-m", "mastd3r", *words], capture_output=True, text=True, check=False)
    info = machine_info()
    entry: dict[str, Any] = {
        "command": f"mastd3r run {folder.name} --out RUN {' '.join(options)}".strip(),
        "exit_code": ended.returncode,
        "wall_s": round(time.perf_counter() - began, 1),
        "date": time.strftime("%Y-%m-%d"),
        "processor": info["processor"],
        "cores": info["cores"],
        "git_commit": info["git_commit"],
    }
    metrics = out / "metrics.json"
    if ended.returncode == 0 and metrics.is_file():
        entry["metrics"] = json.loads(metrics.read_text())
    else:
        entry["error"] = ended.stderr.strip().splitlines()[-1:] or ["no message"]
    print(name, {k: entry.get(k) for k in ("exit_code", "wall_s")}, flush=True)
    return entry


if __name__ == "__main__":
    sys.exit(main())
