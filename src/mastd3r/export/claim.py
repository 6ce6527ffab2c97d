"""Which folder a run may write in: an empty one, or an earlier run's. Nothing that is not ours is ever removed.

An earlier run is replaced only by a complete one, or where the user says so."""

from __future__ import annotations

import os
import re
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any

from ..errors import InputError, OutputError
from ..reading.files import resolved, whole_json
from .checkpoint import remove_checkpoints
from .files import writing
from .run_log import is_held

FILES = (
    "config.yaml", "trajectory.txt", "keyframes.txt", "states.txt", "camera.json", "cloud.ply", "cloud_dense.ply",
    "gaussians.ply", "gaussians.spz", "flight.mp4", "metrics.json", "report.html", "aligned.txt", "masks.mp4",
    "tracks.npz", "run.log", "trajectory_live.txt", "live_frames.csv",
)  # fmt: skip
FOLDERS = ("masks", "renders", "alpha", "depth")
RECORDED, RECORDED_LIST = "recorded", "rgb.txt"  # frames of a live run, which nobody can take again
RECORD_FILE, RESERVE = "run.json", ".reserve"
CHECKPOINT = "checkpoint"  # folder of a run that goes on, or was stopped
LOCK = ".lock"  # of a folder that many runs are written in, while a command is at work there
SEGMENTS = "segments"  # folder of a run whose pieces are tracked apart: PLAN/NUMBER, a run folder each
UNFINISHED = "unfinished"  # where a run is written while an earlier one stands
MOVING = ".moving"  # in it: what the earlier one had more of is gone
PICTURE = re.compile(r"-?\d+\.\d{6}\.png(\.part)?")  # as a run names them; others in its folders are not ours
SEGMENT_FILE = re.compile(r"config\.yaml|\.shared|\.lock|\d+\.(log|node)")  # beside the pieces
RECORD = {"status": str, "command": list, "machine": dict, "choices": list, "timings_s": dict}  # of our run.json
ANOTHER = "choose another folder with --out"


def claim(folder: Path, inputs: Sequence[Path] = (), *, overwrite: bool = False) -> Path:
    """Make a folder ready for a run, and give the folder to write in.

    An earlier run of ours that has poses stays as it is: the new one is written to ``unfinished`` within the folder,
    and ``settle`` lets it take the place of the earlier one once it is complete. With ``overwrite``, and where there
    is nothing worth keeping, what is left of an earlier run is removed and the folder itself is written in.
    ``inputs`` are what the run will read (the source, the user's maps). Raises OutputError, before anything is
    touched, for a folder that holds one of them or lies in one, that has files of unknown origin and no run of ours,
    or whose names of ours are symbolic links; for one with frames of a live run, unless ``overwrite``; and for
    whatever the system refuses.
    """
    with writing(folder):
        refuse_inputs(folder, inputs)
        folder.mkdir(parents=True, exist_ok=True)
        _refuse_links(folder)
        unfinished = folder / UNFINISHED
        if unfinished.is_dir():
            _refuse_links(unfinished)
        if not _is_ours(folder):
            raise OutputError(
                f"{folder}: expected an empty folder or an earlier run, got a folder with other files and no run.json "
                f"of a run; {ANOTHER}"
            )
        check_not_in_use(folder)
        settle(folder)
        if not overwrite:
            _refuse_recorded(folder)
        if overwrite:
            remove_segments(folder)
        _remove_run(unfinished)
        if (folder / "trajectory.txt").is_file() and not overwrite:
            folder = unfinished
        _remove_run(folder)
        for name in FOLDERS:
            (folder / name).mkdir(parents=True, exist_ok=True)
        return folder


def claim_shelf(folder: Path, mark: str, said: str, inputs: Sequence[Path] = ()) -> None:
    """Make a folder ready that holds many runs, each in a folder of its own: an empty one, or one with ``mark`` in it.

    ``said``: what ``mark`` is a sign of. Raises OutputError for a folder with other files, one that holds an input
    or lies in one, and whatever the system refuses.
    """
    with writing(folder):
        refuse_inputs(folder, inputs)
        folder.mkdir(parents=True, exist_ok=True)
        if any(p.name != LOCK for p in folder.iterdir()) and not (folder / mark).exists():
            raise OutputError(f"{folder}: expected an empty folder or {said}, got one with other files; {ANOTHER}")


def settle(folder: Path, *, also_incomplete: bool = False) -> None:
    """Let the complete run in ``unfinished`` take the place of the one before; nothing where there is none.

    Stopped anywhere in the middle, another call does the rest; run.json comes last. Raises OutputError.
    """
    new = folder / UNFINISHED
    record = _record(new)
    if record is None or not (also_incomplete or record["status"] == "complete"):
        return
    with writing(folder):
        if not (new / MOVING).exists():  # from then on, what is missing there has been moved
            for old in _files_of(folder):
                if not (new / old.relative_to(folder)).is_file():
                    old.unlink()
            (new / MOVING).touch()
        remove_checkpoints(folder / CHECKPOINT)
        for name in (*FOLDERS, *([RECORDED] if (new / RECORDED).is_dir() else [])):
            (folder / name).mkdir(exist_ok=True)
        for file in _files_of(new):
            os.replace(file, folder / file.relative_to(new))
        os.replace(new / RECORD_FILE, folder / RECORD_FILE)
        _remove_run(new)


def _files_of(folder: Path) -> list[Path]:
    """Of the run in a folder, all but run.json."""
    pictures = [p for name in (*FOLDERS, RECORDED) for p in _pictures(folder / name)]
    files = (*FILES, f"{RECORDED}/{RECORDED_LIST}")
    return [path for name in files if (path := folder / name).is_file()] + pictures


def _remove_run(folder: Path) -> None:
    """Remove what a run writes, and the folder if that was all; files that no run writes stay."""
    for file in _files_of(folder):
        file.unlink()
    remove_checkpoints(folder / CHECKPOINT)
    for name in (RECORD_FILE, RESERVE, MOVING, *(f"{name}.part" for name in (*FILES, RECORD_FILE, RESERVE))):
        (folder / name).unlink(missing_ok=True)
    for path in (*(folder / name for name in (*FOLDERS, RECORDED)), folder):
        with suppress(OSError):
            path.rmdir()


def remove_segments(folder: Path) -> None:
    """Remove the pieces of a run that were tracked apart: nothing of them is needed any more. Raises OSError."""
    for plan in (folder / SEGMENTS).glob("*"):
        for path in sorted(plan.glob("*")):
            if path.is_dir() and path.name.isdigit():
                _remove_run(path)
            elif SEGMENT_FILE.fullmatch(path.name):
                path.unlink()
        with suppress(OSError):
            plan.rmdir()
    with suppress(OSError):
        (folder / SEGMENTS).rmdir()


def _pictures(folder: Path) -> list[Path]:
    return [p for p in folder.iterdir() if PICTURE.fullmatch(p.name)] if folder.is_dir() else []


def stopped_run(folder: Path) -> Path | None:
    """Where the run is that was last begun in a folder, and has not been completed; None where there is none."""
    for path in (folder / UNFINISHED, folder):
        record = _record(path)
        if record is not None:
            return None if record["status"] == "complete" else path
    return None


def check_not_in_use(folder: Path) -> None:
    """Raise OutputError where a process that is alive writes a run in this folder."""
    for path in (folder, folder / UNFINISHED):
        if is_held(path / "run.log"):
            raise OutputError(f"{path}: expected a folder that no run is writing in, got one of a run that goes on")


def check_ours(folder: Path) -> None:
    """Raise OutputError for a folder that is no run of ours, or whose names of ours are symbolic links."""
    _refuse_links(folder)
    if not _is_ours(folder):
        raise OutputError(f"{folder}: expected a run folder, got a folder whose run.json is not one of a run")


def refuse_inputs(folder: Path, inputs: Sequence[Path]) -> None:
    out = resolved(folder)
    for given in inputs:
        real = resolved(given)
        if real == out or out in real.parents:
            raise OutputError(
                f"{folder}: expected a folder without what is read, got one that holds {given}; {ANOTHER}"
            )
        if real in out.parents:
            raise OutputError(f"{folder}: expected a folder outside what is read, got one inside {given}; {ANOTHER}")


def _refuse_recorded(folder: Path) -> None:
    for path in (folder / RECORDED, folder / UNFINISHED / RECORDED):
        if frames := len(_pictures(path)):
            raise OutputError(
                f"{folder}: expected a folder without frames of a live run, got {frames} in {path}; {ANOTHER}, or "
                "--overwrite to remove them"
            )


def _refuse_links(folder: Path) -> None:
    for name in (*FILES, *FOLDERS, RECORDED, RECORD_FILE, RESERVE, UNFINISHED, CHECKPOINT, SEGMENTS):
        if (folder / name).is_symlink():
            raise OutputError(f"{folder / name}: expected a file or folder of a run, got a symbolic link; {ANOTHER}")


def _is_ours(folder: Path) -> bool:
    """True for nothing at all, for what a run leaves that was stopped at once, and for a run."""
    unfinished = folder / UNFINISHED
    if unfinished.is_dir() and not _is_ours(unfinished):
        return False
    return all(_left_at_once(p) for p in folder.iterdir()) or _record(folder) is not None


def _left_at_once(path: Path) -> bool:
    if path.name in (*FOLDERS, UNFINISHED):
        return path.is_dir() and (path.name == UNFINISHED or not any(path.iterdir()))
    return path.name in (RESERVE, f"{RESERVE}.part", f"{RECORD_FILE}.part")


def _record(folder: Path) -> dict[str, Any] | None:
    """run.json, if it is one of ours."""
    try:
        record = whole_json(folder / RECORD_FILE)
    except InputError:
        return None
    is_ours = isinstance(record, dict) and all(isinstance(record.get(k), kind) for k, kind in RECORD.items())
    return record if is_ours else None
