"""``mastd3r save``: the keyframes of a run that has ended as a map, from its folder and the photographs."""

from __future__ import annotations

import os
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from ..camera.opencv_lens import OpenCvLens
from ..camera.pinhole import Camera
from ..camera.rectification import Rectifier
from ..config import Config
from ..errors import InputError
from ..export.map_folder import MapKeyframe, MapRecord, write_map
from ..export.read_run import Run
from ..export.run_folder import stamp
from ..export.tracks import Tracks
from ..geometry.se3 import inverse, transform
from ..mapping.ply import write_gaussians_ply
from ..parts import chosen_features, parts_of
from ..pointmap.geometric import GeometricPointmaps, working_size
from ..types import Frame, Source, Trajectory, WorkFrame
from .photographs import check_size
from .renders import gaussians_of, lens_of

Array = NDArray[Any]
STEP = 1e-3  # relative, of an inverse depth: over it a projection is taken to be straight


def save_run_as_map(run: Run, source: Source, source_path: Path, config: Config, out: Path) -> None:
    """Write the map of a run to the folder ``out``, in ``run.unit``. ``source``: its photographs, from ``source_path``.

    Raises InputError for a run without keyframes, lens and tracks, and a source that is not the run's; OutputError.
    """
    record = map_of(run, source, config)
    splat = gaussians_of(run) if os.path.lexists(run.path / "gaussians.ply") else None
    write_splat = None if splat is None else lambda path: write_gaussians_ply(path, splat)
    write_map(out, record, write_splat, [run.path, source_path])


def map_of(run: Run, source: Source, config: Config) -> MapRecord:
    """The same as a value."""
    lens, tracks = lens_of(run), run.tracks()
    check_size(run, source, lens)
    keyframes = run.trajectory.tracked().keyframes()  # poses that were guessed are no map
    if len(keyframes.timestamps_s) < 2 or not len(tracks.point):
        got = f"{len(keyframes.timestamps_s)} keyframes and {len(tracks.points_world)} points"
        raise InputError(f"{run.path}: expected keyframes with points of known depth, got {got}")
    eye = WorkingEye(lens, config)
    works = _work_frames(run, keyframes, source, eye)
    points = _PointsOfKeyframes(tracks, keyframes, eye)
    made = [
        _keyframe(work, pose, points.of(n, work), eye.moving(run.mask(work.timestamp_s)))
        for n, (work, pose) in enumerate(zip(works, keyframes.world_from_cam, strict=True))
    ]
    name, described = _described(config, eye, works)
    made = [replace(kf, feature_px=d[0], descriptors=d[1]) for kf, d in zip(made, described, strict=True)]
    size, grid = eye.provider.size, works[0].grid
    return MapRecord(size, grid, lens, name, run.config, tuple(made), str(run.path.resolve()), run.unit)


class WorkingEye:
    """How a map sees photographs of its lens: at working size, rectified where the lens is more than radial.

    Always as the geometric provider does, whichever pointmaps the run had.
    """

    def __init__(self, lens: Camera | OpenCvLens, config: Config) -> None:
        """``lens`` over the photographs."""
        self.lens = lens
        self.rectifier = Rectifier(lens) if isinstance(lens, OpenCvLens) else None
        seen = (lens.width, lens.height) if self.rectifier is None else self.rectifier.size
        size = working_size(*seen, config.tracking.area_px)
        self.provider = GeometricPointmaps(*size, config.tracking.cell_px)
        pinhole = lens if self.rectifier is None else self.rectifier.pinhole
        assert isinstance(pinhole, Camera)
        self.camera = pinhole.resized(*size)  # of working images

    def look(self, index: int, timestamp_s: float, image: Array) -> WorkFrame:
        """A photograph (h, w, 3) uint8 RGB of the lens's size."""
        seen = image if self.rectifier is None else self.rectifier.image(image)
        return self.provider.look(Frame(index, timestamp_s, seen))

    def moving(self, mask: Array) -> Array:
        """(h, w) uint8 at working size of a mask over the photograph, of any size."""
        seen = mask if self.rectifier is None else self.rectifier.semantic(mask.astype(np.float32))
        return np.rint(cv2.resize(seen.astype(np.float32), self.provider.size)).astype(np.uint8)

    def working_px(self, px: Array) -> Array:
        """(m, 2) pixels of the photograph at working size."""
        if self.rectifier is not None:
            return self.camera.project(self.rectifier.lens.rays(px))
        scale = np.array(self.provider.size) / np.array([self.lens.width, self.lens.height])
        return (px + 0.5) * scale - 0.5


def _work_frames(run: Run, keyframes: Trajectory, source: Source, eye: WorkingEye) -> list[WorkFrame]:
    """The keyframes' photographs, looked at; in order of time."""
    wanted = {stamp(float(t)): n for n, t in enumerate(keyframes.timestamps_s)}
    found = {}
    for frame in source.frames():
        n = wanted.get(stamp(frame.timestamp_s))
        if n is not None:
            found[n] = eye.look(n, float(keyframes.timestamps_s[n]), frame.as_taken.image)
            if len(found) == len(wanted):
                break
    if len(found) != len(wanted):
        raise InputError(
            f"{source.name}: expected the photographs of the {len(wanted)} keyframes of {run.path}, got "
            f"{len(found)} of them"
        )
    return [found[n] for n in range(len(wanted))]


class _PointsOfKeyframes:
    """Which points each keyframe was measured to see, and how well their depths are known from the others."""

    def __init__(self, tracks: Tracks, keyframes: Trajectory, eye: WorkingEye) -> None:
        self.eye = eye
        rows = {stamp(float(t)): n for n, t in enumerate(keyframes.timestamps_s)}
        of_row = np.array([rows.get(stamp(float(t)), -1) for t in tracks.timestamps_s])
        kept = of_row[tracks.frame] >= 0
        self.point, self.kf = tracks.point[kept], of_row[tracks.frame[kept]]
        self.px = eye.working_px(tracks.px[kept].astype(float))
        self.world = tracks.points_world.astype(float)
        self.cam_from_world = inverse(keyframes.world_from_cam)

    def of(self, n: int, work: WorkFrame) -> tuple[Array, Array, Array]:
        """px (p, 2), inverse depths (p,) and their information (p,) of keyframe n, one point a cell of its grid.

        The point measured nearest to the pixel that was chosen for its cell; where there is none, that pixel itself
        and the median depth, with no information.
        """
        rows, cols = work.grid
        mine = np.flatnonzero(self.kf == n)
        points = transform(self.cam_from_world[n], self.world[self.point[mine]])
        at = np.floor((self.px[mine] + 0.5) / self.eye.provider.cell_px).astype(int)
        good = (points[:, 2] > 0) & (at >= 0).all(1) & (at < [cols, rows]).all(1)
        mine, points, at = mine[good], points[good], at[good]
        cell = at[:, 1] * cols + at[:, 0]
        order = np.argsort(np.linalg.norm(self.px[mine] - work.px[cell], axis=1), kind="stable")
        cells, first = np.unique(cell[order], return_index=True)
        chosen = order[first]
        px, info = work.px.copy(), np.zeros(len(work.px))
        inv_depth = np.full(len(px), 1.0 if not len(chosen) else float(np.median(1 / points[chosen, 2])))
        px[cells], inv_depth[cells] = self.px[mine[chosen]], 1 / points[chosen, 2]
        info[cells] = self._information(n, self.point[mine[chosen]], points[chosen])
        return px, inv_depth, info

    def _information(self, n: int, point: Array, points_cam: Array) -> Array:
        """(m,) information of inverse depths of points (m,) in keyframe n, a pixel's noise in every other keyframe."""
        place = np.full(len(self.world), -1)
        place[point] = np.arange(len(point))
        others = np.flatnonzero((place[self.point] >= 0) & (self.kf != n))
        out = np.zeros(len(point))
        for k in np.unique(self.kf[others]):
            row = place[self.point[others[self.kf[others] == k]]]
            k_from_n = self.cam_from_world[k] @ inverse(self.cam_from_world[n])
            here = transform(k_from_n, points_cam[row])
            there = transform(k_from_n, points_cam[row] / (1 + STEP))
            seen = (here[:, 2] > 0) & (there[:, 2] > 0)
            camera, step = self.eye.camera, STEP / points_cam[row[seen], 2:]
            out[row[seen]] += (((camera.project(there[seen]) - camera.project(here[seen])) / step) ** 2).sum(1)
        return out


def _keyframe(work: WorkFrame, world_from_cam: Array, points: tuple[Array, Array, Array], moving: Array) -> MapKeyframe:
    px, inv_depth, info = points
    none, texture = np.zeros((0, 2), np.float32), work.texture.astype(np.float32)
    points_of = (px, texture, inv_depth, info)
    return MapKeyframe(work.timestamp_s, world_from_cam, work.gray, moving, *points_of, none, none.astype(np.float16))


def _described(config: Config, eye: WorkingEye, works: list[WorkFrame]) -> tuple[str, list[tuple[Array, Array]]]:
    """The features' name and the features of each keyframe, where the part can say them."""
    features = parts_of(eye.provider, config).features
    if not hasattr(features, "descriptions"):
        nothing = np.zeros((0, 2), np.float32)
        return "", [(nothing, nothing.astype(np.float16))] * len(works)
    found = features.descriptions([work.gray for work in works])
    return chosen_features(config)[0], [(px.astype(np.float32), d.astype(np.float16)) for px, d in found]
