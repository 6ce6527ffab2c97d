"""A run folder in the browser."""

from __future__ import annotations

import threading
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..export.mesh_files import glb_bytes, has_faces, is_glb, read_mesh
from ..export.point_cloud import read_coloured_points
from ..export.read_run import Run, read_run
from ..export.run_folder import stamp
from ..export.trajectory_files import read_states
from ..mapping.gaussian_arrays import GaussianArrays
from ..mapping.ply import read_gaussians_ply
from ..reading.files import is_file, whole_bytes
from ..types import State
from .pictures import Pictures
from .scene import Scene
from .server import LOOPBACK, address, open_server

Array = NDArray[Any]
SPLAT, SPARSE, DENSE, MESHES = "gaussians.ply", "cloud.ply", "cloud_dense.ply", ("mesh.glb", "mesh.ply")
MISSING = {
    SPLAT: "No splat: no gaussians.ply in this folder (mastd3r map makes one).",
    SPARSE: "No sparse cloud: no cloud.ply in this folder.",
}
POINT_RATIO = 0.5  # size of a drawn point of the sparse cloud, in the spacing that the file tells
DENSE_RATIO = 1 / 400  # of the typical depth


@dataclass
class Content:
    """All of a run folder that has a place in the scene, read and checked."""

    run: Run
    frames: list[tuple[float, Array | None, State]]
    splat: GaussianArrays | None = None
    sparse: tuple[Array, Array, float | None] | None = None  # points, colours, spacing
    dense: tuple[Array, Array] | None = None
    mesh: bytes | None = None
    notices: list[str] = field(default_factory=list)


class Viewer:
    """A run that is being served. ``close`` ends it."""

    def __init__(self, scene: Scene, where: str, notices: Sequence[str]) -> None:
        self.scene, self.address, self.notices = scene, where, tuple(notices)

    def close(self) -> None:
        """End the server."""
        self.scene.close()

    def __enter__(self) -> Viewer:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


def show_run(path: Path | str, host: str = LOOPBACK, port: int | None = None, files: Sequence[Path] = ()) -> Viewer:
    """Serve a run folder, and ``files`` beside it: a dense cloud (.ply) or a mesh (.ply, .glb) that was exported.

    Everything is read before the server opens. Raises InputError for what is no run folder and for damaged files,
    MissingPackage without viser, and ConfigError for an address that cannot be served on.
    """
    content = read_content(Path(path), files)
    server = open_server(content.run.path.resolve().name, host, port)
    scene = Scene(server, content.run.camera, typical_depth(content))
    notices = list(content.notices)
    if content.splat is not None and (left_out := scene.set_splat(content.splat)):
        notices.append(f"{SPLAT}: {left_out} Gaussians that are not finite are left out.")
    if content.dense is not None:
        spacing = DENSE_RATIO * typical_depth(content)
        scene.set_cloud("dense", *content.dense, spacing, visible=content.splat is None)
    if content.mesh is not None:
        scene.set_mesh(content.mesh, visible=content.splat is None and content.dense is None)
    if content.sparse is not None:
        points, colours, sparse_spacing = content.sparse
        alone = content.splat is None and content.dense is None and content.mesh is None
        scene.set_cloud("sparse", points, colours, sparse_spacing, visible=alone)
    scene.say(*notices)
    if content.frames:
        times_s, poses, states = zip(*content.frames, strict=True)
        scene.add_frames(times_s, poses, states)
    scene.on_select(_Shower(scene, Pictures(content.run), [t for t, _, _ in content.frames]))
    return Viewer(scene, address(server), notices)


def read_content(path: Path, files: Sequence[Path] = ()) -> Content:
    """What a run folder holds. Raises InputError."""
    run = read_run(path)
    content = Content(run, frames_of(run), notices=_status(run))
    if is_file(path / SPLAT):
        content.splat = read_gaussians_ply(path / SPLAT)
    if is_file(path / SPARSE):
        points, colours, spacing = read_coloured_points(path / SPARSE)
        typical = None if spacing is None or not len(spacing) else POINT_RATIO * float(np.median(spacing))
        content.sparse = (points, colours, typical)
    here = [path / name for name in (DENSE, *MESHES) if is_file(path / name)]
    for file in [*here, *files]:
        if is_glb(file):
            content.mesh = whole_bytes(file, "a readable mesh")
        elif has_faces(file):
            content.mesh = glb_bytes(*read_mesh(file))
        else:
            content.dense = read_coloured_points(file)[:2]
    content.notices += [line for name, line in MISSING.items() if not is_file(path / name)]
    if run.camera is None:
        content.notices.append("No lens: no camera.json in this folder; the field of view is assumed.")
    if all(pose is None for _, pose, _ in content.frames):
        content.notices.append("No frame has a pose.")
    return content


def frames_of(run: Run) -> list[tuple[float, Array | None, State]]:
    """(time, pose or None, state) of every frame, the lost ones too where states.txt tells. Raises InputError."""
    trajectory = run.trajectory
    posed = zip(trajectory.timestamps_s, trajectory.world_from_cam, trajectory.states, strict=True)
    rows: dict[str, tuple[float, Array | None, State]] = {stamp(float(t)): (float(t), p, s) for t, p, s in posed}
    if is_file(run.path / "states.txt"):
        for time_s, state in read_states(run.path / "states.txt"):
            _, pose, _ = rows.get(stamp(time_s), (time_s, None, state))
            rows[stamp(time_s)] = (time_s, pose, state)
    return sorted(rows.values(), key=lambda row: row[0])


def typical_depth(content: Content) -> float:
    """Of the scene, in map units: as the map says, else of the cloud before the first camera, else of the path."""
    facts = content.run.record.get("map")
    said = facts.get("median_depth") if isinstance(facts, dict) else None
    if isinstance(said, int | float) and np.isfinite(said) and said > 0:
        return float(said)
    poses = [pose for _, pose, _ in content.frames if pose is not None]
    clouds = (content.sparse[0] if content.sparse else None, content.dense[0] if content.dense else None)
    points = next((cloud for cloud in clouds if cloud is not None and len(cloud)), None)
    if points is not None and poses:
        before = (points - poses[0][:3, 3]) @ poses[0][:3, 2]
        if (before > 0).any():
            return float(np.median(before[before > 0]))
    extent = float(np.ptp([pose[:3, 3] for pose in poses], axis=0).max()) if poses else 0.0
    return extent if extent > 0 else 1.0


def _status(run: Run) -> list[str]:
    """Lines for people about a run that is not what it might be."""
    lines = []
    if run.record.get("status") != "complete":
        lines.append(f"This run is {run.record.get('status')}: {run.record.get('reason') or 'no reason recorded'}")
    observability = run.record.get("observability")
    if isinstance(observability, dict) and observability.get("said"):
        lines.append(str(observability["said"]))
    return lines


class _Shower:
    """Shows the picture of a frame; while a newer one is asked for, an older is not begun."""

    def __init__(self, scene: Scene, pictures: Pictures, times_s: Sequence[float]) -> None:
        self._scene, self._pictures, self._times_s = scene, pictures, times_s
        self._one_at_a_time = threading.Lock()

    def __call__(self, index: int) -> None:
        with self._one_at_a_time:
            if index == self._scene.selected:
                picture = self._pictures.at(self._times_s[index])
                self._scene.set_image(picture.image, picture.mask, picture.said)
