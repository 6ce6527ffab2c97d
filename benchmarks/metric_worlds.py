"""Made maps whose metres are known: what ``metric_scale.py`` and the tests count how often a sigma holds on."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from mastd3r.camera.pinhole import Camera
from mastd3r.errors import SlamError
from mastd3r.export.tracks import Tracks
from mastd3r.geometry.se3 import inverse, transform
from mastd3r.metric.depth import SensorDepth, scale_from_depth
from mastd3r.metric.estimate import Scale
from mastd3r.metric.ground import scale_from_height
from mastd3r.metric.material import Material
from mastd3r.metric.picked import scale_from_points
from mastd3r.metric.positions import Positions, scale_from_positions
from mastd3r.metric.spec import parsed
from mastd3r.types import Trajectory

Array = NDArray[Any]
LENS = Camera(110.0, 110.0, 79.5, 59.5, 160, 120)
METRES = 3.7  # a unit of the made maps


def walk(rng: np.random.Generator, frames: int, length: float = 8.0) -> Array:
    """(n, 4, 4) poses along a bent level path, metres; the camera looks ahead and wavers."""
    at = np.linspace(0, 1, frames)
    bend = rng.normal(0, 1, (3, 2))
    places = np.stack([np.sin(2 * at) + 0.1 * bend[0, 0] * np.sin(9 * at), np.zeros(frames), length / 2 * at], 1)
    places[:, 1] = 0.03 * np.sin(7 * at + bend[1, 0])
    poses = np.tile(np.eye(4), (frames, 1, 1))
    poses[:, :3, :3] = Rotation.from_rotvec(rng.normal(0, 0.02, (frames, 3))).as_matrix()
    poses[:, :3, 3] = places
    return poses


def drift(rng: np.random.Generator, count: int, sigma: float, memory: float = 0.9) -> Array:
    """(n, 3) errors that neighbours share: an autoregressive process of that 1 sigma."""
    steps = rng.normal(0, sigma * np.sqrt(1 - memory**2), (count, 3))
    out = np.empty((count, 3))
    out[0] = rng.normal(0, sigma, 3)
    for n in range(1, count):
        out[n] = memory * out[n - 1] + steps[n]
    return out


def material(
    poses: Array,
    points: Array,
    rng: np.random.Generator,
    depth_noise: float = 0.0,
    keyframe_every: int = 4,
    **known: Any,
) -> Material:
    """A map, in its unit, of cameras (n, 4, 4) and points (m, 3) in metres; each frame sees what is in its image.

    ``depth_noise``: relative 1 sigma along the ray from the first camera that sees a point.
    """
    frames, count = len(poses), len(points)
    moved = points.copy()
    seen: list[tuple[Array, Array, Array]] = []
    fresh = np.ones(count, bool)
    for n, pose in enumerate(poses):
        cam = transform(inverse(pose), points)
        ahead = cam[:, 2] > 0.2
        px = LENS.project(np.where(ahead[:, None], cam, 1.0))
        inside = ahead & (px > -0.5).all(1) & (px < np.array([LENS.width, LENS.height]) - 0.5).all(1)
        rows = np.flatnonzero(inside & fresh)
        moved[rows] = pose[:3, 3] + (points[rows] - pose[:3, 3]) * np.exp(rng.normal(0, depth_noise, (len(rows), 1)))
        fresh[rows] = False
        there = np.flatnonzero(inside)
        seen.append((there, np.full(len(there), n), px[there]))
    point, frame, px = (np.concatenate(c) for c in zip(*seen, strict=True))
    order = np.lexsort((frame, point))
    world = poses.copy()
    world[:, :3, 3] /= METRES
    times = np.arange(frames) / 10
    trajectory = Trajectory(
        times, world, ("started", *("tracked",) * (frames - 1)), np.arange(frames) % keyframe_every == 0
    )
    tracks = Tracks(
        (moved / METRES).astype(np.float32),
        np.zeros((count, 3), np.uint8),
        times,
        point[order].astype(np.int32),
        frame[order].astype(np.int32),
        px[order].astype(np.float32),
    )
    return Material("made", trajectory, tracks, LENS, down_sigma_rad=np.radians(3), **known)


def street(rng: np.random.Generator, count: int = 3000, height: float = 1.5, bumps: float = 0.02) -> Array:
    """(m, 3) points of uneven ground ``height`` metres below the path of ``walk``, and of walls beside it."""
    ground = np.stack([rng.uniform(-6, 6, count), rng.normal(height, bumps, count), rng.uniform(-2, 16, count)], 1)
    wall = np.stack(
        [rng.choice([-5.0, 6.0], count // 2), rng.uniform(-3, height, count // 2), rng.uniform(0, 16, count // 2)], 1
    )
    return np.concatenate([ground, wall])


def positions_trial(seed: int, gps_m: float = 0.3, drift_m: float = 0.02) -> Scale:
    """A path of 8 m with drift, against positions with noise, a sixth of which are wrong."""
    rng = np.random.default_rng(seed)
    poses = walk(rng, 150)
    true_m = poses[:, :3, 3].copy()
    poses[:, :3, 3] += drift(rng, len(poses), drift_m)
    map_ = material(poses, np.zeros((0, 3)), rng)
    known = true_m @ Rotation.random(random_state=seed).as_matrix().T + 100 + rng.normal(0, gps_m, true_m.shape)
    wrong = rng.random(len(known)) < 1 / 6
    known[wrong] += rng.normal(0, 5, (int(wrong.sum()), 3))
    return scale_from_positions(Positions(Path("made.txt"), map_.trajectory.timestamps_s, known), map_)


def depth_trial(seed: int, folder: Path, frame_ratio: float = 0.01, depth_noise: float = 0.03) -> Scale:
    """Twelve frames of a street with a sensor whose metre differs from frame to frame, and a fifth of wrong points."""
    rng = np.random.default_rng(seed)
    poses, points = walk(rng, 12), street(rng, 800)
    map_ = material(poses, points, rng, depth_noise)
    files = []
    for n, pose in enumerate(poses):
        px, z = map_.observed(float(map_.trajectory.timestamps_s[n]))
        assert map_.tracks is not None
        mine = map_.tracks.point[map_.tracks.frame == n]
        true_z = transform(inverse(pose), points[mine])[:, 2]
        true_z[rng.random(len(z)) < 0.2] *= 1.5
        depth = np.zeros((LENS.height, LENS.width), np.float32)
        x, y = np.rint(px).astype(int).T
        depth[y, x] = true_z * np.exp(rng.normal(0, frame_ratio))
        files.append(folder / f"{map_.trajectory.timestamps_s[n]:.6f}.npy")
        np.save(files[-1], depth)
    return scale_from_depth(
        SensorDepth(folder, map_.trajectory.timestamps_s, tuple(files), {p.stem: p for p in files}, 1.0), map_
    )


def height_trial(seed: int, depth_noise: float = 0.02) -> Scale:
    """A street whose ground lies 1.5 m below, slopes by some centimetres, and is told to be 1.5 m below."""
    rng = np.random.default_rng(seed)
    points = street(rng, 1500)
    points[:, 1] += rng.normal(0, 0.04) * 1.5  # the ground is not where it should be, by what UNEVEN says
    return scale_from_height(1.5, material(walk(rng, 20), points, rng, depth_noise))


def points_trial(seed: int, depth_noise: float = 0.03, picked_px: float = 1.0) -> Scale:
    """A slanted wall with noisy depths; a person points at two places of it, a pixel beside."""
    rng = np.random.default_rng(seed)
    across = rng.uniform(-4, 4, (1500, 2))
    points = np.stack([across[:, 0], across[:, 1] * 0.75, 6 + 0.4 * across[:, 0]], 1)
    map_ = material(walk(rng, 8, 0.5), points, rng, depth_noise)
    px = np.array([[40.0, 45.0], [115.0, 75.0]])
    rays = LENS.rays(px) @ map_.trajectory.world_from_cam[0, :3, :3].T
    start = map_.trajectory.world_from_cam[0, :3, 3] * METRES
    ends = start + rays * ((6 + 0.4 * start[0] - start[2]) / (rays[:, 2] - 0.4 * rays[:, 0]))[:, None]
    (x0, y0), (x1, y1) = px + rng.normal(0, picked_px, (2, 2))
    metres = float(np.linalg.norm(ends[1] - ends[0]))
    return scale_from_points(parsed(f"points:0:{x0},{y0}:{x1},{y1}={metres}"), map_)


def held(scales: list[Scale | SlamError], true: float = METRES) -> dict[str, float]:
    """How often the true factor lies within 1 and 2 sigma, the error and the sigma (median), how many gave none."""
    found = [s for s in scales if isinstance(s, Scale)]
    error = np.array([np.log(s.metres_per_unit / true) for s in found])
    sigma = np.array([s.sigma_ratio for s in found], float)
    return {
        "trials": len(scales),
        "refused": len(scales) - len(found),
        "within_1_sigma": float((np.abs(error) < sigma).mean()),
        "within_2_sigma": float((np.abs(error) < 2 * sigma).mean()),
        "error_rms": float(np.sqrt((error**2).mean())),
        "sigma_median": float(np.median(sigma)),
        "bias": float(error.mean()),
    }
