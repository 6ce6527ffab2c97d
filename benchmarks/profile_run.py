"""Where the time of a run goes, by function: samples of all threads that are at work, a hundred times a second.

usage: python benchmarks/profile_run.py --data DIR --out benchmarks/results/profile.json [--only SEQUENCE …]

Tracking, what follows its last frame (loops, pairs, the joint solve) and the second pass over the masks are told apart.
A sample belongs to the innermost function of the package; the libraries and kernels that it calls are its own.
"""

from __future__ import annotations

import argparse
import json
import sys
import tempfile
import threading
import time
from collections import Counter
from dataclasses import replace
from pathlib import Path
from types import FrameType, TracebackType
from typing import Any

import mastd3r
from mastd3r.concurrency import one_blas_thread
from mastd3r.config import Config
from mastd3r.export.machine import machine_info
from mastd3r.export.run_folder import RunFolder
from mastd3r.slam import Slam
from mastd3r.sources import open_source

PACKAGE = str(Path(mastd3r.__file__).parent)
EVERY_S = 0.01
WAITS = {("threading.py", "wait"), ("threading.py", "_wait_for_tstate_lock"), ("thread.py", "_worker"),
         ("threading.py", "join"), ("_base.py", "result"), ("thread.py", "submit")}  # fmt: skip
KEPT = 14  # functions of a stage, those with most samples


class Samples:
    """As a context: what every thread is doing meanwhile."""

    def __init__(self) -> None:
        self.by_function: Counter[str] = Counter()
        self.seconds = self.core_s = 0.0
        self._done = threading.Event()
        self._thread = threading.Thread(target=self._sample, daemon=True)

    def __enter__(self) -> Samples:
        self._began = time.perf_counter(), time.process_time()
        self._thread.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._done.set()
        self._thread.join()
        self.seconds = time.perf_counter() - self._began[0]
        self.core_s = time.process_time() - self._began[1]

    def _sample(self) -> None:
        own = threading.get_ident()
        while not self._done.wait(EVERY_S):
            for thread, frame in sys._current_frames().items():
                name = None if thread == own else _at_work(frame)
                if name is not None:
                    self.by_function[name] += 1

    def shares(self) -> dict[str, float]:
        """Share of the samples of those functions that have most of them, the rest as ``other``."""
        total = max(self.by_function.total(), 1)
        most = {name: n / total for name, n in self.by_function.most_common(KEPT)}
        return most | {"other": 1 - sum(most.values())}


def _at_work(frame: FrameType | None) -> str | None:
    """The innermost function of the package, None where the thread waits, or is none of ours."""
    if frame is None or (Path(frame.f_code.co_filename).name, frame.f_code.co_name) in WAITS:
        return None
    while frame is not None:
        file = frame.f_code.co_filename
        if file.startswith(PACKAGE):
            module = Path(file).relative_to(PACKAGE).with_suffix("").as_posix()
            return f"{module}: {frame.f_code.co_qualname.replace('.<locals>', '')}"
        frame = frame.f_back
    return None


@one_blas_thread()
def profile(sequence: Path, run: Path) -> dict[str, Any]:
    """A run without a map, its stages sampled."""
    config = Config()
    config = replace(config, mapping=replace(config.mapping, enabled=False))
    source = open_source(sequence, config.source, want_depth=False, want_semantic=False)
    slam = Slam(config, source.size, source=source)
    tracking, ending, masks = Samples(), Samples(), Samples()
    with RunFolder(run, [], [sequence]) as folder, slam.job(folder) as job:
        with tracking:
            for frame in slam.prefetched(source.frames()):
                slam.track(frame)
                job.after(frame)
        with ending:
            slam.end_tracking()
            job.solve()
        with masks:
            job.smooth_masks(slam.masks.filter.appearance)
        folder.finish()
    frames = len(slam.graph.records)
    stages = {"tracking": tracking, "after the last frame": ending, "masks, second pass": masks}
    found = {
        name: {"core_s_per_frame": s.core_s / frames, "s_per_frame": s.seconds / frames, "shares": s.shares()}
        for name, s in stages.items()
    }
    return {"frames": frames, "keyframes": len(slam.graph.keyframes), "stages": found}


def main() -> int:
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--data", type=Path, required=True)
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--only", nargs="+", default=["kitchen", "lobby_walk"])
    args = parser.parse_args()
    found = json.loads(args.out.read_text()) if args.out.is_file() else {}
    for name in args.only:
        with tempfile.TemporaryDirectory() as work:
            entry = profile(args.data / name, Path(work) / "run")
        found[name] = entry | {"date": time.strftime("%Y-%m-%d"), "machine": machine_info()}
        print(name, json.dumps(entry, indent=1), flush=True)
        args.out.write_text(json.dumps(found, indent=1) + "\n")
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
