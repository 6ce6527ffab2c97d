"""``mastd3r map``: the map of a run that has ended goes on, from its folder and the photographs alone."""

from __future__ import annotations

import copy
import os
import shutil
import time
from collections.abc import Iterator
from contextlib import contextmanager, nullcontext, suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..camera.map_view import MapView
from ..camera.opencv_lens import OpenCvLens
from ..camera.pinhole import Camera
from ..config import Config, MapQualityKind, config_from_dict, config_to_yaml
from ..errors import InputError, OutputError
from ..export.claim import check_ours
from ..export.files import writing
from ..export.point_cloud import read_cloud
from ..export.read_run import Run
from ..export.run_folder import RunFolder, stamp
from ..graph.keyframe_graph import FrameRecord
from ..mapping.gaussian_arrays import GaussianArrays, of_degree
from ..mapping.ply import read_gaussians_ply
from ..mapping.process import Outcome
from ..mapping.quality import resolved
from ..mapping.sh import sh_degree
from ..parts import chosen_map_device
from ..progress import Reporter
from ..reading.files import is_file
from ..types import Source, State, StaticCloud, View
from .final_solve import FinalFrame, trajectory_of
from .map_stage import TrainedMap, train_map, write_renders_and_flight
from .photographs import check_size
from .placement import place_frames
from .renders import depth_png_per_unit, lens_of
from .smoothing import is_holdout, view_positions, view_static

Array = NDArray[Any]
STAGED = ".continued"  # folder inside the run folder: what is made there takes its place once all of it is whole
TIMING = "map continued"
WITHOUT_U = "u(p) of eq. (16) is not kept in a run folder: trained without it"


@dataclass(frozen=True)
class Start:
    """What a map goes on from."""

    cloud: StaticCloud
    gaussians: GaussianArrays | None  # None: a new map, from the cloud

    @property
    def words(self) -> str:
        """For the choices of run.json."""
        if self.gaussians is None:
            return f"from the {len(self.cloud.points_world)} points of cloud.ply"
        return f"from the {len(self.gaussians.means)} Gaussians of gaussians.ply"


@dataclass(frozen=True)
class Rebuilt:
    """What the smoothing pass had for the map, but for u(p)."""

    views: list[View]
    final: list[FinalFrame]  # every frame; those without a pose are lost
    map_view: MapView
    lens: Camera | OpenCvLens

    @property
    def holdout(self) -> list[FinalFrame]:
        """Frames that are never trained on."""
        return [f for n, f in enumerate(self.final) if is_holdout(n)]


def start_of(run: Run) -> Start:
    """The splat or the cloud of a run. Raises InputError where it has neither."""
    splat, cloud = run.path / "gaussians.ply", run.path / "cloud.ply"
    nothing = np.zeros((0, 3), np.float32)
    empty = StaticCloud(nothing, nothing.astype(np.uint8), nothing[:, 0], nothing[:, 0], nothing[:, 0].astype(np.int32))
    points = read_cloud(cloud) if is_file(cloud) else empty
    if is_file(splat):
        return Start(points, read_gaussians_ply(splat))
    if not len(points.points_world):
        raise InputError(f"{run.path}: expected gaussians.ply or a cloud.ply with points, got a run without")
    return Start(points, None)


def options_of(
    config: Config, minutes: float | None, quality: MapQualityKind | None, size: tuple[int, int], start: Start
) -> tuple[Config, str, list[str]]:
    """Options with numbers for what the quality decides, the device, and notes on both; ``size`` of the photographs.

    A map never becomes coarser: images as wide, Gaussians as many and colours of the degree that it has, or more.
    Raises ConfigError for options outside their range, InputError for a device that is not there.
    """
    before = config.mapping
    changes: dict[str, Any] = {"enabled": True, "realtime": False}
    if quality is not None:
        changes |= {"quality": quality, "minutes": 0.0}
        changes |= {"width_px": 0, "iterations": None, "max_gaussians": 0, "sh_degree": None}
    if minutes is not None:
        changes["minutes"] = minutes
    m = config_from_dict({"mapping": changes}, config).mapping
    notes: list[str] = []
    device = chosen_map_device(m, notes)
    m = resolved(m, size, device)
    have = start.gaussians
    m = replace(
        m,
        width_px=max(m.width_px, before.width_px),
        max_gaussians=max(m.max_gaussians, 0 if have is None else len(have.means)),
        sh_degree=max(m.sh_degree or 0, 0 if have is None else sh_degree(have.sh_rest)),
    )
    return replace(config, mapping=m), device, notes


def rebuilt(run: Run, source: Source, config: Config) -> Rebuilt:
    """Training views and frames of a run, as its smoothing pass left them; ``config`` is that of ``options_of``.

    Raises InputError for a source that is not the run's, and a run without poses, masks or lens.
    """
    lens = lens_of(run)
    check_size(run, source, lens)
    map_view = MapView(lens, config.mapping.width_px, config.mapping.tau_uncertainty_px)
    final = _frames_of(run)
    chosen = view_positions(final, config)
    views: list[View] = []
    read = 0
    for n, frame in enumerate(source.frames()):
        expected = stamp(final[n].record.timestamp_s) if n < len(final) else "no more"
        if stamp(frame.timestamp_s) != expected:
            raise InputError(
                f"{source.name}: expected the {len(final)} frames of the run in {run.path}, got one at "
                f"{stamp(frame.timestamp_s)} s in place of {expected}"
            )
        record = replace(final[n].record, index=frame.index, timestamp_s=frame.timestamp_s)
        final[n] = replace(final[n], record=record)
        if n in chosen:
            image, inside = map_view.pinhole_image(frame.as_taken.image)
            static = view_static(run.mask(frame.timestamp_s).astype(np.float32) / 255, inside, map_view)
            pose = final[n].world_from_cam
            views.append(View(frame.timestamp_s, image, static, pose, map_view.pinhole, record.kf_id))
        read += 1
    if read != len(final):
        raise InputError(f"{source.name}: expected the {len(final)} frames of the run in {run.path}, got {read}")
    if not views:
        raise InputError(f"{run.path}: expected frames with a pose to train on, got none of {read}")
    return Rebuilt(views, final, map_view, lens)


def continue_map(
    run: Run,
    source: Source,
    config: Config,
    minutes: float | None,
    quality: MapQualityKind | None,
    reporter: Reporter,
) -> dict[str, Any]:
    """Train on, place the frames again, and draw what is shown; gives the figures of the training.

    Before the splat is there, nothing of the run has changed; stopped by the user, the splat is written as it is.
    Everything else takes its place once all of it is whole. Raises InputError, ConfigError and OutputError.
    """
    check_ours(run.path)
    start = start_of(run)
    config, device, notes = options_of(config, minutes, quality, source.size, start)
    material = rebuilt(run, source, config)
    folder, job = RunFolder.again(run.path, run.record), _Continued(run, config, start)
    steps = config.mapping.iterations or 0
    begun = None
    if start.gaussians is not None:
        begun = Outcome(of_degree(start.gaussians, config.mapping.sh_degree or 0), steps // 2, len(material.views))
    with job.remembered(folder):
        trained = train_map(folder, config, start.cloud, material.views, device, begun, reporter)
        folder.note(*notes)
        job.tell(folder)
        with _staged(run.path) as staged:
            _show(RunFolder.again(staged, copy.deepcopy(folder.record)), run, source, material, trained, job, reporter)
    return trained.metrics


class _Continued:
    """What run.json is told, whether the training ends by itself or is stopped."""

    def __init__(self, run: Run, config: Config, start: Start) -> None:
        self.config, self._start = config, start
        self._before = run.record.get("map")
        timings = run.record.setdefault("timings_s", {})
        self._spent_s, self._began, self._told = timings.get(TIMING, 0.0), time.perf_counter(), False

    @contextmanager
    def remembered(self, folder: RunFolder) -> Iterator[None]:
        """Whatever stops the body once the splat is new: run.json says that the rest is not."""
        try:
            yield
        except BaseException:
            with suppress(OutputError):  # the disk may be full: the error that brought us here is the one to tell
                if folder.record.get("map") is not self._before:
                    self.tell(folder)
                    folder.note(f"{TIMING}: stopped; poses, renders and figures are older than the splat")
            raise

    def tell(self, folder: RunFolder) -> None:
        """Options and choices of the splat that is there now; once."""
        if self._told:
            return
        self._told = True
        m, facts = self.config.mapping, folder.record["map"]
        if self._before and "depth_png_per_unit" in self._before:  # of the depth images that are there
            facts["depth_png_per_unit"] = self._before["depth_png_per_unit"]
        count = len(read_gaussians_ply(folder.path / "gaussians.ply").means)
        length = f"{facts['steps']} steps" + (f" in {m.minutes:g} min" if m.minutes else "")
        self.time(folder)
        folder.note(
            f"{TIMING}: {length} on images {m.width_px} px wide, {self._start.words} to {count} Gaussians, quality "
            f"{m.quality}; {WITHOUT_U}"
        )
        folder.write_config(config_to_yaml(self.config))

    def time(self, folder: RunFolder) -> None:
        """Seconds of this and earlier continuations."""
        folder.record["timings_s"][TIMING] = self._spent_s + time.perf_counter() - self._began


def _show(
    staged: RunFolder,
    run: Run,
    source: Source,
    material: Rebuilt,
    trained: TrainedMap,
    job: _Continued,
    reporter: Reporter,
) -> None:
    """Poses, renders, depth and flight of the new splat, made aside and then put in their place."""
    final = material.final

    def refined(frame: FinalFrame) -> Array:
        return trained.mapper.refined_pose(frame.world_from_cam, frame.record.timestamp_s)

    if job.config.mapping.refine_poses:
        masks = run.path / "masks"
        with reporter.stage("poses", len(final), "frames") as bar:
            splat, lens = trained.splat, material.lens
            placement = place_frames(source.frames(), final, splat, lens, refined, masks, bar.advance)
        final = placement.final
        staged.update(placement=placement.facts)
        staged.write_trajectory(trajectory_of(final))
    place = {f.record.index: f for f in final}
    holdout = [place[f.record.index] for f in material.holdout]
    lens, view = material.lens, material.map_view
    write_renders_and_flight(trained, staged, holdout, view, final, lens, lambda _: nullcontext(), reporter)
    job.time(staged)
    staged.update(map={**staged.record["map"], "depth_png_per_unit": depth_png_per_unit(trained.median_depth)})
    _put_in_place(staged.path, run.path)


@contextmanager
def _staged(run: Path) -> Iterator[Path]:
    """A folder beside the run's files, gone afterwards."""
    folder = run / STAGED
    with writing(folder):
        shutil.rmtree(folder, ignore_errors=True)
        for name in ("renders", "alpha", "depth"):
            (folder / name).mkdir(parents=True)
    try:
        yield folder
    finally:
        shutil.rmtree(folder, ignore_errors=True)


def _put_in_place(staged: Path, run: Path) -> None:
    """Move every file over the run's own; run.json last."""
    files = sorted(p for p in staged.rglob("*") if is_file(p))
    with writing(run):
        for file in sorted(files, key=lambda p: p.name == "run.json"):
            target = run / file.relative_to(staged)
            target.parent.mkdir(exist_ok=True)
            os.replace(file, target)


def _frames_of(run: Run) -> list[FinalFrame]:
    """Every frame that has a mask, with the pose of the trajectory.

    Its index is not known yet. The keyframe that it hung on is not in a run folder: the last one before it is taken,
    which nothing asks for, as the graph moves no more.
    """
    times = [float(t) for t in run.mask_times_s()]
    row = {stamp(float(t)): n for n, t in enumerate(run.trajectory.timestamps_s)}
    unmasked = sorted(set(row) - {stamp(t) for t in times})
    if unmasked:
        raise InputError(
            f"{run.path}/masks: expected a mask of every frame of trajectory.txt, got none of {len(unmasked)}, the "
            f"first at {unmasked[0]} s"
        )
    out: list[FinalFrame] = []
    nothing = np.zeros(0)
    kf_id = -1
    for t in times:
        n = row.get(stamp(t))
        state: State = "lost" if n is None else run.trajectory.states[n]
        is_keyframe = n is not None and bool(run.trajectory.is_keyframe[n])
        kf_id += is_keyframe
        record = FrameRecord(
            -1, t, max(0, kf_id), np.eye(4), state, nothing, np.zeros((0, 2)), nothing, is_keyframe=is_keyframe
        )
        pose = np.full((4, 4), np.nan) if n is None else run.trajectory.world_from_cam[n]
        out.append(FinalFrame(record, pose, state))
    return out
