"""What the masks are worth: ablation of every evidence term, false positives, cost, and what they do for the pose.

usage: python benchmarks/masks.py --data DIR --out benchmarks/results/masks.json [--what PART …] [--only SEQUENCE …]
Parts: ablation (IoU of the default on all frames, and of each variant on those in the middle of the sequence), static
(false positives where nothing moves), cost (of tracking: with masks less without), twin (ATE of kitchen_walk against
the clean kitchen, five starts), off (ATE without masks, five starts), perfect (ATE with the true masks given, five
starts). A sequence is tracked once for all parts that ask the same of it. Finished entries of an existing file are
kept, so a run that was stopped goes on.
``--sheets DIR`` writes contact sheets there (the pictures stay with the reader).
"""

from __future__ import annotations

import argparse
import json
import time
from collections.abc import Callable
from dataclasses import astuple, dataclass, replace
from itertools import islice
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from mastd3r.camera.map_view import MapView
from mastd3r.concurrency import one_blas_thread
from mastd3r.config import Config, with_override
from mastd3r.evaluation.evaluate import evaluate_trajectory
from mastd3r.evaluation.mask_error import mask_error, read_mask
from mastd3r.evaluation.trajectory_error import ate_rmse
from mastd3r.export.machine import machine_info
from mastd3r.export.pictures import mask_overlay
from mastd3r.offline.final_solve import FinalFrame, final_frames, finish_graph, trajectory_of
from mastd3r.offline.smoothing import FrameMask, SmoothingContext, smooth_masks
from mastd3r.parts import dynamics_beside
from mastd3r.slam import Slam
from mastd3r.sources import open_source
from mastd3r.types import Source

MOVING = ("kitchen_walk", "kitchen_walk_close", "lobby_walk", "car")
STILL = ("kitchen", "lobby")
LOOKED_AT = ("jam", "cafe", "bedroom")
VARIANTS: dict[str, tuple[str, ...]] = {
    "ours": (),
    "without motion": ("motion.enabled=false",),
    "without semantics in the fusion": ("semantic.enabled=false",),
    "without time": ("temporal.enabled=false",),
    "without appearance": ("appearance.enabled=false",),
    "without frames after": ("temporal.backward=false",),
    "without support": ("support.enabled=false",),
    "without regions": ("refinement.enabled=false",),
    "without colours": ("colours.enabled=false",),
    "frames 12 apart, too": ("temporal.smoother_gaps=[1, 4, 12]",),
    "paper, eq. (1)-(4)": ("variant=paper",),
}
PERFECT = (
    "semantic.evidence_share=0.0",
    "semantic.gain=1.0",
    "semantic.floor=0.001",
    "semantic.missed=0.001",
    "appearance.enabled=false",
)
STARTS = range(5)
COST_FRAMES = 200
ABLATED = 48  # frames in the middle of each sequence that variants are compared on
TRACKED = ("ate_rmse_all", "ate_rmse_keyframes", "frames_posed")


@one_blas_thread()
def main() -> int:
    """Run what is asked for and missing; the file is rewritten after every entry."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--data", type=Path, required=True, help="folder that holds the sequences")
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--what", nargs="*", default=list(PARTS), choices=list(PARTS))
    parser.add_argument("--only", nargs="*", default=None, help="sequences")
    parser.add_argument("--sheets", type=Path, default=None, help="where contact sheets go")
    args = parser.parse_args()
    results = Results(args.data, args.out)
    for part in args.what:
        PARTS[part](args, results)
    return 0


@dataclass(frozen=True)
class Task:
    """One way to track one sequence."""

    sequence: str
    semantics: str
    start: int = 0
    end: int | None = None
    dynamics: tuple[str, ...] = ()  # overrides of options of the mask
    maps: str | None = None  # folder of the sequence whose images are given as maps

    def config(self) -> Config:
        """All options."""
        config = replace(Config(), semantics=self.semantics)
        config = replace(config, source=replace(config.source, start=self.start, end=self.end))
        return _with_masks(config, self.dynamics)


def _with_masks(config: Config, overrides: tuple[str, ...]) -> Config:
    for words in overrides:
        config = with_override(config, f"dynamics.{words}")
    return config


class Results:
    """The file of figures, and the sequence that was tracked last."""

    def __init__(self, data: Path, out: Path) -> None:
        self.data, self.out = data, out
        self.done: dict[str, Any] = json.loads(out.read_text()) if out.is_file() else {}
        self._task: Task | None = None
        self._tracked: Tracked | None = None

    def keep(self, where: tuple[str, ...], entry: Callable[[], dict[str, Any]]) -> dict[str, Any]:
        """The entry under these keys, which is made only if it is not there."""
        place = self.done
        for key in where[:-1]:
            place = place.setdefault(key, {})
        if where[-1] not in place:
            info = machine_info()
            stamp = {k: info[k] for k in ("git_commit", "processor", "cores")} | {"date": time.strftime("%Y-%m-%d")}
            figures = entry()
            place[where[-1]] = figures | stamp
            self.out.write_text(json.dumps(self.done, indent=1) + "\n")
            print(*where, figures, flush=True)
        found: dict[str, Any] = place[where[-1]]
        return found

    def tracked(self, task: Task) -> Tracked:
        """The sequence tracked that way; only the last one is held."""
        if self._tracked is None or self._task != task:
            self._tracked = None
            self._task, self._tracked = task, Tracked(self.data, task)
        return self._tracked

    def poses(self, task: Task) -> dict[str, Any]:
        """ATE and times of tracking that way; kept in the file."""
        name = ", ".join(str(v) for v in astuple(task) if v not in (None, 0, ()))
        kept = self.keep(("tracking", name), lambda: self.tracked(task).figures)
        return {k: kept[k] for k in TRACKED}


class Tracked:
    """One sequence, tracked and solved once, for as many smoothing passes as are wanted."""

    def __init__(self, data: Path, task: Task) -> None:
        self.config = config = task.config()
        folder = data / task.sequence
        maps = None if task.maps is None else folder / task.maps
        self.source: Source = open_source(
            folder, config.source, want_depth=False, want_semantic=task.semantics == "maps", semantic_dir=maps
        )
        self.slam = Slam(config, self.source.size, source=self.source)
        frames, clock, cpu = 0, time.perf_counter(), time.process_time()
        for frame in self.slam.prefetched(self.source.frames()):
            self.slam.track(frame)
            frames += 1
        self.slam.end_tracking()
        self.frame_s = (time.perf_counter() - clock) / frames
        self.frame_cpu_s = (time.process_time() - cpu) / frames
        finish_graph(self.slam.graph, config)
        self.final: list[FinalFrame] = final_frames(self.slam.graph)
        self.figures = dict.fromkeys(TRACKED) | self._poses()

    def _poses(self) -> dict[str, Any]:
        trajectory, truth = trajectory_of(self.final), self.source.truth()
        if truth is None or not len(truth.timestamps_s):
            return {"frames_posed": int(np.isfinite(trajectory.world_from_cam).all((1, 2)).sum())}
        found = evaluate_trajectory(trajectory, truth, trajectory.timestamps_s).metrics
        return {
            "ate_rmse_all": found["ate_rmse_all"],
            "ate_rmse_keyframes": ate_rmse(trajectory.keyframes(), truth).rmse,
            "frames_posed": found["frames_posed"],
        }

    def masks(
        self,
        overrides: tuple[str, ...],
        each: Callable[[FrameMask], None] | None = None,
        frames: tuple[int, int] | None = None,
    ) -> dict[str, Any]:
        """Figures of the smoothing pass under other options of the mask; ``frames``: from, and one past the last."""
        config = _with_masks(self.config, overrides)
        config = replace(config, mapping=replace(config.mapping, enabled=False))
        truth = self.source.truth()
        files = {} if truth is None else truth.moving_files
        pairs: list[tuple[Any, Any]] = []

        def on_mask(seen: FrameMask) -> None:
            levels = np.ceil(np.clip(seen.over_photograph, 0, 1) * 255 - 0.5).astype(np.uint8)
            file = files.get(seen.timestamp_s)
            pairs.append((levels, None if file is None else read_mask(file)))
            if each is not None:
                each(seen)

        map_view = MapView(self.slam.graph.camera().resized(*self.source.size), 320, 2.0)
        known = self.slam.masks.filter.appearance
        learned = None if known is None else known.copy()
        parts = replace(self.slam.parts, dynamics=dynamics_beside(self.slam.parts.semantics, config.dynamics))
        context = SmoothingContext(self.final, self.slam.graph, parts, config, map_view, appearance=learned)
        smooth_masks(islice(self.source.frames(), *(frames or (None,))), context, on_mask)
        found = mask_error(pairs)
        return {"iou": found.iou, "false_positives": found.false_positive_ratio, "moving": found.called_moving_ratio}

    def middle(self) -> tuple[int, int]:
        """The frames that variants are compared on."""
        first = max(0, (len(self.final) - ABLATED) // 2)
        return first, min(len(self.final), first + ABLATED)


def ablation(args: argparse.Namespace, results: Results) -> None:
    """IoU of every variant, with and without the maps that come with the sequence."""
    for name in (n for n in MOVING if args.only is None or n in args.only):
        for semantics in ("none", "maps"):
            _ablate(results, Task(name, semantics))


def _ablate(results: Results, task: Task) -> None:
    where = "ablation", f"{task.sequence}, {task.semantics}"
    results.poses(task)  # first, as it holds what the masks are made from
    results.keep((*where, "ours, all frames"), lambda: results.tracked(task).masks(()))
    for variant, overrides in VARIANTS.items():
        if task.semantics == "maps" or "semantics" not in variant:
            results.keep((*where, variant), lambda o=overrides: _of_middle(results.tracked(task), o))  # type: ignore[misc]


def _of_middle(tracked: Tracked, overrides: tuple[str, ...]) -> dict[str, Any]:
    frames = tracked.middle()
    return tracked.masks(overrides, frames=frames) | {"frames": list(frames)}


def static(args: argparse.Namespace, results: Results) -> None:
    """What is called moving where nothing moves, and in the sequences that are only looked at."""
    for name in (n for n in STILL + LOOKED_AT if args.only is None or n in args.only):
        results.keep(("static", name), lambda n=name: _looked_at(args, results, n))  # type: ignore[misc]


def _looked_at(args: argparse.Namespace, results: Results, name: str) -> dict[str, Any]:
    pictures: list[Any] = []
    tracked = results.tracked(Task(name, "none"))
    figures = tracked.masks((), lambda seen: pictures.append(_small_overlay(seen)))
    if args.sheets is not None:
        args.sheets.mkdir(parents=True, exist_ok=True)
        chosen = [pictures[int(i)] for i in np.linspace(0, len(pictures) - 1, min(24, len(pictures)))]
        chosen += [np.zeros_like(chosen[0])] * (-len(chosen) % 4)
        sheet = np.vstack([np.hstack(chosen[i : i + 4]) for i in range(0, len(chosen), 4)])
        cv2.imwrite(str(args.sheets / f"{name}.jpg"), sheet[..., ::-1])
    return figures


def _small_overlay(seen: FrameMask) -> Any:
    picture = mask_overlay(seen.image, np.rint(255 * seen.mask.probability).astype(np.uint8))
    return cv2.resize(picture, None, fx=360 / picture.shape[1], fy=360 / picture.shape[1], interpolation=cv2.INTER_AREA)


def cost(args: argparse.Namespace, results: Results) -> None:
    """Tracking with masks and without, in turn, where they change nothing else: the same keyframes are made."""

    def entry() -> dict[str, Any]:
        tasks = {"with": Task("kitchen", "none", end=COST_FRAMES)}
        tasks["without"] = replace(tasks["with"], dynamics=("variant=none",))
        Tracked(args.data, replace(tasks["with"], end=60))  # compiled, and in memory
        runs: dict[str, list[tuple[float, float, int]]] = {name: [] for name in tasks}
        for name in [*tasks] * 3:
            t = Tracked(args.data, tasks[name])
            runs[name].append((t.frame_s, t.frame_cpu_s, len(t.slam.graph.keyframes)))
        (wall, cpu, kf), (wall_without, cpu_without, kf_without) = (np.median(r, 0).tolist() for r in runs.values())
        return {
            "frame_s": {"with": wall, "without": wall_without},
            "frame_cpu_s": {"with": cpu, "without": cpu_without},
            "keyframes": {"with": kf, "without": kf_without},
            "share": 1 - wall_without / wall,
            "share_cpu": 1 - cpu_without / cpu,
        }

    results.keep(("cost", "kitchen"), entry)


def twin(_args: argparse.Namespace, results: Results) -> None:
    """The same camera path with and without people in the way, from five frames on."""
    for start in STARTS:
        tasks = {
            "kitchen, clean": Task("kitchen", "none", start, 240),
            "kitchen_walk, no semantics": Task("kitchen_walk", "none", start),
            "kitchen_walk, maps": Task("kitchen_walk", "maps", start),
        }
        for name, task in tasks.items():
            results.keep(("twin", f"{name}, start {start}"), lambda t=task: results.poses(t))  # type: ignore[misc]


def off(_args: argparse.Namespace, results: Results) -> None:
    """Tracking is the same for every seed, so the five trials start at five frames."""
    for start in STARTS:
        for name, dynamics in (("masks", ()), ("no masks", ("variant=none",))):
            task = Task("kitchen_walk", "none", start, dynamics=dynamics)
            results.keep(("off", f"{name}, start {start}"), lambda t=task: results.poses(t))  # type: ignore[misc]


def perfect(_args: argparse.Namespace, results: Results) -> None:
    """The true masks as maps, believed, from the same five frames on."""
    for start in STARTS:
        task = Task("kitchen_walk", "maps", start, dynamics=PERFECT, maps="mask")
        results.keep(("perfect", f"the true masks given, start {start}"), lambda t=task: results.poses(t))  # type: ignore[misc]


PARTS = {"ablation": ablation, "static": static, "cost": cost, "twin": twin, "off": off, "perfect": perfect}

if __name__ == "__main__":
    raise SystemExit(main())
