"""Which folder a run may write in: an empty one, or an earlier run's. Nothing that is not ours is ever removed."""

from __future__ import annotations

import json
import re
from collections.abc import Sequence
from pathlib import Path

from ..errors import OutputError
from .files import writing

FILES = (
    "config.yaml", "trajectory.txt", "keyframes.txt", "states.txt", "camera.json", "cloud.ply", "cloud_dense.ply",
    "gaussians.ply",    "gaussians.spz", "flight.mp4", "metrics.json", "report.html", "aligned.txt", "masks.mp4",
)  # fmt: skip
FOLDERS = ("masks", "renders", "alpha", "depth")
RESERVE = ".reserve"
PICTURE = re.compile(r"-?\d+\.\d{6}\.png")  # as a run names them; other files of its folders are somebody else's
RECORD = {"status": str, "command": list, "machine": dict, "choices": list, "timings_s": dict}  # of our run.json
ANOTHER = "choose another folder with --out"


def claim(folder: Path, inputs: Sequence[Path] = ()) -> None:
    """Make a folder ready for a run: it is made where it is missing, and an earlier run of ours is removed from it.

    ``inputs`` are what the run will read (the source, the user's maps). Raises OutputError, before anything is
    touched, for a folder that holds one of them or lies in one, that has files of unknown origin and no run of ours,
    or whose names of ours are symbolic links; and for whatever the system refuses.
    """
    with writing(folder):
        _refuse_inputs(folder, inputs)
        folder.mkdir(parents=True, exist_ok=True)
        _refuse_links(folder)
        if not _is_ours(folder):
            raise OutputError(
                f"{folder}: expected an empty folder or an earlier run, got a folder with other files and no run.json "
                f"of a run; {ANOTHER}"
            )
        for name in FILES:
            (folder / name).unlink(missing_ok=True)
        for name in FOLDERS:
            (folder / name).mkdir(exist_ok=True)
            for old in (folder / name).iterdir():
                if PICTURE.fullmatch(old.name):
                    old.unlink()


def check_ours(folder: Path) -> None:
    """Raise OutputError for a folder that is no run of ours, or whose names of ours are symbolic links."""
    _refuse_links(folder)
    if not _is_ours(folder):
        raise OutputError(f"{folder}: expected a run folder, got a folder whose run.json is not one of a run")


def _refuse_inputs(folder: Path, inputs: Sequence[Path]) -> None:
    out = folder.resolve()
    for given in inputs:
        real = given.resolve()
        if real == out or out in real.parents:
            raise OutputError(
                f"{folder}: expected a folder without what is read, got one that holds {given}; {ANOTHER}"
            )
        if real in out.parents:
            raise OutputError(f"{folder}: expected a folder outside what is read, got one inside {given}; {ANOTHER}")


def _refuse_links(folder: Path) -> None:
    for name in (*FILES, *FOLDERS, "run.json", RESERVE):
        if (folder / name).is_symlink():
            raise OutputError(f"{folder / name}: expected a file or folder of a run, got a symbolic link; {ANOTHER}")


def _is_ours(folder: Path) -> bool:
    """True for nothing at all, for what a run leaves that was stopped at once, and for a run."""
    entries = list(folder.iterdir())
    if all(p.name == RESERVE or (p.name in FOLDERS and p.is_dir() and not any(p.iterdir())) for p in entries):
        return True
    try:
        record = json.loads((folder / "run.json").read_text(encoding="utf-8"))
    except (FileNotFoundError, ValueError):
        return False
    return isinstance(record, dict) and all(isinstance(record.get(k), kind) for k, kind in RECORD.items())
