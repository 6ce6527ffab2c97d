"""Two videos into one map, beside one run over the frames of both: the error that a map in two parts costs.

    python benchmarks/two_videos.py --data DATA --out benchmarks/results/two_videos.json [--only NAME …]

The first frames of a sequence are run and saved as a map (``mastd3r run --end N --no-map``, ``save_map``), the others
go on in it (``run --start N --map MAP --no-map``). The poses of both runs are put together as they are and compared
with the truth after ONE Sim(3) for all of them, as the poses of one run over all frames are: only two runs in one frame
and one unit can do well. "Elsewhere": a video of another place, which must not be found. Entries of an existing file
that are not measured again stay.
"""

from __future__ import annotations

import argparse
import json
import sys
import tempfile
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

import mastd3r
from mastd3r.config import CameraConfig, Config, SourceConfig
from mastd3r.evaluation.trajectory_error import associate, umeyama
from mastd3r.export.machine import machine_info
from mastd3r.sources import open_source

Array = NDArray[Any]


@dataclass(frozen=True)
class Case:
    """A map of some frames of a sequence, and a video that goes on in it."""

    of: str  # sequence
    first: tuple[int, int]  # frames of the map
    second: tuple[int, int]  # frames of the video
    video: str = ""  # another sequence: it is elsewhere
    focal_ratio: float = 0.0  # of that one's width


CASES = {
    "kitchen_walk 0-119, 120-239": Case("kitchen_walk", (0, 120), (120, 240)),
    "kitchen_walk 120-239, 0-119": Case("kitchen_walk", (120, 240), (0, 120)),
    "kitchen 0-199, 200-399": Case("kitchen", (0, 200), (200, 400)),
    "lobby_walk 0-94, 95-189": Case("lobby_walk", (0, 95), (95, 190)),
    "tsukuba 0-74, 75-149": Case("tsukuba", (0, 75), (75, 150)),
    "kitchen_walk 0-119, lobby 0-59": Case("kitchen_walk", (0, 120), (0, 60), "lobby", 0.9),
    "lobby_walk 0-94, kitchen 0-99": Case("lobby_walk", (0, 95), (0, 100), "kitchen", 0.8),
}


def measured(case: Case, data: Path, folder: Path) -> dict[str, Any]:
    """One case and its figures."""
    source = data / case.of
    first = _run(source, case.first, folder)
    saved = mastd3r.save_map(first, folder / f"{first.path.name}-map")
    if case.video:
        size = open_source(data / case.video, Config().source).size
        camera = CameraConfig(intrinsics=_lens(case.focal_ratio * size[0], size))
        second = _run(data / case.video, case.second, folder, saved, camera)
    else:
        second = _run(source, case.second, folder, saved)
    entry: dict[str, Any] = {
        "map_keyframes": len(saved.poses),
        "images": len(second.poses),
        "placed": second.continues["placed"],
        "first_frame": second.continues["first_frame"],
        "new_keyframes": int(second.is_keyframe.sum()),
        "core_s_per_frame": second.metrics["core_s_per_frame"],
    }
    if case.video:
        return entry
    whole = _run(source, (min(case.first[0], case.second[0]), max(case.first[1], case.second[1])), folder)
    entry |= {"ate_m": _ate([first, second], source), "ate_one_run_m": _ate([whole], source)}
    entry["ratio"] = entry["ate_m"] / entry["ate_one_run_m"]
    return entry


def _run(
    source: Path,
    frames: tuple[int, int],
    folder: Path,
    saved: mastd3r.SavedMap | None = None,
    camera: CameraConfig | None = None,
) -> mastd3r.Reconstruction:
    """A run over frames (first, one past the last); one that is there already is taken again."""
    name = f"{source.name}-{frames[0]}-{frames[1]}" + ("" if saved is None else f"-in-{saved.path.name}")
    if not (folder / name / "report.html").is_file():
        config = Config(source=SourceConfig(start=frames[0], end=frames[1]), camera=camera or CameraConfig())
        config = replace(config, mapping=replace(config.mapping, enabled=False))
        mastd3r.reconstruct(source, folder / name, config, map=saved)
    return mastd3r.load(folder / name)


def _lens(focal_px: float, size: tuple[int, int]) -> tuple[float, ...]:
    return (focal_px, focal_px, (size[0] - 1) / 2, (size[1] - 1) / 2)


def _ate(runs: list[mastd3r.Reconstruction], sequence: Path) -> float:
    """RMSE of the positions of all runs together, after one Sim(3)."""
    truth = open_source(sequence, Config().source).truth()
    assert truth is not None
    times_s = np.concatenate([run.timestamps_s for run in runs])
    order = np.argsort(times_s, kind="stable")
    poses = np.concatenate([run.poses for run in runs])[order]
    rows, true_rows = associate(times_s[order], truth.timestamps_s, 0.02)
    found, true = poses[rows, :3, 3], truth.world_from_cam[true_rows, :3, 3]
    sim = umeyama(found, true)
    away = sim.scale * found @ sim.rotation.T + sim.translation - true
    return float(np.sqrt((away**2).sum(1).mean()))


def main() -> int:
    """All cases; the file is written after each."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--data", type=Path, required=True, help="folder that holds the sequences")
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--only", nargs="+", help="names of cases")
    parser.add_argument("--runs", type=Path, help="folder for the runs; kept, and taken again")
    args = parser.parse_args()
    entries: dict[str, Any] = json.loads(args.out.read_text()) if args.out.is_file() else {}
    machine = machine_info()
    with tempfile.TemporaryDirectory() as folder:
        for name, case in CASES.items():
            if args.only and name not in args.only:
                continue
            entry = measured(case, args.data, args.runs or Path(folder))
            entry["made"] = {
                "date": datetime.now(UTC).date().isoformat(),
                "commit": machine["git_commit"],
                "processor": machine["processor"],
            }
            entries[name] = entry
            print(name, json.dumps(entry), flush=True)
            args.out.write_text(json.dumps(entries, indent=1) + "\n")
    return 0


if __name__ == "__main__":
    sys.exit(main())
