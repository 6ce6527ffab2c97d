"""What came of a video, read from its run folder when it is asked for."""

from __future__ import annotations

import os
import shutil
import tempfile
from collections.abc import Iterator, Sequence
from functools import cached_property
from pathlib import Path
from typing import Any, overload

import numpy as np
from numpy.typing import NDArray

from ..camera.opencv_lens import OpenCvLens
from ..camera.pinhole import Camera
from ..concurrency import one_blas_thread
from ..config import Config, MapQualityKind, config_from_text
from ..errors import ConfigError, InputError
from ..evaluation.cloud_error import evaluate_cloud
from ..evaluation.evaluate import evaluate
from ..export.claim import check_not_in_use, claim, settle
from ..export.files import write_json, writing
from ..export.formats import export_trajectory
from ..export.kinds import DENSE, KINDS, PICTURES, SPLATS, TRAJECTORIES, UNDISTORTING
from ..export.point_cloud import read_cloud, read_points
from ..export.read_run import Run, read_run
from ..export.report import say_scale
from ..export.run_folder import RunFolder
from ..mapping.gaussian_arrays import GaussianArrays
from ..mapping.ply import read_gaussians_ply
from ..metric.measure import measure
from ..metric.spec import FORMS, absolute
from ..progress import Reporter, Silent
from ..reading.files import is_file, user_path
from ..sources import open_source
from ..types import StaticCloud
from .dense import CLOUD_FILE, export_dense
from .exports import export_pictures, export_plates
from .map_making import save_run_as_map
from .metres import material_of_run, scale_facts
from .renders import export_splat, lens_of
from .run_report import write_run_report

Array = NDArray[Any]


class Masks(Sequence[Array]):
    """P(moving) of every frame that has a mask, in order of time, read when it is asked for."""

    def __init__(self, run: Run) -> None:
        self._run = run
        self.timestamps_s: Array = run.mask_times_s()

    def __len__(self) -> int:
        return len(self.timestamps_s)

    @overload
    def __getitem__(self, n: int) -> Array: ...
    @overload
    def __getitem__(self, n: slice) -> list[Array]: ...
    def __getitem__(self, n: int | slice) -> Array | list[Array]:
        """(h, w) float32 in 0..1, at working size."""
        if isinstance(n, slice):
            return [self._read(t) for t in self.timestamps_s[n]]
        return self._read(self.timestamps_s[n])

    def _read(self, timestamp_s: float) -> Array:
        return self._run.mask(float(timestamp_s)).astype(np.float32) / 255

    def __iter__(self) -> Iterator[Array]:
        return (self._read(t) for t in self.timestamps_s)


class Reconstruction:
    """Trajectory, lens, masks, static cloud and splat of one video. Map units, or metres: see ``scale``."""

    def __init__(self, path: Path, temporary: tempfile.TemporaryDirectory[str] | None = None) -> None:
        """``path``: a run folder. ``temporary`` is kept as long as this is. Raises InputError where it is none."""
        self._run, self._temporary = read_run(path), temporary

    def __repr__(self) -> str:
        return f"<Reconstruction of {len(self.poses)} frames in {self.path}>"

    @property
    def path(self) -> Path:
        """The run folder."""
        return self._run.path

    @property
    def timestamps_s(self) -> Array:
        """(n,) float64 seconds of the frames that have a pose."""
        return self._run.trajectory.timestamps_s

    @property
    def poses(self) -> Array:
        """(n, 4, 4) float64 world_from_cam."""
        return self._run.trajectory.world_from_cam

    @property
    def states(self) -> tuple[str, ...]:
        """How each frame came by its pose: started, tracked or interpolated."""
        return self._run.trajectory.states

    @property
    def is_keyframe(self) -> Array:
        """(n,) bool."""
        return self._run.trajectory.is_keyframe

    @property
    def camera(self) -> Camera | OpenCvLens:
        """The lens over the full-size image. Raises InputError where the run was stopped before it was found."""
        return lens_of(self._run)

    @cached_property
    def cloud(self) -> StaticCloud:
        """The static cloud. Raises InputError where the run was stopped before it."""
        return read_cloud(self.path / "cloud.ply")

    @property
    def masks(self) -> Masks:
        """P(moving) of every frame."""
        return Masks(self._run)

    @cached_property
    def gaussians(self) -> GaussianArrays | None:
        """The splat; None where none was made."""
        file = self.path / "gaussians.ply"
        return read_gaussians_ply(file) if os.path.lexists(file) else None

    @property
    def metrics(self) -> dict[str, Any]:
        """The figures of metrics.json."""
        return dict(self._run.metrics)

    @property
    def notes(self) -> tuple[str, ...]:
        """What was chosen and what went wrong, a line each."""
        return tuple(self._run.record.get("choices", ()))

    @property
    def observability(self) -> dict[str, Any]:
        """What the image motion let be known: its ``kind`` (none, rotation, plane, parallax), and from what.

        ``said`` is the line for people where something is missing, else None; empty for a run that was stopped before.
        """
        return dict(self._run.record.get("observability") or {})

    @property
    def scale(self) -> dict[str, Any]:
        """What run.json says of metres: ``metres_per_unit``, ``sigma_ratio`` (1 sigma), where from; empty without.

        ``applied``: all lengths of the run folder are metres; otherwise they are map units, and exports are in metres.
        ``refused`` says why what was asked for could not be measured.
        """
        return dict(self._run.record.get("scale") or {})

    @property
    def continues(self) -> dict[str, Any]:
        """Of a run that went on in a saved map: whether it was ``found`` there, how many images were ``placed``.

        ``said`` is the line for people. Empty for other runs.
        """
        return dict(self._run.record.get("continues") or {})

    def measure_scale(self, by: str) -> dict[str, Any]:
        """Metres a unit of this map, as ``mastd3r scale``; run.json has them from here on, and exports are in metres.

        by: the words of ``--scale``. Raises ConfigError for others, InputError where it cannot be measured, and the
        run stays as it is; OutputError.
        """
        wanted = measure(absolute(by))
        if wanted is None:
            raise ConfigError(f"scale: expected {', '.join(FORMS.values())}, got nothing")
        check_not_in_use(self.path)
        before = self.scale
        facts = scale_facts(wanted, lambda: material_of_run(self._run), self._run.record)
        if "refused" in facts:
            raise InputError(facts["refused"])
        if applied := before if before.get("applied") else before.get("before"):
            facts["before"] = applied  # the unit that is measured is the metre of that
        folder = RunFolder.again(self.path, self._run.record)
        folder.update(scale=facts)
        say_scale(self.path, folder.record)
        self._run = read_run(self.path)
        return facts

    @property
    def is_complete(self) -> bool:
        """False where the run was stopped; ``reason`` says why."""
        return self._run.record.get("status") == "complete"

    @property
    def reason(self) -> str | None:
        """Why the run is not complete."""
        reason: str | None = self._run.record.get("reason")
        return reason

    @property
    def config(self) -> Config:
        """The options that it was made with. Raises ConfigError for a config.yaml that nobody can read."""
        return config_from_text(self._run.config, f"{self.path}/config.yaml")

    def evaluate(self, sequence: str | Path) -> dict[str, Any]:
        """Figures against a sequence with truth, as metrics.json says them from here on; as ``mastd3r eval``.

        Raises InputError for a sequence that cannot be read or is another one, OutputError.
        """
        source = open_source(sequence, self.config.source)
        metrics = {**self.metrics, **evaluate(self.path, source.truth(), source.frames()).metrics}
        metrics |= self._cloud_error(sequence)
        write_json(self.path / "metrics.json", metrics)
        self._run = read_run(self.path)
        return metrics

    def _cloud_error(self, sequence: str | Path) -> dict[str, Any]:
        """How far the cloud, the dense one where there is one, is from what a sequence's depth sensor saw."""
        file = next((f for f in (self.path / CLOUD_FILE, self.path / "cloud.ply") if is_file(f)), None)
        lens = self._run.camera
        source = open_source(sequence, self.config.source, want_depth=True)
        if file is None or lens is None or not source.has_depth:
            return {}
        points = read_points(file)
        return evaluate_cloud(points, self._run.trajectory, source.truth(), source.frames(), lens)

    @one_blas_thread()
    def train_map(
        self,
        minutes: float | None = None,
        quality: MapQualityKind | None = None,
        *,
        source: str | Path | None = None,
        reporter: Reporter | None = None,
    ) -> dict[str, Any]:
        """Go on with the map, as ``mastd3r map``; gives the figures of metrics.json from here on.

        minutes: of training; by default as many steps, or minutes, as the options say. quality: draft, standard or
        high, instead of that of the run. source: where the photographs are, if no longer where the run read them.
        Raises InputError for a run without map and cloud, and a source that is not the run's, before anything has
        changed; ConfigError; OutputError, and what was there last stays.
        """
        if minutes is not None and not 0 < minutes < np.inf:
            raise ConfigError(f"minutes: expected a finite number above 0, got {minutes:g}")
        opened = open_source(self._photographs(source), self.config.source, want_semantic=False)
        from .continued_map import continue_map  # loads torch

        trained = continue_map(self._run, opened, self.config, minutes, quality, reporter or Silent())
        self.__dict__.pop("gaussians", None)
        evaluation = evaluate(self.path, opened.truth(), opened.frames())
        metrics = {**self.metrics, **evaluation.metrics, **trained}
        write_json(self.path / "metrics.json", metrics)
        if evaluation.ate is not None and (aligned := evaluation.ate.table()) is not None:
            RunFolder.again(self.path, self._run.record).write_aligned(aligned)
        write_run_report(self.path, opened, evaluation)
        self._run = read_run(self.path)
        return metrics

    def _photographs(self, source: str | Path | None) -> Path:
        """Where the photographs of the run are."""
        said = source if source is not None else (self._run.record.get("source") or {}).get("path", "")
        path = user_path(said or ".", f"{self.path}/run.json source.path" if source is None else "--source")
        if source is None and (not said or not os.path.exists(path)):
            raise InputError(
                f"{self.path}/run.json: expected the photographs at its source.path, got no such path as "
                f"{str(said)!r}; say with --source where they are"
            )
        return path

    def save(self, path: str | Path) -> Path:
        """Copy the run folder to ``path``, and stay there; a run that was there is replaced once the copy is whole.

        Raises OutputError where that is not ours to write.
        """
        target = user_path(path)
        if target.resolve() == self.path.resolve():
            return self.path
        where = claim(target, [self.path])
        with writing(target):
            shutil.copytree(self.path, where, dirs_exist_ok=True)
        settle(target, also_incomplete=True)
        self._run, self._temporary = read_run(target), None
        return target

    def save_map(self, out: Path, source: str | Path | None = None) -> None:
        """See ``pipeline.save_map``."""
        path = self._photographs(source)
        opened = open_source(path, self.config.source, want_semantic=False)
        save_run_as_map(self._run.in_metres(), opened, path, self.config, out)

    @one_blas_thread()
    def export(
        self,
        kind: str,
        out: str | Path,
        *,
        source: str | Path | None = None,
        undistort: bool | None = None,
        all_poses: bool = False,
        reporter: Reporter | None = None,
    ) -> Path:
        """The run in another format, as ``mastd3r export --to``: one of ``export.kinds.KINDS``; gives the path written.

        source: where the photographs are, if no longer where the run read them. undistort: whether images become those
        of a pinhole; None: where the lens is bent. all_poses: interpolated poses too, not only measured ones.
        Lengths are metres where the run knows them (``scale``), else map units.
        Raises ConfigError for a format or an option that is not known, InputError for one that the run has nothing for,
        and OutputError.
        """
        out, run = user_path(out, "out"), self._run.in_metres()
        _check_export(kind, source, undistort, all_poses)
        if kind in SPLATS:
            return export_splat(run, kind, out, all_poses=all_poses)
        if kind in TRAJECTORIES:
            return export_trajectory(run, kind, out, all_poses=all_poses)
        path = self._photographs(source)
        opened = open_source(path, self.config.source, want_semantic=False)
        if kind in DENSE:
            return export_dense(run, opened, kind, out, reporter or Silent())
        if kind == "plates":
            return export_plates(run, out, opened, path, all_poses=all_poses)
        return export_pictures(run, kind, out, opened, path, undistort=undistort, all_poses=all_poses)


def _check_export(kind: str, source: str | Path | None, undistort: bool | None, all_poses: bool) -> None:
    """Raise ConfigError for an option that the format does not have."""
    if kind not in KINDS:
        raise ConfigError(f"export: expected one of {', '.join(KINDS)}, got {kind!r}")
    said = {
        "source": (source is not None, (*PICTURES, *DENSE)),
        "undistort": (undistort is not None, UNDISTORTING),
        "all-poses": (all_poses, (*TRAJECTORIES, *PICTURES, "depth")),
    }
    for option, (given, kinds) in said.items():
        if given and kind not in kinds:
            raise ConfigError(f"export --{option}: expected --to {', '.join(kinds)}, got --to {kind}")
