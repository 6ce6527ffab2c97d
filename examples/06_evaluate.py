"""Figures against the truth of a sequence: of a run, and of any trajectory in a file.

usage: python examples/06_evaluate.py RUN SEQUENCE
"""

import sys

import mastd3r


def main(run: str, sequence: str) -> None:
    rec = mastd3r.load(run)
    figures = rec.evaluate(sequence)
    print(f"ATE {figures['ate_rmse_all']:.4f} over {figures['frames_posed']} frames, after Sim(3) alignment")
    file = rec.path / "keyframes.txt"  # here another system's trajectory
    theirs = mastd3r.evaluate_trajectory(file, "tum", sequence)
    print(f"{file.name}: ATE {theirs['ate_rmse_all']:.4f} over {theirs['frames_posed']} of {theirs['frames']} frames")


if __name__ == "__main__":
    main(*sys.argv[1:])
