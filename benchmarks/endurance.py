"""Loops, blackouts and long runs of one real sequence: does the end meet the start, and does the cost stay flat?

    python benchmarks/endurance.py --data ../shared/data/kitchen --what loop blackout long --out endurance.json

loop: forward, then backward. blackout: 15 black frames in the middle. long: forward and backward until 2,000 frames.
"""

from __future__ import annotations

import argparse
import json
import resource
import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mastd3r.concurrency import one_blas_thread
from mastd3r.config import Config, SourceConfig
from mastd3r.evaluation.trajectory_error import ate_rmse
from mastd3r.export.machine import machine_info
from mastd3r.offline.final_solve import final_frames, finish_graph, trajectory_of
from mastd3r.slam import Slam
from mastd3r.sources import open_source
from mastd3r.types import Frame, Source, Trajectory, Truth

Array = NDArray[Any]
BLACK_FRAMES, LONG_FRAMES = 15, 2000


class Reordered:
    """A source's frames in another order, with new timestamps 1/30 s apart and the truth that goes with them."""

    def __init__(self, source: Source, order: list[int], black: range) -> None:
        self.frames_of = {f.index: f for f in source.frames()}
        self.order, self.black, self.true = order, black, source.truth()

    def frames(self) -> Iterator[Frame]:
        """The frames, one by one."""
        for n, at in enumerate(self.order):
            frame = replace(self.frames_of[at], index=n, timestamp_s=n / 30)
            yield replace(frame, image=np.zeros_like(frame.image)) if n in self.black else frame

    def truth(self) -> Truth:
        """Poses in the new order."""
        assert self.true is not None
        times = np.array([self.frames_of[at].timestamp_s for at in self.order])
        rows = np.abs(self.true.timestamps_s[None] - times[:, None]).argmin(1)
        return Truth(np.arange(len(self.order)) / 30, self.true.world_from_cam[rows])


def order_of(what: str, n: int) -> tuple[list[int], range]:
    """Positions in the source, and which of the new frames are black."""
    there, back = list(range(n)), list(range(n - 1, -1, -1))
    if what == "blackout":
        return there, range(n // 2, n // 2 + BLACK_FRAMES)
    if what == "loop":
        return there + back, range(0)
    return ((there + back) * (1 + LONG_FRAMES // (2 * n)))[:LONG_FRAMES], range(0)


def rss_mib() -> float:
    """Resident memory now."""
    pages = int(Path("/proc/self/statm").read_text().split()[1])
    return pages * resource.getpagesize() / 2**20


@one_blas_thread()
def measure(source: Source, what: str, config: Config) -> dict[str, Any]:
    """Track one arrangement and say how it went."""
    order, black = order_of(what, source.length or 0)
    arranged = Reordered(source, order, black)
    slam = Slam(config, source.size, source=source)
    step_s, memory, keyframes = [], [], []
    for frame in arranged.frames():
        began = time.process_time()
        slam.track(frame)
        step_s.append(time.process_time() - began)
        memory.append(rss_mib())
        keyframes.append(len(slam.graph.keyframes))
    slam.end_tracking()
    finish_graph(slam.graph, config)
    trajectory = trajectory_of(final_frames(slam.graph))
    ate = ate_rmse(trajectory, arranged.truth())
    quarter = len(order) // 4
    out = {
        "frames": len(order),
        "states": {s: trajectory.states.count(s) for s in sorted(set(trajectory.states))},
        "ate_rmse_all": ate.rmse,
        "keyframes_at_quarters": [keyframes[(q + 1) * quarter - 1] for q in range(4)],
        "cpu_s_per_frame_by_quarter": [float(np.mean(step_s[q * quarter : (q + 1) * quarter])) for q in range(4)],
        "memory_mib_at_quarters": [round(memory[(q + 1) * quarter - 1]) for q in range(4)],
        "end_from_start_m": end_from_start(trajectory, ate.scale) if what == "loop" else None,
    }
    out["last_quarter_by_first"] = out["cpu_s_per_frame_by_quarter"][3] / out["cpu_s_per_frame_by_quarter"][0]
    out["memory_end_by_half"] = memory[-1] / memory[len(memory) // 2]
    return out


def end_from_start(trajectory: Trajectory, scale: float | None) -> float | None:
    """Distance between the first and the last pose, which are the same place, in the truth's unit."""
    apart = np.linalg.norm(trajectory.world_from_cam[-1, :3, 3] - trajectory.world_from_cam[0, :3, 3])
    return float(apart * scale) if scale is not None else None


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--data", type=Path, required=True, help="a TUM-layout folder with groundtruth.txt")
    parser.add_argument("--what", nargs="+", choices=("loop", "blackout", "long"), default=["loop", "blackout"])
    parser.add_argument("--out", type=Path, required=True)
    args = parser.parse_args()
    source = open_source(args.data, SourceConfig(), want_depth=False, want_semantic=False, semantic_dir=None)
    results = json.loads(args.out.read_text()) if args.out.exists() else {}
    for what in args.what:
        info = machine_info()
        made = {"date": time.strftime("%Y-%m-%d"), "commit": info["git_commit"], "processor": info["processor"]}
        results[what] = {"sequence": args.data.name, **measure(source, what, Config()), "made": made}
        args.out.parent.mkdir(parents=True, exist_ok=True)
        args.out.write_text(json.dumps(results, indent=1) + "\n")
        print(what, json.dumps(results[what]), flush=True)


if __name__ == "__main__":
    main()
