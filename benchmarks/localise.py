"""Images found in a saved map: how many, how near to the truth, and whether images of other places are refused.

    python benchmarks/localise.py --data DATA --out benchmarks/results/localise.json [--only NAME …] [--stride N]

A map is made of the first frames of a sequence (``mastd3r run --end … --no-map``, ``save_map``). Every image is looked
for by itself, without the one before it; "as a video" is the same with it. The map is brought to the truth by one
Sim(3) over the poses of the frames that it was made of. Wrong: found farther than 0.1 m or 5 degrees from where it was
taken, or in a place where it was not taken at all. Entries of an existing file that are not measured again stay.
"""

from __future__ import annotations

import argparse
import json
import sys
import tempfile
import time
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

import mastd3r
from mastd3r.config import Config, SourceConfig
from mastd3r.evaluation.trajectory_error import associate, rotation_angle_rad, umeyama
from mastd3r.export.machine import machine_info
from mastd3r.geometry.sim3 import Sim3
from mastd3r.sources import open_source
from mastd3r.tracking.localisation import Place
from mastd3r.types import Source

Array = NDArray[Any]
NEAR_M, NEAR_DEG = 0.02, 1.0
WRONG_M, WRONG_DEG = 0.1, 5.0
ONE_WORLD_M = 2.0  # about how far things are in kitchen


@dataclass(frozen=True)
class Case:
    """A map, and images that are looked for in it."""

    of: str  # sequence
    end: int  # of the frames that it is made of
    images: str  # sequence
    start: int
    as_video: bool = False
    focal_ratio: float = 0.0  # of the images' width; 0: the map's lens
    elsewhere: bool = False  # none of the images shows the map's place


CASES = {
    "kitchen 0-199: kitchen 200-399": Case("kitchen", 200, "kitchen", 200),
    "the same as a video": Case("kitchen", 200, "kitchen", 200, as_video=True),
    "kitchen 0-199: kitchen_walk_close (200-399, someone near)": Case("kitchen", 200, "kitchen_walk_close", 0),
    "kitchen 0-199: lobby": Case("kitchen", 200, "lobby", 0, focal_ratio=0.9, elsewhere=True),
    "kitchen 0-199: cabinet": Case("kitchen", 200, "cabinet", 0, elsewhere=True),
    "kitchen 0-199: tsukuba": Case("kitchen", 200, "tsukuba", 0, elsewhere=True),
    "kitchen 0-199: bedroom": Case("kitchen", 200, "bedroom", 0, focal_ratio=0.9, elsewhere=True),
    "lobby 0-94: kitchen": Case("lobby", 95, "kitchen", 0, focal_ratio=0.8, elsewhere=True),
}


def measured(case: Case, data: Path, folder: Path, stride: int) -> dict[str, Any]:
    """One case and its figures."""
    rec, saved = _made(case, data, folder)
    source = open_source(data / case.images, replace(SourceConfig(), start=case.start, stride=stride))
    given = (case.focal_ratio * source.size[0],) if case.focal_ratio else ()
    times, places, before = [], [], None
    began, busy = time.perf_counter(), time.process_time()
    for frame in source.frames():
        found = saved.localise(frame.image, intrinsics=given, near=before if case.as_video else None)
        before = found if isinstance(found, Place) else None
        times.append(frame.timestamp_s)
        places.append(before)
    entry: dict[str, Any] = {
        "keyframes": len(saved.poses),
        "images": len(times),
        "found": sum(p is not None for p in places),
        "wall_s_an_image": round((time.perf_counter() - began) / len(times), 3),
        "core_s_an_image": round((time.process_time() - busy) / len(times), 3),
    }
    if case.elsewhere:
        return entry | {"wrong": entry["found"]}
    truth = open_source(data / case.of, Config().source)
    return entry | _errors(rec, truth, np.array(times), places)


def _made(case: Case, data: Path, folder: Path) -> tuple[mastd3r.Reconstruction, mastd3r.SavedMap]:
    run, path = folder / f"{case.of}-{case.end}", folder / f"{case.of}-{case.end}-map"
    if not (run / "report.html").is_file():
        config = Config(source=SourceConfig(end=case.end))
        rec = mastd3r.reconstruct(data / case.of, run, replace(config, mapping=replace(config.mapping, enabled=False)))
    rec = mastd3r.load(run)
    return rec, mastd3r.save_map(rec, path)


def _errors(rec: mastd3r.Reconstruction, source: Source, times_s: Array, places: list[Place | None]) -> dict[str, Any]:
    truth = source.truth()
    assert truth is not None
    rows, true_rows = associate(rec.timestamps_s, truth.timestamps_s, 0.02)
    sim = _aligned(rec.poses[rows], truth.world_from_cam[true_rows], ONE_WORLD_M)
    which, true_rows = associate(times_s, truth.timestamps_s, 0.02)
    off_m, off_deg, sigmas_m, sigmas_deg, found_near = [], [], [], [], []
    for n, row in zip(which, true_rows, strict=True):
        place = places[n]
        if place is None:
            found_near.append(False)
            continue
        true = truth.world_from_cam[row]
        at = sim.scale * sim.rotation @ place.world_from_cam[:3, 3] + sim.translation
        turn = (sim.rotation @ place.world_from_cam[:3, :3]).T @ true[:3, :3]
        off_m.append(float(np.linalg.norm(at - true[:3, 3])))
        off_deg.append(float(np.degrees(rotation_angle_rad(turn))))
        sigmas_m.append(off_m[-1] / (sim.scale * place.position_sigma))
        sigmas_deg.append(off_deg[-1] / place.rotation_sigma_deg)
        found_near.append(off_m[-1] <= NEAR_M and off_deg[-1] <= NEAR_DEG)
    metres, degrees = np.array(off_m), np.array(off_deg)
    return {
        "near": sum(found_near),
        "near_ratio": sum(found_near) / len(which),
        "wrong": int(((metres > WRONG_M) | (degrees > WRONG_DEG)).sum()),
        "median_m": float(np.median(metres)),
        "percentile_95_m": float(np.percentile(metres, 95)),
        "median_deg": float(np.median(degrees)),
        "percentile_95_deg": float(np.percentile(degrees, 95)),
        "within_2_sigma_position": float((np.array(sigmas_m) <= 2).mean()),
        "within_2_sigma_rotation": float((np.array(sigmas_deg) <= 2).mean()),
        "by_seconds": _by_time(times_s[which], [places[n] is not None for n in which], found_near),
    }


def _aligned(poses: Array, true_poses: Array, length_m: float) -> Sim3:
    """The Sim(3) of poses (n, 4, 4): of their positions, and of points ``length_m`` along each camera's axes.

    Positions alone leave the turn of a short path open, and an image is looked for far from it.
    """
    scale = umeyama(poses[:, :3, 3], true_poses[:, :3, 3]).scale
    for _ in range(10):
        sim = umeyama(_with_axes(poses, length_m / scale), _with_axes(true_poses, length_m))
        scale = sim.scale
    return sim


def _by_time(times_s: Array, found: list[bool], near: list[bool]) -> list[list[float]]:
    """[first second, images, found, near] of every fifth of the images."""
    parts = np.array_split(np.arange(len(times_s)), 5)
    return [[float(times_s[p[0]]), len(p), sum(found[n] for n in p), sum(near[n] for n in p)] for p in parts if len(p)]


def _with_axes(poses: Array, length: float) -> Array:
    ends = [poses[:, :3, 3] + length * poses[:, :3, k] for k in range(3)]
    return np.concatenate([poses[:, :3, 3], *ends])


def main() -> int:
    """All cases; the file is written after each."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--data", type=Path, required=True, help="folder that holds the sequences")
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--only", nargs="+", help="names of cases")
    parser.add_argument("--stride", type=int, default=1, help="every n-th image")
    parser.add_argument("--runs", type=Path, help="folder for the runs that maps are made of; kept, and taken again")
    args = parser.parse_args()
    entries: dict[str, Any] = json.loads(args.out.read_text()) if args.out.is_file() else {}
    machine = machine_info()
    with tempfile.TemporaryDirectory() as folder:
        for name, case in CASES.items():
            if args.only and name not in args.only:
                continue
            entry = measured(case, args.data, args.runs or Path(folder), args.stride)
            entry["made"] = {
                "date": datetime.now(UTC).date().isoformat(),
                "commit": machine["git_commit"],
                "processor": machine["processor"],
                "stride": args.stride,
            }
            entries[name] = entry
            print(name, json.dumps(entry), flush=True)
            args.out.write_text(json.dumps(entries, indent=1) + "\n")
    return 0


if __name__ == "__main__":
    sys.exit(main())
