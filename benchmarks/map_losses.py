"""The paper's Table V, and what each part of the default map is worth: one tracking, many maps; writes JSON.

    python benchmarks/map_losses.py --data DIR --out benchmarks/results/map_losses.json [--runs DIR]

kitchen_walk is tracked once with default options. Then one map a loss and seed is trained on the same material, and
its holdout renders are compared with the CLEAN frames (those of kitchen at the same times): over the whole image,
and only where a person hides the room. Finished rows of an existing file are kept; delete it to start again.
A schedule shorter than the default (--iterations, --gaussians) keeps the table affordable; it is written beside it.
"""

from __future__ import annotations

import argparse
import json
import pickle
import sys
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from mastd3r.config import Config, MappingConfig, with_override
from mastd3r.evaluation.image_error import psnr, ssim
from mastd3r.export.machine import machine_info
from mastd3r.mapping.mapper import Mapper
from mastd3r.offline.tracked import MapMaterial
from mastd3r.pipeline import material_for_map
from mastd3r.sources import open_source

SEQUENCE, CLEAN = "kitchen_walk", "kitchen"
LOSSES = ("plain", "mask", "uncertainty", "full")
ABLATION = {  # row -> options of section mapping
    "default": [],
    "no D-SSIM term": ["ssim_share=0.0"],
    "no exposure": ["exposure=false"],
    "poses refined": ["refine_poses=true"],
    "hard weight": ["hard_weight=true"],
    "loss as printed": ["paper_loss=true", "hard_weight=true", "exposure=false"],
    "harmonics of degree 1": ["sh_degree=1"],
    "harmonics of degree 3": ["sh_degree=3"],
}
LEAST_HIDDEN_PX = 50  # frames with fewer hidden pixels do not count for the second figure
Pictures = dict[float, tuple[np.ndarray, np.ndarray | None]]


def material(sequence: Path, runs: Path, width_px: int) -> MapMaterial:
    """What maps are trained from, images of ``width_px``; tracked once and kept beside the run."""
    kept = runs / f"{sequence.name}-material-{width_px}.pkl"
    if kept.is_file():
        with kept.open("rb") as file:
            found: MapMaterial = pickle.load(file)  # our own file, written below
            return found
    config = Config()
    found = material_for_map(
        sequence, runs / sequence.name, replace(config, mapping=replace(config.mapping, width_px=width_px))
    )
    with kept.open("wb") as file:
        pickle.dump(found, file)
    return found


def clean_pictures(sequence: Path, clean: Path, times_s: list[float], size: tuple[int, int]) -> Pictures:
    """time -> clean photograph at map size (0..1), and True where something moved in front, if that is known."""
    frames = {round(f.timestamp_s, 6): f.image for f in open_source(clean, Config().source).frames()}
    truth = open_source(sequence, Config().source).truth()
    files = {round(t, 6): file for t, file in truth.moving_files.items()} if truth else {}
    found: Pictures = {}
    for time_s in (round(t, 6) for t in times_s):
        hidden = None
        if time_s in files:
            hidden = cv2.resize(cv2.imread(files[time_s], 0), size, interpolation=cv2.INTER_NEAREST) > 127
        found[time_s] = cv2.resize(frames[time_s], size, interpolation=cv2.INTER_AREA) / 255.0, hidden
    return found


def trained(given: MapMaterial, config: MappingConfig, seed: int, pictures: Pictures) -> dict[str, Any]:
    """One map, and the figures of its holdout renders."""
    began = time.perf_counter()
    mapper = Mapper(config, given.cloud, given.seen.views, seed)
    mapper.refine(config.iterations or 0)
    mapper.settle()
    seconds = time.perf_counter() - began
    whole, hidden, similar = [], [], []
    for place in given.seen.holdout:
        if not np.isfinite(place.world_from_cam).all():
            continue
        time_s = place.record.timestamp_s
        color, _, _ = mapper.render(place.world_from_cam, given.map_view.pinhole)
        drawn = given.map_view.as_photograph(color).clip(0, 1)
        truth, moved = pictures[round(time_s, 6)]
        whole.append(psnr(drawn, truth))
        similar.append(ssim(drawn, truth))
        if moved is not None and moved.sum() > LEAST_HIDDEN_PX:
            hidden.append(psnr(drawn, truth, moved))
    return {
        "psnr_whole": float(np.mean([v for v in whole if v is not None])),
        "psnr_hidden": float(np.mean([v for v in hidden if v is not None])),
        "ssim_whole": float(np.mean([v for v in similar if v is not None])),
        "psnr_worst": float(min(v for v in whole if v is not None)),
        "views": len(whole),
        "views_hidden": len(hidden),
        "gaussians": len(mapper.gaussians.means),
        "train_s": round(seconds, 1),
    }


def options_of(rows: list[str], base: MappingConfig) -> MappingConfig:
    """The base with some options of section mapping."""
    config = replace(Config(), mapping=base)
    for row in rows:
        config = with_override(config, f"mapping.{row}")
    return config.mapping


def wanted(base: MappingConfig, seeds: list[int], ablation: bool) -> dict[str, tuple[MappingConfig, int]]:
    """Row name -> options and seed."""
    rows = {f"{loss}, seed {seed}": (replace(base, loss=loss), seed) for seed in seeds for loss in LOSSES}
    if ablation:
        rows |= {f"ablation: {name}": (options_of(options, base), seeds[0]) for name, options in ABLATION.items()}
    return rows


def main() -> int:
    """Train what is missing; the file is rewritten after every map."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--data", type=Path, required=True, help="folder that holds kitchen_walk and kitchen")
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--runs", type=Path, default=Path("runs"))
    parser.add_argument("--iterations", type=int, default=1000)
    parser.add_argument("--gaussians", type=int, default=30000)
    parser.add_argument("--width", type=int, default=320, help="of the images, in pixels")
    parser.add_argument("--seeds", type=int, nargs="+", default=[0, 1, 2])
    parser.add_argument("--no-ablation", action="store_true")
    parser.add_argument("--only", nargs="*", default=None, help="rows to train, by name")
    args = parser.parse_args()
    args.runs.mkdir(parents=True, exist_ok=True)
    schedule = {"sequence": SEQUENCE, "clean": CLEAN, "iterations": args.iterations, "max_gaussians": args.gaussians}
    done: dict[str, Any] = (
        json.loads(args.out.read_text()) if args.out.is_file() else {"schedule": schedule, "rows": {}}
    )
    if done["schedule"] != schedule:
        parser.error(f"{args.out}: expected the schedule {schedule}, got {done['schedule']}; delete it to start again")
    base = replace(MappingConfig(), iterations=args.iterations, max_gaussians=args.gaussians, device="cpu")
    given, info = material(args.data / SEQUENCE, args.runs, args.width), machine_info()
    camera = given.map_view.camera
    times_s = [place.record.timestamp_s for place in given.seen.holdout]
    pictures = clean_pictures(args.data / SEQUENCE, args.data / CLEAN, times_s, (camera.width, camera.height))
    for name, (config, seed) in wanted(base, args.seeds, not args.no_ablation).items():
        if name in done["rows"] or (args.only is not None and name not in args.only):
            continue
        row = {"seed": seed, **trained(given, config, seed, pictures)}
        row |= {"date": time.strftime("%Y-%m-%d"), "git_commit": info["git_commit"]}
        done["rows"][name] = row
        args.out.write_text(json.dumps(done, indent=1) + "\n")
        print(name, {k: row[k] for k in ("psnr_whole", "psnr_hidden", "train_s")}, flush=True)
    return 0


if __name__ == "__main__":
    sys.exit(main())
