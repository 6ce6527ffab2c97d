"""One entry of benchmarks/stress.py, in a process of its own: tracking, the joint optimisation, and the path's error.

usage: python benchmarks/stress_entry.py SEQUENCE RUN RESULT.json [--semantics NAME] [--set SECTION.KEY=VALUE …]
Masks of the smoothing pass, cloud and map are not made. A sequence that the library refuses (InputError) is a result,
``refused`` with the reason; anything else that goes wrong ends the process.
"""

from __future__ import annotations

import argparse
import json
import math
import sys
import time
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mastd3r.concurrency import one_blas_thread
from mastd3r.config import Config, with_override
from mastd3r.errors import InputError
from mastd3r.evaluation.evaluate import evaluate, read_poses
from mastd3r.evaluation.trajectory_error import ASSOCIATION_S, associate, ate_of_positions
from mastd3r.export.files import write_json
from mastd3r.export.machine import peak_rss_mib
from mastd3r.export.run_folder import RunFolder
from mastd3r.graph.keyframe_graph import KeyframeGraph
from mastd3r.parts import with_dataset_lens
from mastd3r.slam import Slam
from mastd3r.sources import open_source
from mastd3r.types import Truth

Array = NDArray[Any]


def main() -> int:
    """Run, and write what came of it."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("sequence", type=Path)
    parser.add_argument("run", type=Path, help="the run folder")
    parser.add_argument("result", type=Path)
    parser.add_argument("--semantics", default=Config().semantics)
    parser.add_argument("--set", action="append", default=[], metavar="SECTION.KEY=VALUE")
    args = parser.parse_args()
    began, cpu = time.perf_counter(), time.process_time()
    try:
        figures = run_entry(args.sequence, args.run, config_of(args.semantics, args.set))
    except InputError as e:
        figures = {"refused": str(e)}
    figures["wall_s"] = round(time.perf_counter() - began, 1)
    figures["processor_s"] = round(time.process_time() - cpu, 1)
    figures["peak_rss_mib"] = round(peak_rss_mib())
    write_json(args.result, figures)
    return 0


def config_of(semantics: str, overrides: Sequence[str]) -> Config:
    """Default options but for these, without a map. Raises ConfigError."""
    config = with_override(Config(), f"semantics={semantics}")
    for words in overrides:
        config = with_override(config, words)
    return replace(config, mapping=replace(config.mapping, enabled=False))


@one_blas_thread()
def run_entry(sequence: Path, run: Path, config: Config) -> dict[str, Any]:
    """Track and solve a sequence of TUM's layout with true poses; its figures. Raises InputError."""
    source = open_source(
        sequence,
        config.source,
        want_depth=config.pointmaps == "depth",
        want_semantic=config.semantics in ("auto", "maps"),
    )
    config, notes = with_dataset_lens(config, source)
    slam = Slam(config, source.size, source=source)
    folder = RunFolder(run, [], [sequence])
    times: list[float] = []
    with slam.job(folder) as job:
        folder.note(*notes)
        for frame in slam.prefetched(source.frames()):
            slam.track(frame)
            job.after(frame)
            times.append(frame.timestamp_s)
        slam.end_tracking()
        job.check_tracked()
        pieces = len(set(slam.graph.submap_of.values()))  # the solve places them side by side
        job.solve()
        folder.finish()
    truth = source.truth()
    if truth is None or not len(truth.timestamps_s):
        raise InputError(f"{sequence}: expected a sequence with true poses, got one without")
    focal = {"focal_true_px": true_focal_px(sequence), "focal_px": folder.record["camera"]["focal_px"]}
    return {
        **path_figures(run, truth, np.array(times), slam.graph),
        "keyframes": len(slam.graph.keyframes),
        "never_joined": pieces - 1,
        **focal,
        "focal_sigma_ratio": folder.record["camera"]["focal_sigma_ratio"],
        "choices": folder.record["choices"],
    }


def path_figures(run: Path, truth: Truth, times_s: Array, graph: KeyframeGraph) -> dict[str, Any]:
    """ATE over all frames and over those that were tracked, each after its own Sim(3), in the truth's unit.

    ``interpolated``: frames of pieces that were never joined, placed by continuity; ``lost``: frames that no keyframe
    was found for, placed between their neighbours.
    """
    all_frames = evaluate(run, truth, (), times_s).metrics
    states = [r.state for r in graph.records]
    tracked_s = np.array([r.timestamp_s for r in graph.records if r.state in ("started", "tracked")])
    poses = read_poses(run / "trajectory.txt")
    rows, _ = associate(poses.timestamps_s, tracked_s, ASSOCIATION_S / 20)
    true_positions = truth.world_from_cam[:, :3, 3]
    tracked = ate_of_positions(
        poses.timestamps_s[rows], poses.world_from_cam[rows, :3, 3], truth.timestamps_s, true_positions
    )
    return {
        "frames": len(times_s),
        "frames_posed": all_frames["frames_posed"],
        "ate_rmse_all": all_frames["ate_rmse_all"],
        "ate_rmse_tracked": tracked.rmse,
        "path_length": path_length(truth.timestamps_s, true_positions, times_s),
        "frames_tracked": len(tracked_s),
        "frames_interpolated": states.count("interpolated"),
        "frames_lost": states.count("lost"),
    } | {k: v for k, v in all_frames.items() if k == "ate_rmse_all_note"}


def path_length(truth_s: Array, positions: Array, times_s: Array) -> float:
    """Length of the true path through the frames' own times; truth between them does not count.

    truth_s (n,), positions (n, 3), times_s (m,) in order.
    """
    _, rows = associate(times_s, truth_s, ASSOCIATION_S)
    return float(np.linalg.norm(np.diff(positions[rows], axis=0), axis=1).sum())


def true_focal_px(sequence: Path) -> float | None:
    """The geometric mean of fx and fy that info.json gives; None where it gives none."""
    file = sequence / "info.json"
    info: dict[str, Any] = json.loads(file.read_text()) if file.is_file() else {}
    return math.sqrt(info["fx"] * info["fy"]) if "fx" in info and "fy" in info else None


if __name__ == "__main__":
    sys.exit(main())
