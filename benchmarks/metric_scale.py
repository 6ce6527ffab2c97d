"""Metric scale: how far each ``--scale`` is from the truth's, and how often its sigma holds.

usage: python benchmarks/metric_scale.py --data DIR --out benchmarks/results/metric_scale.json [--runs DIR]
       [--trials N] [--only NAME …]

Of real sequences: the factor of a finished run (made with ``--no-map`` where ``--runs`` has none of that name) against
that of the Sim(3) to the true poses; error and sigma are relative. ``noisy positions``: every fifth true position with
noise of 2 % of the path's extent, a tenth of them wrong. ``sensor`` is the metre of kitchen's depth sensor in
metres of its poses, found from those two alone, without any map: the depth images of the sequence are moved by true
poses, and compared. Of made maps: in how many of N trials the true factor is within one and two sigma.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
import tempfile
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np
from scipy.optimize import minimize_scalar

from mastd3r.config import SourceConfig
from mastd3r.errors import SlamError
from mastd3r.evaluation.trajectory_error import ate_rmse
from mastd3r.export.machine import machine_info
from mastd3r.export.read_run import read_run
from mastd3r.geometry.se3 import inverse, transform
from mastd3r.metric.estimate import Scale
from mastd3r.metric.material import Material
from mastd3r.metric.measure import measure
from mastd3r.metric.positions import Positions, scale_from_positions
from mastd3r.offline.metres import material_of_run
from mastd3r.sources import open_source
from mastd3r.sources.image_files import read_depth_m
from mastd3r.types import Truth
from metric_worlds import depth_trial, height_trial, held, points_trial, positions_trial

HEIGHT_M = 1.65  # of KITTI's cameras over the road, as its authors say
RUNS: dict[str, tuple[str, list[str], tuple[str, ...]]] = {  # run: sequence, options, ways
    "kitchen": ("kitchen", [], ("depth:{data}", "positions:{data}/groundtruth.txt")),
    "street": ("street", [], (f"camera-height={HEIGHT_M}", "positions:{data}/groundtruth.txt")),
    "jam": ("jam", [], (f"camera-height={HEIGHT_M}", "positions:{data}/groundtruth.txt", "depth:{data}")),
    "street, its lens": ("street", ["--intrinsics", "dataset"], (f"camera-height={HEIGHT_M}",)),
    "jam, its lens": ("jam", ["--intrinsics", "dataset"], (f"camera-height={HEIGHT_M}", "depth:{data}")),
}
SENSOR_PAIRS = ((0, 60), (20, 120), (50, 150), (100, 190), (0, 199))  # frames that see the same, from elsewhere
GRID_PX = 6
NOISY_TRIALS, NOISE_RATIO = 40, 0.02  # 1 sigma of the noise, of the extent of the path


def main() -> int:
    """Measure, print, and write after every entry."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--data", type=Path, required=True)
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--runs", type=Path, help="finished runs; missing ones are made there")
    parser.add_argument("--trials", type=int, default=200)
    parser.add_argument("--only", nargs="+", default=[*RUNS, "made"])
    args = parser.parse_args()
    found = json.loads(args.out.read_text()) if args.out.is_file() else {}
    with tempfile.TemporaryDirectory() as work:
        runs = args.runs or Path(work)
        for name in args.only:
            entry = _made(args.trials, Path(work)) if name == "made" else _real(name, args.data, runs)
            for way, figures in entry.items():
                print(f"{name:18} {way:28} {json.dumps(figures)}", flush=True)
            found[name] = entry
            found["measured"] = {"when": datetime.now(UTC).isoformat(timespec="seconds"), "machine": machine_info()}
            args.out.parent.mkdir(parents=True, exist_ok=True)
            args.out.write_text(json.dumps(found, indent=1) + "\n")
    return 0


def _real(name: str, data: Path, runs: Path) -> dict[str, Any]:
    """Each way on one sequence."""
    sequence, options, ways = RUNS[name]
    path = runs / name.replace(", ", "_").replace(" ", "_")
    if not (path / "run.json").is_file():
        words = [
            sys.executable,
            "-m",
            "mastd3r",
            "run",
            str(data / sequence),
            "--out",
            str(path),
            "--no-map",
            "--quiet",
        ]
        subprocess.run([*words, *options], check=True, stdout=subprocess.DEVNULL)
    run, truth = read_run(path), open_source(data / sequence, SourceConfig()).truth()
    assert truth is not None
    true = ate_rmse(run.trajectory, truth).scale
    assert true is not None
    map_ = material_of_run(run)
    found: dict[str, Any] = {}
    for way in ways:
        wanted = measure(way.format(data=data / sequence))
        assert wanted is not None
        try:
            scale = wanted.of(map_)
        except SlamError as e:
            found[wanted.asked.kind] = {"refused": str(e)}
            continue
        found[wanted.asked.kind] = {
            "metres_per_unit": scale.metres_per_unit,
            "true": true,
            "error_ratio": scale.metres_per_unit / true - 1,
            "sigma_ratio": scale.sigma_ratio,
            "supports": scale.supports,
        }
    if "positions" in found:
        found["noisy positions"] = held([_noisy(truth, map_, seed) for seed in range(NOISY_TRIALS)], true)
    if name == "kitchen":
        sensor = _sensor_metre(data / sequence)
        found["sensor"] = {"metres": sensor}
        found["depth"]["error_ratio_in_the_sensors_metre"] = found["depth"]["metres_per_unit"] * sensor / true - 1
    return found


def _noisy(truth: Truth, map_: Material, seed: int) -> Scale | SlamError:
    """The factor from every fifth true position, with noise, a tenth of them far away."""
    rng = np.random.default_rng(seed)
    times, places = truth.timestamps_s[::5], truth.world_from_cam[::5, :3, 3]
    extent = float(np.ptp(places, 0).max())
    noise = rng.normal(0, NOISE_RATIO * extent, places.shape)
    noise[rng.random(len(times)) < 0.1] += rng.normal(0, extent, 3)
    try:
        return scale_from_positions(Positions(Path("noisy"), times, places + noise), map_)
    except SlamError as e:
        return e


def _sensor_metre(sequence: Path) -> float:
    """Metres of the true poses that one metre of the depth sensor is: where its images agree best under those poses."""
    source = open_source(sequence, SourceConfig(), want_depth=True)
    truth = source.truth()
    assert truth is not None
    wanted = {n for pair in SENSOR_PAIRS for n in pair}
    folder = sequence / "depth"
    files = sorted(folder.iterdir())
    info = json.loads((sequence / "info.json").read_text())
    depth = {n: read_depth_m(files[n], info["depth_scale"])[0] for n in wanted}
    focal, centre = info["fx"], np.array([info["cx"], info["cy"]])
    poses = {n: truth.world_from_cam[np.argmin(np.abs(truth.timestamps_s - float(files[n].stem)))] for n in wanted}

    def disagreement(metre: float) -> float:
        errors = []
        for first, second in SENSOR_PAIRS:
            height, width = depth[first].shape
            y, x = (v.ravel() for v in np.mgrid[4 : height - 4 : GRID_PX, 4 : width - 4 : GRID_PX])
            z = metre * depth[first][y, x].astype(float)
            rays = np.stack([(x - centre[0]) / focal, (y - centre[1]) / focal, np.ones(len(x))], 1)
            there = transform(inverse(poses[second]) @ poses[first], rays * z[:, None])
            ahead = (z > 0) & (there[:, 2] > 0)
            at = np.rint(there[ahead, :2] / there[ahead, 2:] * focal + centre).astype(int)
            inside = ((at >= 0) & (at < [width, height])).all(1)
            seen = metre * depth[second][at[inside, 1], at[inside, 0]]
            errors.append(np.abs(np.log(seen[seen > 0] / there[ahead][inside][seen > 0, 2])))
        return float(np.median(np.concatenate(errors)))

    best = minimize_scalar(disagreement, bounds=(0.8, 1.1), method="bounded", options={"xatol": 1e-3})
    return float(best.x)


def _made(trials: int, work: Path) -> dict[str, Any]:
    """How often sigmas hold."""
    ways = {
        "positions": positions_trial,
        "points": points_trial,
        "camera-height": height_trial,
        "depth": lambda seed: depth_trial(seed, work),
    }
    found = {}
    for way, trial in ways.items():
        scales: list[Any] = []
        for seed in range(trials):
            try:
                scales.append(trial(seed))
            except SlamError as e:
                scales.append(e)
        found[way] = held(scales)
    return found


if __name__ == "__main__":
    sys.exit(main())
