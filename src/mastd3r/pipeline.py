"""A whole video at once: source in, ``Reconstruction`` out. The command line's ``run`` is this and nothing else."""

from __future__ import annotations

import logging
import tempfile
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from itertools import chain
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from .concurrency import one_blas_thread
from .config import Config
from .errors import InputError
from .evaluation.evaluate import evaluate_trajectory as score
from .export.run_folder import RunFolder
from .export.trajectory_files import read_trajectory
from .offline.job import MapMaterial, RunJob
from .offline.reconstruction import Reconstruction
from .parts import with_dataset_lens
from .progress import Reporter, Silent
from .slam import Slam
from .sources import open_source
from .types import Frame, Source

Array = NDArray[Any]
log = logging.getLogger(__name__)


def load(path: str | Path) -> Reconstruction:
    """A run folder that was written earlier, complete or not. Raises InputError where it is none."""
    return Reconstruction(Path(path).expanduser())


@one_blas_thread()
def reconstruct(
    source: str | Path | Iterable[tuple[float, Array]],
    out: str | Path | None = None,
    config: Config | None = None,
    *,
    maps: str | Path | None = None,
    overwrite: bool = False,
    command: Sequence[str] = (),
    reporter: Reporter | None = None,
) -> Reconstruction:
    """Trajectory, masks, static cloud and splat of a video: everything, in memory and on disk.

    source: a video, a folder of images, a sequence of a dataset, or an iterable of (seconds, image (h, w, 3) uint8
    RGB). out: the run folder; by default a temporary one, which lives as long as the result. maps: folder of
    P(movable) maps. overwrite: an earlier run in ``out`` is removed at once, not when this one is complete; until then
    files are in ``out``/unfinished. command and reporter: what run.json and the terminal show.
    Raises SlamError children; what was computed until then is in the run folder, with run.log.
    """
    config, reporter = config or Config(), reporter or Silent()
    if not isinstance(source, str | Path):
        return _of_images(source, config, _Wanted(out, overwrite, command), reporter)
    slam, notes = _slam_of(source, config, maps)
    inputs = [Path(p).expanduser() for p in (source, maps) if p is not None]
    folder, temporary = _folder(_Wanted(out, overwrite, command), inputs)
    with folder:
        job = slam.job(folder, reporter)
        folder.update(source={**folder.record["source"], "path": str(Path(source).expanduser().resolve())})
        folder.note(*notes)
        with job:
            _track(slam, job)
            slam.finish(job)
    return Reconstruction(folder.path, temporary)


def evaluate_trajectory(path: str | Path, kind: str, sequence: str | Path) -> dict[str, Any]:
    """Another system's poses, scored as our own are; rows that have no time are the frames' in order.

    kind: tum, kitti or euroc. Raises InputError for a file or a sequence that cannot be read, or without truth.
    """
    source = open_source(sequence, Config().source)
    times_s = np.array([f.timestamp_s for f in source.frames()])
    found = score(read_trajectory(Path(path), kind, times_s), source.truth(), times_s).metrics
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


def _slam_of(path: str | Path, config: Config, maps: str | Path | None) -> tuple[Slam, list[str]]:
    source = open_source(
        path,
        config.source,
        want_depth=config.pointmaps == "depth",
        want_semantic=config.semantics in ("auto", "maps"),
        semantic_dir=None if maps is None else Path(maps),
    )
    config, notes = with_dataset_lens(config, source)
    return Slam(config, source.size, source=source), notes


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
    path = Path(out).expanduser()
    return RunFolder(path, list(wanted.command), inputs, overwrite=wanted.overwrite), temporary


def _track(slam: Slam, job: RunJob) -> None:
    """All frames of the source, in order."""
    source: Source = slam.source
    with job.timed("tracking"), job.reporter.stage("tracking", source.length, "frames") as bar:
        for frame in slam.prefetched(source.frames()):
            slam.track(frame)
            job.after(frame)
            bar.advance()


def _of_images(
    images: Iterable[tuple[float, Array]], config: Config, wanted: _Wanted, reporter: Reporter
) -> Reconstruction:
    rest: Iterator[tuple[float, Array]] = iter(images)
    first = next(rest, None)
    if first is None:
        raise InputError("reconstruct: expected images, got none")
    height, width = np.shape(first[1])[:2] if np.ndim(first[1]) == 3 else (0, 0)
    slam = Slam(config, (width, height))
    folder, temporary = _folder(wanted, [])
    with folder, slam.job(folder, reporter) as job:
        with job.timed("tracking"), job.reporter.stage("tracking", None, "frames") as bar:
            for time_s, image in chain([first], rest):
                result = slam.track(image, time_s)
                job.after(Frame(result.index, result.timestamp_s, image))
                bar.advance()
        slam.finish(job)
    return Reconstruction(folder.path, temporary)
