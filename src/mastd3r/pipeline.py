"""A whole video at once: source in, ``Reconstruction`` out. The command line's ``run`` is this and nothing else."""

from __future__ import annotations

import logging
import os
import tempfile
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import chain, islice
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from .concurrency import one_blas_thread
from .config import Config, check_config, config_from_yaml, config_to_yaml
from .errors import ConfigError, InputError
from .evaluation.evaluate import evaluate_trajectory as score
from .export.claim import CHECKPOINT, RECORDED, RECORDED_LIST, stopped_run
from .export.run_folder import RunFolder
from .export.run_record import read_record
from .export.trajectory_files import read_trajectory
from .metric.spec import absolute
from .offline.job import RunJob
from .offline.reconstruction import Reconstruction
from .offline.saved_map import SavedMap
from .offline.segmented import TRACKED, Cut, Segments, cut, track_segments
from .offline.tracked import MapMaterial
from .parts import with_dataset_lens
from .progress import Reporter, Silent
from .reading.files import is_closed, is_dir, is_file, resolved, user_path, whole_text
from .reading.yaml_text import MOST_YAML_BYTES
from .slam import Slam
from .sources import open_source
from .tracking.memory import can_remember
from .types import Frame, Source

Array = NDArray[Any]
log = logging.getLogger(__name__)


def load(path: str | Path) -> Reconstruction:
    """A run folder that was written earlier, complete or not. Raises InputError where it is none."""
    return Reconstruction(user_path(path))


@one_blas_thread()
def save_map(run: str | Path | Reconstruction, out: str | Path, *, source: str | Path | None = None) -> SavedMap:
    """Keep what images can be found in later, as ``mastd3r save``: the keyframes of a run, their points, its splat.

    run: its folder, or what came of it. out: the map's folder; an earlier map there is replaced, anything else is
    refused. source: where the photographs are, if no longer where the run read them.
    Raises InputError for a run without keyframes or points, and OutputError; nothing half-written stays.
    """
    rec = run if isinstance(run, Reconstruction) else load(run)
    path = user_path(out, "out")
    rec.save_map(path, source)
    return SavedMap(path)


def load_map(path: str | Path) -> SavedMap:
    """A map that ``save_map`` wrote. Raises InputError for another folder or version, and for a damaged one."""
    return SavedMap(user_path(path))


@one_blas_thread()
def reconstruct(
    source: str | Path | Iterable[tuple[float, Array]],
    out: str | Path | None = None,
    config: Config | None = None,
    *,
    maps: str | Path | None = None,
    map: str | Path | SavedMap | None = None,
    overwrite: bool = False,
    command: Sequence[str] = (),
    reporter: Reporter | None = None,
    segments: Segments | None = None,
) -> Reconstruction:
    """Trajectory, masks, static cloud and splat of a video: everything, in memory and on disk.

    source: a video, a folder of images, a sequence of a dataset, or an iterable of (seconds, image (h, w, 3) uint8
    RGB). out: the run folder; by default a temporary one, which lives as long as the result. maps: folder of
    P(movable) maps. map: one that ``save_map`` wrote; the video goes on in its frame, lens and lengths, see
    ``Reconstruction.continues``. overwrite: an earlier run in ``out`` is removed at once, not when this one is
    complete; until then files are in ``out``/unfinished. command and reporter: what run.json and the terminal show.
    segments: how a long video is tracked in pieces, several at once; in a map it stays whole.
    Raises SlamError children; what was computed until then is in the run folder, with run.log.
    """
    config, reporter = check_config(config or Config()), reporter or Silent()
    saved = load_map(map) if isinstance(map, str | Path) else map
    if not isinstance(source, str | Path):
        return _of_images(source, config, _Wanted(out, overwrite, command), saved, reporter)
    if segments is not None:
        segments.check(config, in_map=saved is not None)
        segments = segments if saved is None else None
    wanted = _Wanted(out, overwrite, command)
    return Reconstruction(*_of_files(source, config, maps, wanted, reporter, segments, saved))


@one_blas_thread()
def track_piece(
    source: str | Path,
    out: str | Path,
    config: Config,
    *,
    maps: str | Path | None = None,
    command: Sequence[str] = (),
    reporter: Reporter | None = None,
) -> None:
    """Track a segment of a video for ``reconstruct``: the checkpoint in ``out`` is all that comes of it.

    Stopped, the same call goes on; done before, nothing is left to do. Raises as ``reconstruct``.
    """
    wanted = _Wanted(out, False, command)
    _of_files(source, check_config(config), maps, wanted, reporter or Silent(), None, track_only=True)


def _of_files(
    source: str | Path,
    config: Config,
    maps: str | Path | None,
    wanted: _Wanted,
    reporter: Reporter,
    segments: Segments | None,
    saved: SavedMap | None = None,
    *,
    track_only: bool = False,
) -> tuple[Path, tempfile.TemporaryDirectory[str] | None]:
    """A run of a source that can be read again: its folder, and what keeps that where it is a temporary one."""
    read = {"path": _absolute(source), "maps": None if maps is None else _absolute(maps)}
    read["map"] = None if saved is None else _absolute(saved.path)
    slam, notes = _slam_of(source, config, maps, saved)
    fresh = wanted.out is None or wanted.overwrite
    stopped = None if fresh else _stopped_as(user_path(wanted.out or "", "out"), slam, read)
    if stopped is not None:
        return _go_on(slam, stopped, reporter, segments, track_only=track_only), None
    inputs = [user_path(p) for p in (source, maps) if p is not None]
    inputs += [] if saved is None else [saved.path]
    inputs += [] if slam.scale is None else slam.scale.inputs
    folder, temporary = _folder(wanted, inputs)
    with folder:
        folder.update(source=read)
        job = slam.job(folder, reporter, checkpoints=temporary is None)
        folder.note(*notes)
        with job:
            _track_all(slam, job, segments, track_only=track_only)
    return folder.path, temporary


@one_blas_thread()
def resume(run: str | Path, *, reporter: Reporter | None = None) -> Reconstruction:
    """Go on with a run that was stopped, as ``mastd3r resume``: from its last good checkpoint, else from the start.

    The trajectory is that of a run that was never stopped. Raises InputError for a folder that holds no such run, or
    whose source is gone; otherwise as ``reconstruct``.
    """
    path = user_path(run)
    stopped = stopped_run(path)
    if stopped is None:
        raise InputError(f"{path}: expected a run that was stopped, got {_what_is_in(path)}")
    record = read_record(stopped)
    if record.get("live"):
        raise InputError(f"{stopped}: expected a run of files, got a live one; mastd3r finish goes on with its frames")
    read = record.get("source") or {}
    if not os.path.lexists(stopped / "config.yaml") or not read.get("path"):
        raise InputError(f"{stopped}: expected config.yaml and source.path in run.json, got a run stopped before them")
    saved = load_map(read["map"]) if read.get("map") else None
    slam, _ = _slam_of(read["path"], config_from_yaml(stopped / "config.yaml"), read.get("maps"), saved)
    return Reconstruction(_go_on(slam, stopped, reporter or Silent()))


@one_blas_thread()
def finish_live(run: str | Path, *, reporter: Reporter | None = None) -> Reconstruction:
    """The rest of a live run that kept its frames, as ``mastd3r finish``: masks both ways, cloud, map, report.

    All frames that came are tracked once more, without hurry: the trajectory is that of ``reconstruct`` over them.
    Stopped, it goes on where it was. Raises InputError for a folder that holds no such run, or one that is finished;
    otherwise as ``reconstruct``.
    """
    path = user_path(run)
    if not is_file(path / "run.json") and stopped_run(path) is None:
        raise InputError(f"{path}: expected the folder of a live run, got {_what_is_in(path)}")
    at = stopped_run(path) or path
    record = read_record(at)
    if not record.get("live"):
        raise InputError(f"{at}: expected a live run, got one of files; mastd3r resume goes on with those")
    if not record["live"].get("recorded") or not is_file(at / RECORDED / RECORDED_LIST):
        raise InputError(f"{at}: expected a live run that kept its frames (--record), got one that let them pass")
    if record.get("status") == "complete" and "masks" in (record.get("timings_s") or {}):
        raise InputError(f"{at}: expected a live run that is not finished, got a finished one; mastd3r map goes on")
    if not is_file(at / "config.yaml"):
        raise InputError(f"{at}: expected config.yaml beside the frames, got a run stopped before it")
    slam, _ = _slam_of(at / RECORDED, config_from_yaml(at / "config.yaml"), None)
    return Reconstruction(_go_on(slam, at, reporter or Silent()))


def _what_is_in(path: Path) -> str:
    if not is_dir(path):
        return "no such folder"
    if is_closed(path):
        return "one that may not be read"
    return "a complete one" if is_file(path / "run.json") else "a folder without run.json of a run"


def _absolute(path: str | Path) -> str:
    return str(resolved(user_path(path)))


def _stopped_as(out: Path, slam: Slam, read: dict[str, Any]) -> Path | None:
    """The stopped run in ``out``, if it has checkpoints and read the same with the same options."""
    stopped = stopped_run(out) if is_dir(out) else None
    if stopped is None or not is_dir(stopped / CHECKPOINT):
        return None
    record = read_record(stopped)
    was = record.get("source") or {}
    config = stopped / "config.yaml"
    same = is_file(config) and whole_text(config, "YAML", most=MOST_YAML_BYTES) == config_to_yaml(slam.config)
    return stopped if same and all(was.get(k) == v for k, v in read.items()) else None


def _go_on(
    slam: Slam, stopped: Path, reporter: Reporter, segments: Segments | None = None, *, track_only: bool = False
) -> Path:
    """A stopped run, from its last good checkpoint; its folder."""
    record = read_record(stopped)
    ended_live = bool(record.get("live")) and record.get("status") == "complete"
    with RunFolder.going_on(stopped, record) as folder:
        if record.get("live"):
            folder.update(source={"path": str((folder.home / RECORDED).resolve()), "maps": None})
        job = slam.job(folder, reporter, checkpoints=True)
        job.metrics |= (folder.record.get("live") or {}).get("figures") or {}
        with job:
            memory = None if job.checkpoints is None else job.checkpoints.load()
            done = None
            if memory is None and ended_live:
                folder.note("finished: all frames that were recorded live were tracked once more")
            elif memory is None:
                folder.note("resumed, but there is no good checkpoint: from the first frame")
            else:
                at = f"frame {memory.job.frames}" if memory.stage == "tracking" else f"the end of: {memory.stage}"
                said = f"resumed from the checkpoint at {at}"
                folder.note(said)
                log.warning(said)
                if not (track_only and memory.stage == "tracked"):  # then there is no more to do
                    done = slam.go_on(memory, job)
            if memory is None and segments is None and (before := record.get("segments")):
                segments = Segments(before.get("frames"))
            if memory is not None and track_only and memory.stage == "tracked":
                folder.finish("incomplete", TRACKED)
            elif done is None:
                _track_all(slam, job, None if memory is not None else segments, track_only=track_only)
    return folder.path


def evaluate_trajectory(path: str | Path, kind: str, sequence: str | Path) -> dict[str, Any]:
    """Another system's poses, scored as our own are; rows that have no time are the frames' in order.

    kind: tum, kitti or euroc. Raises InputError for a file or a sequence that cannot be read, or without truth.
    """
    source = open_source(sequence, Config().source)
    times_s = np.array([f.timestamp_s for f in source.frames()])
    found = score(read_trajectory(user_path(path), kind, times_s), source.truth(), times_s).metrics
    for note in source.notes:
        log.warning(note)
    return found


@one_blas_thread()
def material_for_map(source: str | Path, out: Path, config: Config) -> MapMaterial:
    """Everything of a run that comes before the map, for those who train several on the same. Raises as above."""
    slam, _ = _slam_of(source, config, None)
    with slam.job(RunFolder(out, [], [Path(source)])) as job:
        _track(slam, job)
        slam.end_tracking()
        job.check_tracked()
        job.solve()
        return job.smooth_masks(slam.masks.filter.appearance)


def _slam_of(
    path: str | Path, config: Config, maps: str | Path | None, saved: SavedMap | None = None
) -> tuple[Slam, list[str]]:
    source = open_source(
        path,
        config.source,
        want_depth=config.pointmaps == "depth",
        want_semantic=config.semantics in ("auto", "maps"),
        semantic_dir=None if maps is None else user_path(maps),
    )
    config, notes = with_dataset_lens(replace(config, scale=absolute(config.scale)), source)
    return Slam(config, source.size, source=source, map=saved), notes


@dataclass(frozen=True)
class _Wanted:
    """The run folder, as the caller wants it."""

    out: str | Path | None
    overwrite: bool
    command: Sequence[str]


def _folder(wanted: _Wanted, inputs: list[Path]) -> tuple[RunFolder, tempfile.TemporaryDirectory[str] | None]:
    temporary, out = None, wanted.out
    if out is None:
        temporary = tempfile.TemporaryDirectory(prefix="mastd3r-run-", ignore_cleanup_errors=True)
        out = temporary.name
    path = user_path(out, "out")
    return RunFolder(path, list(wanted.command), inputs, overwrite=wanted.overwrite), temporary


def _track_all(slam: Slam, job: RunJob, segments: Segments | None, *, track_only: bool = False) -> None:
    """All frames that were not tracked before, at once or in pieces, and what follows the last."""
    pieces = None if segments is None else cut(slam.config, slam.source.length, segments)
    if pieces is None or segments is None:
        if segments is not None and segments.elsewhere is not None:
            log.warning("the video stays whole, so there is nothing for other machines to do: see --segment-frames")
        _track(slam, job, job.frames)
    else:
        _track_apart(slam, job, pieces, segments)
    if not track_only:
        slam.finish(job)
        return
    with job.timed("tracking"):
        slam.end_tracking()
    job.check_tracked()
    job.keep("tracked", slam.memory)
    job.folder.finish("incomplete", TRACKED)


def _track_apart(slam: Slam, job: RunJob, pieces: Cut, segments: Segments) -> None:
    """Pieces of the video by tasks of their own, joined here. run.json says which, and what became of them."""
    if not can_remember(slam.masks):
        raise ConfigError("segments: expected a filter of the mask that says what it remembers, got one that does not")
    folder, read = job.folder, job.folder.record["source"]
    folder.update(segments={"frames": pieces.frames, "windows": [[w.start, w.end] for w in pieces.windows]})
    folder.note(pieces.said)
    with job.timed("tracking"):
        apart = track_segments(read, slam.config, pieces, segments, folder.path, job.reporter)
        frames = [] if not apart.failed else [(f.index, f.timestamp_s) for f in slam.source.frames()]
        joints = slam.take_segments(apart.segments, frames)
    job.frames = len(slam.graph.records)
    if job.processor_s is not None:
        job.processor_s["tracking"] += apart.processor_s
    lost = [f"segment of frames {w.start} to {w.end} failed: {why}; its frames are lost" for w, why in apart.failed]
    for line in lost:
        log.warning(line)
    folder.note(*lost)
    folder.update(segments={**folder.record["segments"], "joints": joints, "failed": lost})


def _track(slam: Slam, job: RunJob, known: int = 0) -> None:
    """All frames of the source after the first ``known``, in order."""
    source: Source = slam.source
    frames = islice(source.frames(), known, None)
    with job.timed("tracking"), job.reporter.stage("tracking", source.length, "frames") as bar:
        bar.advance(known)
        for frame in slam.prefetched(frames):
            slam.track(frame)
            job.after(frame)
            job.keep("tracking", slam.memory)
            bar.advance()


def _of_images(
    images: Iterable[tuple[float, Array]], config: Config, wanted: _Wanted, saved: SavedMap | None, reporter: Reporter
) -> Reconstruction:
    rest: Iterator[tuple[float, Array]] = iter(images)
    first = next(rest, None)
    if first is None:
        raise InputError("reconstruct: expected images, got none")
    height, width = np.shape(first[1])[:2] if np.ndim(first[1]) == 3 else (0, 0)
    slam = Slam(config, (width, height), map=saved)
    inputs = [] if slam.scale is None else slam.scale.inputs
    folder, temporary = _folder(wanted, inputs if saved is None else [*inputs, saved.path])
    with folder, slam.job(folder, reporter) as job:
        with job.timed("tracking"), job.reporter.stage("tracking", None, "frames") as bar:
            for time_s, image in chain([first], rest):
                result = slam.track(image, time_s)
                job.after(Frame(result.index, result.timestamp_s, image))
                bar.advance()
        slam.finish(job)
    return Reconstruction(folder.path, temporary)
