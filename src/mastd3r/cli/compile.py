"""``mastd3r compile``: the kernels, compiled and kept before the first run, side by side.

Each part is a process of its own that does the work of its stages on something tiny: whatever those call is compiled,
for the types that they call it with, and no list of kernels can become outdated.
"""

from __future__ import annotations

import argparse
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

from rich.console import Console

from ..config import Config
from ..errors import MissingPackage

CLIP_FRAMES, EVERY = 18, 4  # of the demo's room: enough for a start, and for masks both ways
VIEWS, POINTS, STEPS = 4, 400, 12


def compile_kernels(args: argparse.Namespace, console: Console) -> int:
    """``mastd3r compile``. Raises MissingPackage where a part cannot be run."""
    if args.part is not None:
        PARTS[args.part]()
        return 0
    begun = time.monotonic()
    running = {name: _started(name) for name in PARTS}
    try:
        with console.status("") as line:
            while waiting := [name for name, process in running.items() if process.poll() is None]:
                seconds = time.monotonic() - begun
                done = len(running) - len(waiting)
                line.update(f"compiling the kernels: {done} of {len(running)} parts done, {seconds:.0f} s")
                time.sleep(0.2)
    finally:
        for process in running.values():
            process.kill()
            process.wait()
    for name, process in running.items():
        if process.returncode != 0:
            why = process.stderr.read().decode(errors="replace").strip().rpartition("\n")[2] if process.stderr else ""
            raise MissingPackage(f"kernels of {name}: expected them to be compiled, got: {why}")
    console.print(f"kernels are compiled and kept ({time.monotonic() - begun:.0f} s)")
    return 0


def _started(part: str) -> subprocess.Popen[bytes]:
    command = [sys.executable, "-m", "mastd3r", "compile", "--part", part]
    return subprocess.Popen(command, stdin=subprocess.DEVNULL, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE)


def _tracking() -> None:
    """Tracking, the joint optimisation, masks: a run of a few frames."""
    from ..pipeline import reconstruct
    from ..sources.synthetic import synthetic_frames

    clip = (v.frame for v in synthetic_frames(CLIP_FRAMES * EVERY, every=EVERY))
    config = Config()
    config = replace(config, semantics="people", mapping=replace(config.mapping, enabled=False))
    with tempfile.TemporaryDirectory() as folder:
        reconstruct(((f.timestamp_s, f.image) for f in clip), Path(folder) / "run", config)


def _map() -> None:
    """The solver's kernels, then the map's: training, and what is drawn."""
    import numpy as np

    _solver()
    from ..camera.pinhole import Camera
    from ..mapping.mapper import Mapper
    from ..types import StaticCloud, View

    rng = np.random.default_rng(0)
    camera = Camera.centred(60.0, 64, 48)
    cloud = StaticCloud(
        points_world=rng.uniform((-1.5, -1.2, 2), (1.5, 1.2, 3), (POINTS, 3)).astype(np.float32),
        colors=rng.integers(0, 256, (POINTS, 3), dtype=np.uint8),
        confidence=np.ones(POINTS, np.float32),
        spacing=np.full(POINTS, 0.1, np.float32),
        kf_id=np.zeros(POINTS, np.int32),
    )
    views = []
    for n in range(VIEWS):
        pose = np.eye(4)
        pose[0, 3] = 0.05 * n
        image = rng.integers(0, 256, (48, 64, 3), dtype=np.uint8)
        views.append(View(float(n), image, np.ones((48, 64), np.float32), pose, camera, n))
    config = replace(Config().mapping, iterations=STEPS, max_gaussians=2 * POINTS, sh_degree=2)
    mapper = Mapper(config, cloud, views, seed=0)
    mapper.refine(STEPS)
    mapper.settle()
    mapper.render(views[0].world_from_cam, camera)


def _solver() -> None:
    """First: tracking wants these soon, and finds them kept by then."""
    import numpy as np

    from ..alignment.reproject import StaticMatches
    from ..graph.bundle_adjustment import solve
    from ..graph.factors import KeyframeVariables, ReprojectionFactor
    from ..graph.intrinsics import intrinsics_for

    rng = np.random.default_rng(0)
    px = rng.uniform(20, 300, (60, 2))
    variables = {}
    for k in range(3):
        pose = np.eye(4)
        pose[0, 3] = 0.1 * k
        ones = np.ones(len(px))
        variables[k] = KeyframeVariables(px.copy(), ones.copy(), ones.copy(), 0.01 * ones, pose)
    moved = np.array([25.0, 0.0])  # px from one camera to the next
    pairs = [(i, j) for i in range(3) for j in range(3) if i != j]
    edges = [
        ReprojectionFactor(i, j, (px + (i - j) * moved).astype(np.float32), np.ones(len(px), np.float32))
        for i, j in pairs
    ]
    intrinsics = intrinsics_for(Config().camera, 320, 240, (320, 240))
    solve(variables, edges, intrinsics, fixed=frozenset({0}), iterations=2)
    one = np.ones(len(px))
    matches = StaticMatches(px, one, one, px + moved, one, intrinsics.values)
    matches.system(np.eye(4), 1.0)
    matches.quality(np.eye(4))


PARTS: dict[str, Callable[[], None]] = {"tracking": _tracking, "map": _map}
