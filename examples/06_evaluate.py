"""Figures against the truth of a sequence: of a run, and of any trajectory in a file.

usage: python examples/06_evaluate.py RUN SEQUENCE
"""

import sys
from pathlib import Path

import numpy as np

import mastd3r
from mastd3r.config import Config
from mastd3r.evaluation.evaluate import evaluate, evaluate_trajectory
from mastd3r.export.trajectory_files import read_trajectory
from mastd3r.sources import open_source


def main(run: str, sequence: str) -> None:
    rec = mastd3r.load(run)
    source = open_source(Path(sequence), Config().source)
    figures = evaluate(rec.path, source.truth(), source.frames()).metrics
    print(f"ATE {figures['ate_rmse_all']:.4f} over {figures['frames_posed']} frames, after Sim(3) alignment")
    times_s = np.array([frame.timestamp_s for frame in source.frames()])
    theirs = read_trajectory(rec.path / "keyframes.txt", "tum", times_s)  # here another system's file
    print(f"keyframes alone: ATE {evaluate_trajectory(theirs, source.truth(), times_s).metrics['ate_rmse_all']:.4f}")


if __name__ == "__main__":
    main(*sys.argv[1:])
