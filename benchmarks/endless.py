"""A walk that never comes back: do memory and the cost of a frame stay flat, and how far does the path drift?

usage: python benchmarks/endless.py --frames 10000 --work DIR --out benchmarks/results/endless.json

The sequence (320 x 240, 5 cm a frame, benchmarks/endless_world.py) is written into DIR/world first, where it is not
there yet. Then it is tracked and solved in a process of its own, as ``mastd3r run --no-map`` does up to the masks.
Every loop that is believed here is a false one.
"""

from __future__ import annotations

import argparse
import json
import resource
import subprocess
import sys
import time
from collections import Counter
from concurrent.futures import ProcessPoolExecutor
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from endless_world import EndlessCorridor
from mastd3r.concurrency import one_blas_thread
from mastd3r.config import Config, with_override
from mastd3r.evaluation.evaluate import read_poses
from mastd3r.evaluation.trajectory_error import ate_rmse
from mastd3r.export.files import write_json
from mastd3r.export.machine import machine_info, peak_rss_mib
from mastd3r.export.run_folder import RunFolder
from mastd3r.slam import Slam
from mastd3r.sources import open_source

Array = NDArray[Any]
FPS = 30.0
PARTS = 250  # frames that are made at once
GONE_M = 20.0  # two frames so far apart show nothing in common


def main() -> int:
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--frames", type=int, default=10000)
    parser.add_argument("--work", type=Path, required=True)
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--set", action="append", default=[], metavar="SECTION.KEY=VALUE")
    parser.add_argument("--here", action="store_true", help="measure in this process")
    args = parser.parse_args()
    world = args.work / "world"
    make_world(world, args.frames)
    if not args.here:
        return subprocess.run([sys.executable, *sys.argv, "--here"], check=False).returncode
    config = Config()
    for words in args.set:
        config = with_override(config, words)
    config = replace(config, source=replace(config.source, end=args.frames))
    found = measure(world, args.work / "run", replace(config, mapping=replace(config.mapping, enabled=False)))
    write_json(args.out, found | {"date": time.strftime("%Y-%m-%d"), "machine": machine_info(), "changes": args.set})
    print(json.dumps(found, indent=1))
    return 0


def make_world(folder: Path, frames: int) -> None:
    """The sequence in TUM's layout, at least so many frames of it."""
    (folder / "rgb").mkdir(parents=True, exist_ok=True)
    missing = [
        n for n in range(0, frames, PARTS) if not (folder / "rgb" / f"{min(n + PARTS, frames) - 1:06d}.jpg").is_file()
    ]
    with ProcessPoolExecutor(2) as pool:
        list(pool.map(_make, [folder] * len(missing), missing, [min(n + PARTS, frames) for n in missing]))
    there = sorted((folder / "rgb").glob("*.jpg"))
    corridor = EndlessCorridor()
    images = "".join(f"{int(f.stem) / FPS:.6f} rgb/{f.name}\n" for f in there)
    poses = "".join(f"{int(f.stem) / FPS:.6f} {_pose_text(corridor.pose(int(f.stem)))}\n" for f in there)
    (folder / "rgb.txt").write_text(images)
    (folder / "groundtruth.txt").write_text(poses)


def _make(folder: Path, first: int, end: int) -> None:
    corridor = EndlessCorridor()
    for n in range(first, end):
        image = np.ascontiguousarray(corridor.image(n)[..., ::-1])
        cv2.imwrite(str(folder / "rgb" / f"{n:06d}.jpg"), image, [cv2.IMWRITE_JPEG_QUALITY, 95])


def _pose_text(world_from_cam: Array) -> str:
    xyzw = Rotation.from_matrix(world_from_cam[:3, :3]).as_quat()
    return " ".join(f"{v:.6f}" for v in (*world_from_cam[:3, 3], *xyzw))


@one_blas_thread()
def measure(sequence: Path, run: Path, config: Config) -> dict[str, Any]:
    """Track and solve; costs by quarter of the frames, memory, drift, and the loops that were believed."""
    source = open_source(sequence, config.source, want_depth=False, want_semantic=False)
    slam = Slam(config, source.size, source=source)
    step_s, memory, keyframes = [], [], []
    began = time.process_time()
    with RunFolder(run, [], [sequence], overwrite=True) as folder, slam.job(folder) as job:
        last = time.process_time()
        for frame in slam.prefetched(source.frames()):
            slam.track(frame)
            job.after(frame)
            now = time.process_time()
            step_s.append(now - last)
            last = now
            memory.append(_rss_mib())
            keyframes.append(len(slam.graph.keyframes))
            if len(step_s) % 500 == 0:
                print(
                    len(step_s),
                    keyframes[-1],
                    f"{np.mean(step_s[-500:]):.4f} core-s",
                    f"{memory[-1]:.0f} MiB",
                    flush=True,
                )
        tracked = time.process_time()
        slam.end_tracking()
        ended = time.process_time()
        job.solve()
        solved = time.process_time()
        folder.finish()
    frames = len(step_s)
    quarter = [slice(q * frames // 4, (q + 1) * frames // 4) for q in range(4)]
    truth = source.truth()
    assert truth is not None
    poses = read_poses(run / "trajectory.txt")
    ate = ate_rmse(poses, truth)
    costs = [float(np.mean(step_s[q])) for q in quarter]
    path = float(np.linalg.norm(np.diff(truth.world_from_cam[:frames, :3, 3], axis=0), axis=1).sum())
    loops = [(i, j) for i, j, said in slam.graph.loops if not said.startswith("not believed")]
    positions = truth.world_from_cam[:, :3, 3]
    return {
        "frames": frames,
        "states": Counter(r.state for r in slam.graph.records),
        "keyframes_at_quarters": [keyframes[q.stop - 1] for q in quarter],
        "core_s_per_frame_by_quarter": costs,
        "last_quarter_by_first": costs[3] / costs[0],
        "memory_mib_at_quarters": [round(memory[q.stop - 1]) for q in quarter],
        "peak_rss_mib": round(peak_rss_mib()),
        "core_s_per_frame_tracking": (tracked - began) / frames,
        "core_s_per_frame_ending": (ended - tracked) / frames,
        "core_s_per_frame_solve": (solved - ended) / frames,
        "ate_rmse_all": ate.rmse,
        "path_m": path,
        "drift_ratio": None if ate.rmse is None else ate.rmse / path,
        "loops_believed": len(loops),
        "loops_false": sum(bool(np.linalg.norm(positions[i] - positions[j]) > GONE_M) for i, j in loops),
        "loops_refused": len(slam.graph.loops) - len(loops),
    }


def _rss_mib() -> float:
    pages = int(Path("/proc/self/statm").read_text().split()[1])
    return pages * resource.getpagesize() / 2**20


if __name__ == "__main__":
    raise SystemExit(main())
