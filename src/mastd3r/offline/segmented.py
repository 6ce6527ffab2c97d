"""A long video as overlapping segments: each tracked by a task of its own, what they leave read back in order."""

from __future__ import annotations

import hashlib
import json
import logging
import os
import sys
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from ..config import Config, SourceConfig, config_to_yaml
from ..errors import ConfigError, InputError
from ..export.checkpoint import CheckpointStore
from ..export.claim import CHECKPOINT, SEGMENTS
from ..export.files import write_text, writing
from ..export.machine import program, total_memory_mib, usable_cores
from ..parts import chosen_pointmaps
from ..progress import Reporter
from ..tasks.batch import NETWORK_MIB
from ..tasks.lock import alone_in
from ..tasks.processes import Processes, limits
from ..tasks.runner import Change, Place, Task, run_tasks
from ..tracking.memory import TrackingMemory
from .checkpoints import Memory

log = logging.getLogger(__name__)
OVERLAP_FRAMES = 40  # that two segments share: enough for the later one to have depth there
LEAST_FRAMES = 60  # of a segment: shorter ones are a part of the one before
TRACKING_MIB, FRAME_MIB = 700.0, 0.25  # of a run, and more with every frame that is tracked
MEMORY_SHARE = 0.5  # of the machine's, above: a video is cut
TRACKED = "a segment: tracked, and no more; the whole run goes on with it"


@dataclass(frozen=True)
class Segments:
    """How a video is cut, and where the pieces are tracked."""

    frames: int | None = None  # of a segment, without the overlap; None: one piece, unless it is too long for memory
    jobs: int | None = None  # at once on this machine; None: as many as cores and memory allow
    memory_mib: float | None = None  # of all of them there; None: most of the machine's
    retries: int = 2
    elsewhere: Callable[[Path], Place] | None = None  # a place that serves a folder, instead of this machine

    def __post_init__(self) -> None:
        if self.frames is not None and self.frames < LEAST_FRAMES:
            raise ConfigError(f"--segment-frames: expected {LEAST_FRAMES} or more, got {self.frames}")

    def check(self, config: Config, *, in_map: bool = False) -> None:
        """Raise ConfigError for a run that cannot be tracked in pieces, where that was asked for."""
        if self.frames is not None and in_map:
            raise ConfigError("--segment-frames: expected a run of its own, got --map, in which a video stays whole")
        if self.frames is not None and config.mapping.realtime:
            raise ConfigError("--segment-frames: expected a map after tracking, got --realtime, which makes it beside")


@dataclass(frozen=True)
class Cut:
    """A video cut into pieces."""

    frames: int  # of a piece, without the overlap
    windows: tuple[SourceConfig, ...]
    said: str


def cut(config: Config, length: int | None, asked: Segments) -> Cut | None:
    """The pieces of a source of so many frames; None: it stays whole, as nobody asked and memory is enough.

    Raises InputError for a source whose number of frames nobody knows.
    """
    total = total_memory_mib() or float("inf")
    source = config.source
    if asked.frames is None and config.mapping.realtime:
        return None
    if length is None:
        if asked.frames is None:
            return None
        raise InputError("--segment-frames: expected a source whose number of frames is known, got one that is not")
    need_mib, room_mib = TRACKING_MIB + FRAME_MIB * length, MEMORY_SHARE * total
    frames = asked.frames
    if frames is None:
        if need_mib <= room_mib:
            log.info("segments: none, %d frames need about %.0f MiB", length, need_mib)
            return None
        frames = max(LEAST_FRAMES, int((room_mib / usable_cores() - TRACKING_MIB) / FRAME_MIB), 1000)
    firsts = list(range(0, max(length - LEAST_FRAMES, 1), frames))
    ends = [min(first + frames + OVERLAP_FRAMES, length) for first in firsts[:-1]] + [length]
    if len(firsts) < 2:
        log.info("segments: none, %d frames are one of %d", length, frames)
        return None
    windows = tuple(_window(source, *piece) for piece in zip(firsts, ends, strict=True))
    why = "as asked for" if asked.frames else f"{length} frames need about {need_mib:.0f} MiB, more than {room_mib:.0f}"
    said = f"segments: {len(firsts)} of {frames} frames, each with {OVERLAP_FRAMES} of the next ({why})"
    return Cut(frames, windows, said)


def _window(source: SourceConfig, first: int, end: int) -> SourceConfig:
    """Frames ``first`` to ``end`` of those that a source gives, as positions in the source itself."""
    start = source.start + first * source.stride
    return replace(source, start=start, end=source.start + (end - 1) * source.stride + 1)


@dataclass(frozen=True)
class TrackedApart:
    """What the tasks have left."""

    segments: list[TrackingMemory]  # in order of time
    processor_s: float  # NaN where the system does not say
    failed: list[tuple[SourceConfig, str]]  # pieces that are missing, and why


def track_segments(
    read: dict[str, Any], config: Config, pieces: Cut, asked: Segments, run: Path, reporter: Reporter
) -> TrackedApart:
    """Track the pieces of a source (``read``: its path and that of the maps), each in a folder of ``run``.

    What an earlier command of the same words has tracked is there still. A piece that fails for good is left out.
    Raises InputError where all of them are, or what one has left cannot be read; OutputError, and what the place of
    the tasks raises.
    """
    own = replace(config, scale="", mapping=replace(config.mapping, enabled=False))
    text = config_to_yaml(replace(own, source=replace(config.source, start=0, end=None)))
    plan = hashlib.sha256(json.dumps([text, read, pieces.frames, program()]).encode()).hexdigest()[:12]
    folder = Path(os.path.abspath(run)) / SEGMENTS / plan
    with writing(folder):
        folder.mkdir(parents=True, exist_ok=True)
    write_text(folder / "config.yaml", text)
    tasks = [_task(folder, n, window, read) for n, window in enumerate(pieces.windows)]
    ends: dict[str, Change] = {}
    spent = [0.0]
    with reporter.stage("segments", len(tasks), "segments") as bar:

        def changed(change: Change) -> None:
            ended = change.ended
            what = "started" if ended is None else "tracked" if ended.exit_code == 0 else ended.reason
            line = f"segment {change.task.name}: {what}{f' on {change.node}' if change.node else ''}"
            log.info("%s", line)
            bar.say(line)
            if ended is not None:
                spent[0] += float("nan") if ended.processor_s is None else ended.processor_s
            if change.state == "ended":
                ends[change.task.name] = change
                bar.advance()

        with alone_in(folder, "run") as lock:
            here = limits(asked.jobs or usable_cores(), asked.memory_mib)
            place: Place = Processes(here, lock) if asked.elsewhere is None else asked.elsewhere(folder)
            own_mib = NETWORK_MIB if chosen_pointmaps(config)[0] == "mast3r" else TRACKING_MIB
            need_mib = own_mib + FRAME_MIB * (pieces.frames + OVERLAP_FRAMES)
            run_tasks(tasks, place, lambda them: {t.name: need_mib for t in them}, changed, retries=asked.retries)
    return _read(tasks, pieces, ends, spent[0])


def _task(folder: Path, number: int, window: SourceConfig, read: dict[str, Any]) -> Task:
    name = f"{number:03d}"
    words = ["mastd3r", "run", str(read["path"]), "--out", str(folder / name), "--config", str(folder / "config.yaml")]
    words += [f"--start={window.start}", f"--end={window.end}"]
    words += [] if read.get("maps") is None else [f"--maps={read['maps']}"]
    argv = [sys.executable, "-m", *words, "--segment", "--quiet", "--end-with-stdin"]
    return Task(name, lambda attempt: argv, folder / f"{name}.log", folder / name)


def _read(tasks: list[Task], pieces: Cut, ends: dict[str, Change], processor_s: float) -> TrackedApart:
    found, failed = [], []
    for task, window in zip(tasks, pieces.windows, strict=True):
        ended = ends[task.name].ended
        assert ended is not None
        if ended.exit_code != 0:
            failed.append((window, ended.reason))
            continue
        memory = CheckpointStore(task.run / CHECKPOINT, program()).load()
        if not isinstance(memory, Memory) or memory.stage != "tracked":
            raise InputError(
                f"{task.run}: expected what a segment leaves, written by version {program()}, got none that can be "
                "read; the same command tracks it anew"
            )
        found.append(memory.tracking)
    if not found:
        raise InputError(f"segments: expected one of {len(tasks)} to be tracked, got none: {failed[0][1]}")
    return TrackedApart(found, processor_s, failed)
