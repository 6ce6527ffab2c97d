"""The splat file of whole runs, judged by the run's own figures and by a checker that shares no code with us.

usage: python benchmarks/splats.py --data DIR --out splats.json --check CHECKER [--runs DIR] [--only NAME …]
CHECKER is a script: ``CHECKER RUN SEQUENCE [--width W] [--clean CLEAN]`` prints JSON of the file alone, drawn over
black and over white. Finished entries of an existing file are kept; a run folder that is there is judged as it is.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

from mastd3r.cli.commands import DEMO_GAUSSIANS, DEMO_STEPS
from mastd3r.config import Config
from mastd3r.export.machine import machine_info
from mastd3r.export.read_run import read_run
from mastd3r.sources.synthetic import make_room_clip

# as ``mastd3r demo`` does
DEMO = ["--set", f"mapping.iterations={DEMO_STEPS}", "--set", f"mapping.max_gaussians={DEMO_GAUSSIANS}"]
# name -> (sequence, options of run, width that the checker draws, clean sequence)
ENTRIES: dict[str, tuple[str, list[str], int, str | None]] = {
    "demo": ("demo", DEMO, 320, None),
    "kitchen": ("kitchen", [], 640, None),
    "kitchen, draft": ("kitchen", ["--quality", "draft"], 320, None),
    "kitchen_walk": ("kitchen_walk", [], 640, "kitchen"),
    "street": ("street", [], 1226, None),
    "jam": ("jam", [], 1242, None),
    "lobby": ("lobby", [], 540, None),
}


def main() -> int:
    """Run what is missing; the file is rewritten after every entry."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--data", type=Path, required=True, help="folder that holds the sequences")
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--check", type=Path, required=True, help="the independent checker")
    parser.add_argument("--runs", type=Path, default=Path("runs"))
    parser.add_argument("--only", nargs="*", default=None)
    args = parser.parse_args()
    args.runs.mkdir(parents=True, exist_ok=True)
    done: dict[str, Any] = json.loads(args.out.read_text()) if args.out.is_file() else {}
    for name, (sequence, options, width, clean) in ENTRIES.items():
        if name in done or (args.only is not None and name not in args.only):
            continue
        folder = _demo(args.runs) if sequence == "demo" else args.data / sequence
        if not folder.is_dir():
            print(f"{name}: {folder} is not there, left out", file=sys.stderr)
            continue
        words = ["--width", str(width), *(["--clean", str(args.data / clean)] if clean else [])]
        done[name] = _one(name, folder, options, args, words)
        args.out.write_text(json.dumps(done, indent=1) + "\n")
    return 0


def _demo(runs: Path) -> Path:
    clip = runs / "demo-clip"
    if not clip.is_dir():
        make_room_clip(clip, seed=Config().seed)
    return clip


def _one(name: str, folder: Path, options: list[str], args: argparse.Namespace, words: list[str]) -> dict[str, Any]:
    out = args.runs / f"splat-{name.replace(', ', '-')}"
    command = [sys.executable, "-m", "mastd3r", "run", str(folder), "--out", str(out), "--quiet", *options]
    if not (out / "gaussians.ply").is_file():
        subprocess.run(command, check=True, stdout=subprocess.DEVNULL)
    check = [sys.executable, str(args.check), str(out), str(folder), *words]
    judged = json.loads(subprocess.run(check, check=True, capture_output=True, text=True).stdout)
    run, info = read_run(out), machine_info()
    print(name, judged, flush=True)
    return {
        "command": f"mastd3r run {folder.name} --out RUN {' '.join(options)}".strip(),
        "checker": " ".join(words),
        "checked": judged,
        "metrics": run.metrics,
        "timings_s": run.record["timings_s"],
        "width_px": run.render(float(run.render_times_s()[0])).shape[1],
        "date": time.strftime("%Y-%m-%d"),
        "processor": info["processor"],
        "cores": info["cores"],
        "git_commit": run.record["machine"].get("git_commit", info["git_commit"]),
    }


if __name__ == "__main__":
    sys.exit(main())
