"""``mastd3r save``: the keyframes of a run that has ended as a map, from its folder and the photographs."""

from __future__ import annotations

import os
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..config import Config
from ..errors import InputError
from ..export.map_folder import MapKeyframe, MapRecord, write_map
from ..export.read_run import Run
from ..export.run_folder import stamp
from ..export.tracks import Tracks
from ..geometry.se3 import inverse, transform
from ..mapping.ply import write_gaussians_ply
from ..parts import chosen_features, parts_of
from ..reading.files import user_path
from ..types import Source, Trajectory, WorkFrame
from .map_drawing import digest_of, drawn
from .photographs import check_size
from .renders import gaussians_of, lens_of
from .saved_map import SavedMap
from .working_eye import Look, WorkingEye, one_a_cell

Array = NDArray[Any]
STEP = 1e-3  # relative, of an inverse depth: over it a projection is taken to be straight


def save_run_as_map(run: Run, source: Source, source_path: Path, config: Config, out: Path) -> None:
    """Write the map of a run to the folder ``out``, in ``run.unit``. ``source``: its photographs, from ``source_path``.

    A run that went on in a saved map keeps the keyframes of that one too. Raises InputError for a run without
    keyframes, lens and tracks, a source that is not the run's, and a map that is no longer there; OutputError.
    """
    before = _map_before(run)
    record = map_of(run, source, config, before)
    inputs = [run.path, source_path] if before is None else [run.path, source_path, before.path]
    splat = before.gaussians if before is not None else None
    if os.path.lexists(run.path / "gaussians.ply"):
        splat = gaussians_of(run)
    elif splat is not None:
        splat = splat.in_lengths(run.lengths)
    write_splat = None if splat is None else lambda path: write_gaussians_ply(path, splat)
    write_map(out, record, write_splat, inputs)


def _map_before(run: Run) -> SavedMap | None:
    """The map that a run went on in."""
    facts = run.record.get("continues") or {}
    if not facts.get("found"):
        return None
    saved = SavedMap(user_path(str(facts.get("map") or "."), f"{run.path}/run.json continues.map"))
    if digest_of(saved.record) != facts.get("digest"):
        raise InputError(f"{saved.path}: expected the map that {run.path} went on in, got another one")
    return saved


def map_of(run: Run, source: Source, config: Config, before: SavedMap | None = None) -> MapRecord:
    """The same as a value."""
    lens, tracks = lens_of(run), run.tracks()
    check_size(run, source, lens)
    keyframes = run.trajectory.tracked().keyframes()  # poses that were guessed are no map
    if before is None and (len(keyframes.timestamps_s) < 2 or not len(tracks.point)):
        got = f"{len(keyframes.timestamps_s)} keyframes and {len(tracks.points_world)} points"
        raise InputError(f"{run.path}: expected keyframes with points of known depth, got {got}")
    eye = WorkingEye(lens, config)
    looks = _looks(run, keyframes, source, eye)
    points = _PointsOfKeyframes(tracks, keyframes, eye)
    made = [
        _keyframe(look, pose, points.of(n, look.work), eye.moving(run.mask(look.work.timestamp_s)))
        for n, (look, pose) in enumerate(zip(looks, keyframes.world_from_cam, strict=True))
    ]
    size, grid, known = eye.provider.size, eye.grid, list[MapKeyframe]()
    name, described = _described(config, eye, [look.work.gray for look in looks])
    made = [replace(kf, feature_px=d[0], descriptors=d[1]) for kf, d in zip(made, described, strict=True)]
    if before is not None:
        record = drawn(before.record, before.eye.camera, eye.camera, eye.provider)
        known = [_in_lengths(kf, run.lengths) for kf in record.keyframes]
        if record.features != name:
            described = _described(config, eye, [kf.gray for kf in known])[1]
            known = [replace(kf, feature_px=d[0], descriptors=d[1]) for kf, d in zip(known, described, strict=True)]
    return MapRecord(size, grid, lens, name, run.config, (*known, *made), str(run.path.resolve()), run.unit)


def _in_lengths(kf: MapKeyframe, factor: float) -> MapKeyframe:
    """The same with lengths times ``factor``."""
    pose = kf.world_from_cam.copy()
    pose[:3, 3] *= factor
    return replace(kf, world_from_cam=pose, inv_depth=kf.inv_depth / factor, depth_info=kf.depth_info * factor**2)


def _looks(run: Run, keyframes: Trajectory, source: Source, eye: WorkingEye) -> list[Look]:
    """The keyframes' photographs, looked at; in order of time."""
    wanted = {stamp(float(t)): n for n, t in enumerate(keyframes.timestamps_s)}
    found = dict[int, Look]()
    for frame in source.frames() if wanted else ():
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
        mine = np.flatnonzero(self.kf == n)
        points = transform(self.cam_from_world[n], self.world[self.point[mine]])
        mine, points = mine[points[:, 2] > 0], points[points[:, 2] > 0]
        cells, chosen = one_a_cell(self.px[mine], work, self.eye.provider.cell_px)
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


def _keyframe(look: Look, world_from_cam: Array, points: tuple[Array, Array, Array], moving: Array) -> MapKeyframe:
    (px, inv_depth, info), work = points, look.work
    none, texture = np.zeros((0, 2), np.float32), work.texture.astype(np.float32)
    points_of = (px, texture, inv_depth, info)
    x, y = np.clip(np.rint(px), 0, np.array(work.gray.shape[::-1]) - 1).astype(int).T
    features = (none, none.astype(np.float16))
    return MapKeyframe(work.timestamp_s, world_from_cam, work.gray, moving, *points_of, *features, look.small[y, x])


def _described(config: Config, eye: WorkingEye, images: list[Array]) -> tuple[str, list[tuple[Array, Array]]]:
    """The features' name and the features of each keyframe's image (h, w), where the part can say them."""
    features = parts_of(eye.provider, config).features
    if not hasattr(features, "descriptions"):
        nothing = np.zeros((0, 2), np.float32)
        return "", [(nothing, nothing.astype(np.float16))] * len(images)
    found = features.descriptions(images)
    return chosen_features(config)[0], [(px.astype(np.float32), d.astype(np.float16)) for px, d in found]
