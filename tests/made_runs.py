"""A finished run of which everything is known, with its photographs: what exports are tested on."""

from __future__ import annotations

import dataclasses
import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image
from scipy.spatial.transform import Rotation

from helpers import blobs
from mastd3r.camera.opencv_lens import OpenCvLens
from mastd3r.camera.pinhole import Camera
from mastd3r.export.run_folder import RunFolder
from mastd3r.export.tracks import Tracks
from mastd3r.geometry.se3 import inverse, transform
from mastd3r.types import State, StaticCloud, Trajectory

Array = NDArray[Any]
FPS = 30.0  # of a folder of images, whose files carry no times
NAMES = ("IMG_0007.JPG", "IMG_0008.JPG", "b/odd name.png", "b/x1.png", "b/x2.webp")


@dataclass(frozen=True)
class MadeRun:
    """Where it is, and what is true of it."""

    path: Path
    photographs: Path
    lens: Camera | OpenCvLens
    trajectory: Trajectory
    tracks: Tracks
    error_px: Array  # (m,) of the observations of ``tracks``


def made_run(
    root: Path,
    lens: Camera | OpenCvLens,
    states: tuple[State, ...] = ("started", *("tracked",) * 4),
    points: int = 60,
    noise_px: float = 0.4,
    tracked: bool = True,
    times_s: Array | None = None,
) -> MadeRun:
    """Five photographs in ``root``/photos (TUM layout, names of their own), and the run in ``root``/run."""
    times_s = 100 + np.arange(5) / FPS if times_s is None else times_s
    photographs = _photographs(root / "photos", times_s, lens)
    rng = np.random.default_rng(5)
    poses = np.tile(np.eye(4), (5, 1, 1))
    poses[:, :3, :3] = Rotation.from_rotvec(rng.normal(0, 0.05, (5, 3))).as_matrix()
    poses[:, :3, 3] = rng.normal(0, 0.2, (5, 3))
    trajectory = Trajectory(np.round(times_s, 6), poses, states, np.array([True, False, True, False, True]))
    world = rng.uniform([-0.8, -0.6, 4], [0.8, 0.6, 6], (points, 3)).astype(np.float32)
    colors = rng.integers(0, 256, (points, 3)).astype(np.uint8)
    exact = np.stack([lens.project(transform(inverse(p), world.astype(float))) for p in poses], 1)  # (n, 5, 2)
    px = (exact + rng.normal(0, noise_px, exact.shape)).astype(np.float32).reshape(-1, 2)
    point, frame = np.divmod(np.arange(5 * points, dtype=np.int32), 5)
    tracks = Tracks(world, colors, trajectory.timestamps_s, point.astype(np.int32), frame.astype(np.int32), px)

    folder = RunFolder(root / "run", ["mastd3r", "run"])
    folder.write_trajectory(trajectory)
    distortion = lens.distortion if isinstance(lens, OpenCvLens) else None
    folder.write_camera(lens.radial if isinstance(lens, OpenCvLens) else lens, distortion)
    ones = np.ones(points, np.float32)
    folder.write_cloud(StaticCloud(world, colors, ones, 0.01 * ones, np.zeros(points, np.int32)))
    if tracked:
        folder.write_tracks(tracks)
    for n, t in enumerate(times_s):
        folder.write_mask(float(t), moving_of(n, lens))
    names = {f"{t:.6f}": name for t, name in zip(times_s, NAMES, strict=True)}
    folder.update(source={"path": str(photographs), "kind": "tum"}, files=names)
    folder.write_metrics({"frames": 5})
    folder.finish()
    error_px = np.linalg.norm(px - exact.reshape(-1, 2), axis=1)
    return MadeRun(root / "run", photographs, lens, trajectory, tracks, error_px)


def moving_of(n: int, lens: Camera | OpenCvLens) -> Array:
    """(h / 2, w / 2) P(moving) of photograph n: a square that goes to the right."""
    moving = np.zeros((lens.height // 2, lens.width // 2))
    moving[10:20, 4 + 4 * n : 14 + 4 * n] = 1.0
    return moving


def _photographs(folder: Path, times_s: Array, lens: Camera | OpenCvLens) -> Path:
    images = blobs(5, lens.width, lens.height)
    lines = []
    for name, t, image in zip(NAMES, times_s, images, strict=True):
        path = folder / "shots" / name
        path.parent.mkdir(parents=True, exist_ok=True)
        Image.fromarray(image).save(path, quality=90)
        lines.append(f"{t:.6f} shots/{name}\n")
    (folder / "rgb.txt").write_text("".join(lines))
    return folder


def edited_record(run: Path, **fields: Any) -> None:
    """Change run.json; a field that is None is taken out."""
    record = json.loads((run / "run.json").read_text())
    record.update(fields)
    (run / "run.json").write_text(json.dumps({k: v for k, v in record.items() if v is not None}))


def without_distortion(camera: Camera) -> Camera:
    """The same camera with straight lines."""
    return dataclasses.replace(camera, k1=0.0, k2=0.0, k3=0.0)
