"""Table IV on depths with a network's errors: tracking alone under each correction, over seeds; writes JSON.

    python benchmarks/corrections.py --data SEQUENCE --out corrections.json [--frames 200] [--seeds 5] [--stride 1]
        [--scale 0.02] [--bend 0.01] [--bleed-px 2]

SEQUENCE is a TUM-layout folder with depth and truth. Its depths are disturbed as a two-view network would get them
wrong (benchmarks/network_errors.py). What is scored is the path as tracked: each frame's pose against its keyframe,
chained, with the joint optimisation switched off, since that mends from the matches what a correction leaves.
``ours`` is the default alignment; ``printed`` is eq. (11)(12) as printed (alignment.as_printed).
Finished entries of an existing file are kept.
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).resolve().parent))

import numpy as np

from mastd3r.concurrency import one_blas_thread
from mastd3r.config import Config
from mastd3r.evaluation.trajectory_error import ate_rmse
from mastd3r.export.machine import machine_info
from mastd3r.geometry.se3 import inverse
from mastd3r.parts import Parts, parts_of
from mastd3r.pointmap.geometric import working_size
from mastd3r.registry import ALIGNMENT
from mastd3r.slam import Slam
from mastd3r.sources import open_source
from mastd3r.types import Source, Trajectory
from network_errors import DisturbedDepthPointmaps, NetworkErrors

VARIANTS = ("printed", "ours")


class FrontEnd(Slam):
    """Tracking without the joint optimisation: a keyframe stays where its alignment put it."""

    def __init__(self, config: Config, parts: Parts, source: Source) -> None:
        super().__init__(config, source.size, source=source, parts=parts)
        self.graph.solve_window = lambda: None  # type: ignore[assignment,method-assign,return-value]
        self.graph.solve_depths = lambda *_: None  # type: ignore[method-assign]
        self.graph.solve_all = lambda *_: None  # type: ignore[assignment,method-assign,return-value]


@one_blas_thread()
def tracked(source: Source, config: Config, errors: NetworkErrors, seed: int) -> dict[str, Any]:
    """ATE of the path as tracked, and how it went."""
    size = working_size(*source.size, config.tracking.area_px)
    parts = parts_of(DisturbedDepthPointmaps(*size, config.tracking.cell_px, errors, seed), config)
    slam = FrontEnd(config, parts, source)
    poses, stamps, states = [], [], []
    for frame in source.frames():
        slam.track(frame)
        record = slam.graph.records[-1]
        states.append(record.state)
        poses.append(inverse(record.cam_from_kf @ slam.graph.variables[record.kf_id].cam_from_world))
        stamps.append(frame.timestamp_s)
    path = Trajectory(np.array(stamps), np.stack(poses), tuple(states), np.zeros(len(poses), bool))
    truth = source.truth()
    assert truth is not None
    error = ate_rmse(path, truth)
    return {
        "ate_rmse_m": error.rmse,
        "frames": len(poses),
        "keyframes": len(slam.graph.keyframes),
        "restarts": states.count("started") - 1,
    }


def main() -> None:
    """Every variant, correction and seed; the file is rewritten after each."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--data", type=Path, required=True)
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--frames", type=int, default=200)
    parser.add_argument("--stride", type=int, default=1)
    parser.add_argument("--seeds", type=int, default=5)
    for name, value in asdict(NetworkErrors()).items():
        parser.add_argument("--" + name.replace("_", "-"), type=float, default=value)
    args = parser.parse_args()
    base = Config()
    base = replace(base, pointmaps="depth", source=replace(base.source, end=args.frames, stride=args.stride))
    errors = NetworkErrors(args.scale, args.bend, args.bleed_px)
    source = open_source(args.data, base.source, want_depth=True, want_semantic=False, semantic_dir=None)
    about = {"sequence": args.data.name, "frames": args.frames, "stride": args.stride, "errors": asdict(errors)}
    known = json.loads(args.out.read_text()) if args.out.is_file() else {}
    entries: dict[str, Any] = known.get("entries", {}) if known.get("about") == about else {}
    for seed in range(args.seeds):
        for variant in VARIANTS:
            for correction in ALIGNMENT.choices:
                key = f"{variant} {correction} {seed}"
                if key in entries:
                    continue
                same = entries.get(f"{VARIANTS[0]} {correction} {seed}")
                if same is not None and "fine" not in correction:  # there the variants do not differ
                    entries[key] = {**same, "variant": variant}
                    continue
                alignment = replace(base.alignment, as_printed=variant == "printed")
                config = replace(base, correction=correction, alignment=alignment)
                entries[key] = {"variant": variant, "correction": correction, "seed": seed}
                entries[key] |= tracked(source, config, errors, seed)
                print(key, entries[key], flush=True)
                info = machine_info()
                made = {
                    "date": time.strftime("%Y-%m-%d"),
                    "git_commit": info["git_commit"],
                    "processor": info["processor"],
                }
                args.out.write_text(json.dumps({"about": about, "made": made, "entries": entries}, indent=1) + "\n")


if __name__ == "__main__":
    main()
