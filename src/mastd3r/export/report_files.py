"""The files of a run folder, in words: what report.html links."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from ..reading.files import exists, is_closed, is_dir
from .claim import CHECKPOINT, RECORD_FILE, UNFINISHED

KNOWN = {
    "gaussians.ply": "the splat, for viewers of splats",
    "gaussians.spz": "the splat, small enough to send",
    "flight.mp4": "the splat along the smoothed path",
    "masks.mp4": "what moves, over the frames",
    "cloud.ply": "static cloud, sparse",
    "cloud_dense.ply": "static cloud, dense",
    "trajectory.txt": "a pose for every frame, TUM format",
    "keyframes.txt": "the keyframes among them",
    "states.txt": "how every frame came by its pose",
    "aligned.txt": "positions beside the true ones",
    "camera.json": "the lens",
    "tracks.npz": "static points, and where frames saw them",
    "masks": "P(moving) of every frame",
    "renders": "the splat from every eighth frame",
    "alpha": "how opaque those renders are",
    "depth": "depth of the same views",
    "metrics.json": "the figures",
    RECORD_FILE: "command, machine, timings, choices",
    "config.yaml": "all options",
    "run.log": "what was said",
}
STILL_WRITTEN = (RECORD_FILE, "run.log")  # after the report
LEFT_OUT = ("report.html", CHECKPOINT, UNFINISHED)


@dataclass(frozen=True)
class RunFile:
    """A file, or a folder of pictures."""

    name: str
    words: str  # what it is; empty for one that no run writes
    size_bytes: int | None  # None for a folder, and what grows after the report
    count: int | None = None  # of files, for a folder


def run_files(folder: Path) -> tuple[RunFile, ...]:
    """All of a run folder but the report, what runs write first, in the order of KNOWN. Empty folders are left out."""
    order = {name: n for n, name in enumerate(KNOWN)}
    shown = [p for p in folder.iterdir() if p.name not in LEFT_OUT and not p.name.startswith(".")]
    shown = [p for p in shown if ".part" not in p.suffixes]
    found = []
    for path in sorted(shown, key=lambda p: (order.get(p.name, len(order)), p.name)):
        words = KNOWN.get(path.name, "")
        if is_closed(path) or not exists(path):  # somebody else's, or a link to nowhere
            continue
        if not is_dir(path):
            size = None if path.name in STILL_WRITTEN else path.stat().st_size
            found.append(RunFile(path.name, words, size))
        elif count := sum(1 for _ in path.iterdir()):
            found.append(RunFile(path.name, words, None, count))
    return tuple(found)


def size_shown(file: RunFile) -> str:
    """Its size for people."""
    if file.count is not None:
        return f"{file.count:,} files"
    if file.size_bytes is None:
        return ""
    return f"{file.size_bytes / 2**20:.1f} MiB" if file.size_bytes >= 2**20 else f"{-(-file.size_bytes // 1024):,} KiB"
