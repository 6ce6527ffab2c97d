"""What a loop correction does to a trained map: keyframes move by 5 cm, the map follows; writes JSON.

    python benchmarks/loop_correction.py --data DIR --out benchmarks/results/loop_correction.json [--runs DIR]

kitchen is tracked once with default options. Then its keyframes, cloud and views are bent as drift would: keyframe k
of n is pushed aside by 5 cm * k / (n - 1), with truth's scale. The map is trained on that. The correction puts every
keyframe back (Mapper.move_keyframes), nothing restarts. Figures: PSNR of the holdout frames before, right after, and
after a few more steps; the same from the tracked poses alone, without what the map has learned of the poses of the
views around; and, for comparison, what the corrected poses show where the map does not follow.
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from copy import copy
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from map_losses import Pictures, clean_pictures, material
from mastd3r.concurrency import one_blas_thread
from mastd3r.config import Config
from mastd3r.evaluation.image_error import psnr
from mastd3r.evaluation.trajectory_error import ate_rmse
from mastd3r.export.machine import machine_info
from mastd3r.export.trajectory_files import read_tum
from mastd3r.mapping.correction import changes_of
from mastd3r.mapping.mapper import Mapper
from mastd3r.offline.tracked import MapMaterial
from mastd3r.sources import open_source

SEQUENCE, MOVED_M, BOUND_DB = "kitchen", 0.05, 0.5
WIDTH_PX = 320  # of the images


def metres_per_unit(sequence: Path, run: Path) -> float:
    """Scale of the map, from truth."""
    truth = open_source(sequence, Config().source).truth()
    scale = ate_rmse(read_tum(run / "trajectory.txt"), truth).scale if truth else None
    if scale is None:
        raise SystemExit(f"{sequence}: expected truth that fixes the scale, got none")
    return scale


def drift_of(keyframes: list[int], shift: float) -> dict[int, np.ndarray]:
    """(4, 4) of each keyframe: pushed along x, the last one by ``shift``."""
    out = {}
    for n, kf in enumerate(keyframes):
        out[kf] = np.eye(4)
        out[kf][0, 3] = shift * n / max(1, len(keyframes) - 1)
    return out


def distorted(given: MapMaterial, drift: dict[int, np.ndarray]) -> MapMaterial:
    """Cloud and views where their keyframes have drifted to."""
    shift = np.stack([drift[int(k)][:3, 3] for k in given.cloud.kf_id])
    cloud = replace(given.cloud, points_world=(given.cloud.points_world + shift).astype(np.float32))
    views = [replace(v, world_from_cam=drift[v.kf_id] @ v.world_from_cam) for v in given.seen.views]
    return replace(given, cloud=cloud, seen=replace(given.seen, views=views))


def quality(
    mapper: Mapper, given: MapMaterial, drift: dict[int, np.ndarray], pictures: Pictures, *, refined: bool = True
) -> float:
    """Mean PSNR of the holdout frames from where their keyframes are; ``refined``: under the map's pose corrections."""
    figures = []
    mapper = mapper if refined else with_tracked_poses(mapper)
    for place in given.seen.holdout:
        if np.isfinite(place.world_from_cam).all():
            pose, time_s = drift[place.record.kf_id] @ place.world_from_cam, place.record.timestamp_s
            pose = mapper.refined_pose(pose, time_s)
            drawn = given.map_view.as_photograph(mapper.render(pose, given.map_view.pinhole)[0])
            figures.append(psnr(drawn.clip(0, 1), pictures[round(time_s, 6)][0]))
    return float(np.mean([f for f in figures if f is not None]))


def with_tracked_poses(mapper: Mapper) -> Mapper:
    """A copy that only draws, and corrects no pose. It shares everything else with ``mapper``."""
    other = copy(mapper)
    other._view_parameters = copy(mapper._view_parameters)
    other._view_parameters._refine_poses = False
    return other


def by_anchors(mapper: Mapper, drift: dict[int, np.ndarray], right: dict[int, np.ndarray]) -> Mapper:
    """A copy that only draws, every Gaussian moved with its anchor. It shares exposures and poses with ``mapper``."""
    other = copy(mapper)
    other._map = mapper._map.moved(changes_of(drift, right))
    return other


@one_blas_thread()
def main() -> int:
    """Train, correct, train on."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--data", type=Path, required=True, help="folder that holds kitchen")
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--runs", type=Path, default=Path("runs"))
    parser.add_argument("--iterations", type=int, default=1000)
    parser.add_argument("--gaussians", type=int, default=30000)
    parser.add_argument(
        "--after", type=int, nargs="+", default=[10, 20, 50, 100], help="steps after the correction to measure at"
    )
    args = parser.parse_args()
    args.runs.mkdir(parents=True, exist_ok=True)
    given = material(args.data / SEQUENCE, args.runs, WIDTH_PX)
    size = given.map_view.camera.width, given.map_view.camera.height
    times_s = [place.record.timestamp_s for place in given.seen.holdout]
    pictures = clean_pictures(args.data / SEQUENCE, args.data / SEQUENCE, times_s, size)
    shift = MOVED_M / metres_per_unit(args.data / SEQUENCE, args.runs / SEQUENCE)
    keyframes = sorted({int(k) for k in given.cloud.kf_id} | {v.kf_id for v in given.seen.views})
    keyframes = sorted({*keyframes, *(p.record.kf_id for p in given.seen.holdout)})
    drift, right = drift_of(keyframes, shift), drift_of(keyframes, 0.0)
    config = replace(
        Config().mapping,
        iterations=args.iterations + max(args.after),
        max_gaussians=args.gaussians,
        device="cpu",
        refine_poses=True,
    )
    drifted = distorted(given, drift)
    mapper = Mapper(config, drifted.cloud, drifted.seen.views, 0)
    mapper.refine(args.iterations)
    figures = {"before_db": quality(mapper, given, drift, pictures)}
    figures["before_tracked_db"] = quality(mapper, given, drift, pictures, refined=False)
    figures["map_left_behind_db"] = quality(mapper, given, right, pictures)
    figures["anchors_only_db"] = quality(by_anchors(mapper, drift, right), given, right, pictures)
    began = time.perf_counter()
    mapper.move_keyframes(drift, right)
    figures["correction_s"] = round(time.perf_counter() - began, 2)
    figures["after_db"] = quality(mapper, given, right, pictures)
    figures["after_tracked_db"] = quality(mapper, given, right, pictures, refined=False)
    refined, done = {}, 0
    for steps in sorted(args.after):
        mapper.refine(steps - done)
        done, refined[str(steps)] = steps, quality(mapper, given, right, pictures)
    result: dict[str, Any] = {
        "sequence": SEQUENCE,
        "moved_m": MOVED_M,
        "keyframes": len(keyframes),
        "iterations": args.iterations,
        "max_gaussians": args.gaussians,
        **figures,
        "refined_db": refined,
        "bound_db": BOUND_DB,
        "holds": figures["after_db"] >= figures["before_db"] - BOUND_DB,
        "date": time.strftime("%Y-%m-%d"),
        "git_commit": machine_info()["git_commit"],
    }
    args.out.write_text(json.dumps(result, indent=1) + "\n")
    print(json.dumps(result))
    return 0


if __name__ == "__main__":
    sys.exit(main())
