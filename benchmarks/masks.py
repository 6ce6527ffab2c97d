"""What the masks are worth: ablation of every evidence term, false positives, cost, and what they do for the pose.

usage: python benchmarks/masks.py --data DIR --out benchmarks/results/masks.json [--what PART …] [--only SEQUENCE …]
Parts: ablation (IoU of each variant; one tracking result a sequence), static (false positives where nothing moves),
cost (share of tracking time), twin (ATE of kitchen_walk against the clean kitchen), off (ATE without masks, five
starts), perfect (ATE with the true masks given). Finished entries of an existing file are kept. The overlay of every
frame is masks.mp4 in each run folder; ``--sheets DIR`` writes contact sheets there (the pictures stay with the reader).
"""

from __future__ import annotations

import argparse
import json
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from mastd3r.config import Config, with_override
from mastd3r.evaluation.mask_error import mask_error, read_mask
from mastd3r.export.machine import machine_info
from mastd3r.export.pictures import mask_overlay
from mastd3r.finish import FinalFrame, final_frames, finish_graph
from mastd3r.lens_view import LensView
from mastd3r.lookahead import one_blas_thread
from mastd3r.parts import build_parts
from mastd3r.run import run
from mastd3r.second_pass import Look, SeenMask, second_pass
from mastd3r.slam import Slam
from mastd3r.sources import open_source
from mastd3r.types import Source

MOVING = ("kitchen_walk", "kitchen_walk_close", "lobby_walk", "car")
STILL = ("kitchen", "lobby")
LOOKED_AT = ("jam", "cafe", "bedroom")
VARIANTS: dict[str, tuple[str, ...]] = {
    "ours": (),
    "without motion": ("use_motion=false",),
    "without semantics in the fusion": ("use_semantic=false",),
    "without time": ("use_time=false",),
    "without looks (head)": ("use_head=false",),
    "without frames after": ("use_future=false",),
    "without support": ("use_support=false",),
    "without regions": ("use_regions=false",),
    "the tracking's gaps only": ("second_gaps=[1, 4]",),
    "paper, eq. (1)-(4)": ("variant=paper",),
}
PERFECT = ("semantic_share=0.0", "semantic_gain=1.0", "semantic_floor=0.001", "semantic_missed=0.001", "use_head=false")
STARTS = range(5)


@one_blas_thread()
def main() -> int:
    """Run what is asked for and missing; the file is rewritten after every entry."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--data", type=Path, required=True, help="folder that holds the sequences")
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--runs", type=Path, default=Path("runs/masks"))
    parser.add_argument("--what", nargs="*", default=list(PARTS), choices=list(PARTS))
    parser.add_argument("--only", nargs="*", default=None, help="sequences")
    parser.add_argument("--sheets", type=Path, default=None, help="where contact sheets go")
    args = parser.parse_args()
    done: dict[str, Any] = json.loads(args.out.read_text()) if args.out.is_file() else {}

    def keep(part: str, name: str, entry: Callable[[], dict[str, Any]]) -> None:
        if name not in done.setdefault(part, {}):
            info = machine_info()
            stamp = {k: info[k] for k in ("git_commit", "processor", "cores")} | {"date": time.strftime("%Y-%m-%d")}
            done[part][name] = entry() | stamp
            args.out.write_text(json.dumps(done, indent=1) + "\n")
            print(part, name, {k: v for k, v in done[part][name].items() if k not in stamp}, flush=True)

    for part in args.what:
        PARTS[part](args, keep)
    return 0


Keep = Callable[[str, str, Callable[[], dict[str, Any]]], None]


class Tracked:
    """One sequence, tracked and solved once, for as many second passes as are wanted."""

    def __init__(self, folder: Path, semantics: str, end: int | None = None) -> None:
        config = Config()
        self.config = replace(config, semantics=semantics, source=replace(config.source, end=end))  # type: ignore[arg-type]
        source = open_source(folder, self.config.source, want_depth=False, want_semantic=semantics == "maps")
        self.source: Source = source
        self.slam = Slam(self.config, build_parts(self.config, source), source.size)
        self.mask_s = self.tracking_s = 0.0
        belief = self.slam.belief
        belief.prior = self._clocked(belief.prior)  # type: ignore[method-assign]
        belief.update = self._clocked(belief.update)  # type: ignore[method-assign]
        for frame in source.frames():
            began = time.perf_counter()
            self.slam.step(frame)
            self.tracking_s += time.perf_counter() - began
        self.slam.close()
        finish_graph(self.slam.graph, self.config)
        self.final: list[FinalFrame] = final_frames(self.slam.graph)

    def _clocked(self, call: Callable[..., Any]) -> Callable[..., Any]:
        def timed(*given: Any) -> Any:
            began = time.perf_counter()
            try:
                return call(*given)
            finally:
                self.mask_s += time.perf_counter() - began

        return timed

    def masks(self, overrides: tuple[str, ...], each: Callable[[SeenMask], None] | None = None) -> dict[str, Any]:
        """Figures of the second pass under other options of the mask."""
        config = self.config
        for words in overrides:
            config = with_override(config, f"dynamics.{words}")
        config = replace(config, mapping=replace(config.mapping, enabled=False))
        truth = self.source.truth()
        files = {} if truth is None else truth.moving_files
        pairs: list[tuple[Any, Any]] = []

        def on_mask(seen: SeenMask) -> None:
            levels = np.ceil(np.clip(seen.over_photograph, 0, 1) * 255 - 0.5).astype(np.uint8)
            file = files.get(seen.timestamp_s)
            pairs.append((levels, None if file is None else read_mask(file)))
            if each is not None:
                each(seen)

        lens_view = LensView(self.slam.graph.camera().resized(*self.source.size), 320, 2.0)
        look = Look(self.final, self.slam.graph, self.slam.parts, config, lens_view, head=self.slam.belief.head.copy())
        second_pass(self.source.frames(), look, on_mask)
        found = mask_error(pairs)
        return {"iou": found.iou, "false_positives": found.false_positive_ratio, "moving": found.called_moving_ratio}


def ablation(args: argparse.Namespace, keep: Keep) -> None:
    """IoU of every variant, with and without the maps that come with the sequence."""
    for name in (n for n in MOVING if args.only is None or n in args.only):
        for semantics in ("none", "maps"):
            keep("ablation", f"{name}, {semantics}", lambda n=name, s=semantics: _variants(args.data / n, s))  # type: ignore[misc]


def _variants(folder: Path, semantics: str) -> dict[str, Any]:
    tracked = Tracked(folder, semantics)
    names = [v for v in VARIANTS if semantics == "maps" or "semantics" not in v]
    return {v: tracked.masks(VARIANTS[v]) for v in names}


def static(args: argparse.Namespace, keep: Keep) -> None:
    """What is called moving where nothing moves, and in the sequences that are only looked at."""
    for name in (n for n in STILL + LOOKED_AT if args.only is None or n in args.only):
        keep("static", name, lambda n=name: _looked_at(args, n))  # type: ignore[misc]


def _looked_at(args: argparse.Namespace, name: str) -> dict[str, Any]:
    pictures: list[Any] = []
    figures = Tracked(args.data / name, "none").masks((), lambda seen: pictures.append(_small_overlay(seen)))
    if args.sheets is not None:
        args.sheets.mkdir(parents=True, exist_ok=True)
        chosen = [pictures[int(i)] for i in np.linspace(0, len(pictures) - 1, min(24, len(pictures)))]
        chosen += [np.zeros_like(chosen[0])] * (-len(chosen) % 4)
        sheet = np.vstack([np.hstack(chosen[i : i + 4]) for i in range(0, len(chosen), 4)])
        cv2.imwrite(str(args.sheets / f"{name}.jpg"), sheet[..., ::-1])
    return figures


def _small_overlay(seen: SeenMask) -> Any:
    picture = mask_overlay(seen.image, np.rint(255 * seen.mask.probability).astype(np.uint8))
    return cv2.resize(picture, None, fx=360 / picture.shape[1], fy=360 / picture.shape[1], interpolation=cv2.INTER_AREA)


def cost(args: argparse.Namespace, keep: Keep) -> None:
    """The masks' share of tracking, both measured in one process."""

    def entry() -> dict[str, Any]:
        t = Tracked(args.data / "kitchen_walk", "none")
        return {"mask_s": t.mask_s, "tracking_s": t.tracking_s, "share": t.mask_s / t.tracking_s}

    keep("cost", "kitchen_walk", entry)


def _ate(
    args: argparse.Namespace, name: str, sequence: str, maps: Path | None = None, **options: Any
) -> dict[str, Any]:
    """Metrics of a whole run without a map. ``options``: start, end, semantics, dynamics (words)."""
    config = replace(Config(), semantics="maps" if maps else options.get("semantics", "none"))
    config = replace(config, source=replace(config.source, start=options.get("start", 0), end=options.get("end")))
    config = replace(config, mapping=replace(config.mapping, enabled=False))
    for words in options.get("dynamics", ()):
        config = with_override(config, f"dynamics.{words}")
    metrics = run(args.data / sequence, args.runs / name, config, maps=maps).metrics
    return {k: metrics.get(k) for k in ("ate_rmse_all", "ate_rmse_keyframes", "frames_posed", "mask_iou")}


def twin(args: argparse.Namespace, keep: Keep) -> None:
    """The same camera path with and without people in the way."""
    keep("twin", "kitchen, clean", lambda: _ate(args, "twin-clean", "kitchen", end=240))
    keep("twin", "kitchen_walk, no semantics", lambda: _ate(args, "twin-none", "kitchen_walk"))
    keep("twin", "kitchen_walk, maps", lambda: _ate(args, "twin-maps", "kitchen_walk", semantics="maps"))


def off(args: argparse.Namespace, keep: Keep) -> None:
    """Tracking is the same for every seed, so the five trials start at five frames."""
    for start in STARTS:
        on = {"start": start}
        keep("off", f"masks, start {start}", lambda o=on: _ate(args, f"on-{o['start']}", "kitchen_walk", **o))  # type: ignore[misc]
        none = {"start": start, "dynamics": ("variant=none",)}
        keep("off", f"no masks, start {start}", lambda o=none: _ate(args, f"off-{o['start']}", "kitchen_walk", **o))  # type: ignore[misc]


def perfect(args: argparse.Namespace, keep: Keep) -> None:
    """The true masks as maps, believed."""
    maps = args.data / "kitchen_walk" / "mask"
    keep("perfect", "kitchen_walk", lambda: _ate(args, "perfect", "kitchen_walk", maps, dynamics=PERFECT))


PARTS = {"ablation": ablation, "static": static, "cost": cost, "twin": twin, "off": off, "perfect": perfect}

if __name__ == "__main__":
    raise SystemExit(main())
