"""Fixtures that several test files share: a small room clip made once, and a scene of which everything is known."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # as the command line does
os.environ.setdefault("OMP_NUM_THREADS", "1")  # networks are tiny here: torch's threads would spin more than they work

import numpy as np
import pytest
from numpy.typing import NDArray

from mastd3r.geometry.se3 import inverse, so3_exp, transform
from mastd3r.offline import renders
from mastd3r.sources import synthetic
from mastd3r.sources.room import Room
from mastd3r.types import Matches, WorkFrame

Array = NDArray[Any]


@pytest.fixture(scope="session", autouse=True)
def no_weights(tmp_path_factory: pytest.TempPathFactory) -> Iterator[None]:
    """What ``auto`` chooses must not depend on what this machine's user has downloaded."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("MASTD3R_HOME", str(tmp_path_factory.mktemp("home")))
        yield


@pytest.fixture(scope="session", autouse=True)
def one_room_a_seed() -> Iterator[None]:
    """Its textures take longer to draw than a dozen frames of it, and nothing changes them: each room is made once."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(synthetic, "Room", cache(Room))
        yield


@pytest.fixture
def short_flight(monkeypatch: pytest.MonkeyPatch) -> None:
    """A run's flight takes a second, not five: how long it should be has a test of its own."""
    monkeypatch.setattr(renders, "FLIGHT_S", (1.0, 1.0))


@pytest.fixture(scope="session")
def room_clip(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """24 frames of the made room at 160x120 and 5 frames a second, TUM layout with all truth. Read only."""
    folder = tmp_path_factory.mktemp("clips") / "room"
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(synthetic, "CLIP_FPS", 5.0)
        return synthetic.make_room_clip(folder, frames=24, width=160, height=120)


@pytest.fixture(scope="session")
def room_views() -> list[synthetic.SyntheticView]:
    """5 frames of the made room at 160x120, 10 frames a second, with exact depth. Read only."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(synthetic, "CLIP_FPS", 10.0)
        return list(synthetic.synthetic_frames(5, 160, 120))


@dataclass(frozen=True)
class ExactScene:
    """A wavy wall seen by cameras on an arc, under the solver's own lens: u = x_d (1 + k |x_d|² + m |x_d|⁴ + n |x_d|⁶).

    Written out here from the definition, so that nothing under test makes its own truth.
    """

    width: int
    height: int
    focal_px: float
    k: float
    cam_from_world: tuple[Array, ...]
    px: Array  # (p, 2) the grid of every view
    grid: tuple[int, int]
    higher: tuple[float, float] = (0.0, 0.0)  # m, n
    off_centre_px: tuple[float, float] = (0.0, 0.0)  # of the principal point from the image's centre

    @property
    def centre_px(self) -> Array:
        """(2,) principal point."""
        return np.array([(self.width - 1) / 2, (self.height - 1) / 2]) + self.off_centre_px

    @property
    def lens(self) -> Array:
        """(6,) log f, k, cx, cy, m, n."""
        return np.array([np.log(self.focal_px), self.k, *self.centre_px, *self.higher])

    def _bend(self, x: Array) -> Array:
        r2 = (x**2).sum(1, keepdims=True)
        return 1 + self.k * r2 + self.higher[0] * r2**2 + self.higher[1] * r2**3

    def rays(self, px: Array) -> Array:
        """(p, 2) distorted pixels to (p, 3) rays with z = 1."""
        x = (px - self.centre_px) / self.focal_px
        x = x * self._bend(x)
        return np.concatenate([x, np.ones((len(x), 1))], 1)

    def pixels(self, points_cam: Array) -> Array:
        """(p, 3) points to (p, 2) distorted pixels: the inverse of ``rays`` by fixed point."""
        u = points_cam[:, :2] / points_cam[:, 2:]
        x = u
        for _ in range(60):
            x = u / self._bend(x)
        return x * self.focal_px + self.centre_px

    def depth(self, i: int, px: Array | None = None) -> Array:
        """(p,) exact depth of view i's pixels: each ray cut with z = wall(x, y)."""
        world_from_cam = inverse(self.cam_from_world[i])
        direction = self.rays(self.px if px is None else px) @ world_from_cam[:3, :3].T
        origin = world_from_cam[:3, 3]
        low, high = np.zeros(len(direction)), np.full(len(direction), 40.0)
        for _ in range(60):
            middle = 0.5 * (low + high)
            p = origin + middle[:, None] * direction
            before = p[:, 2] < _wall(p[:, 0], p[:, 1])
            low, high = np.where(before, middle, low), np.where(before, high, middle)
        return 0.5 * (low + high)

    def points(self, i: int) -> Array:
        """(p, 3) in view i's camera."""
        return self.rays(self.px) * self.depth(i)[:, None]

    def j_from_i(self, i: int, j: int) -> Array:
        """(4, 4) true motion."""
        return self.cam_from_world[j] @ inverse(self.cam_from_world[i])

    def matches(self, i: int, j: int, noise_px: float = 0.0, seed: int = 0) -> Matches:
        """Exact matches of i's pixels in j, plus Gaussian noise; weight 0 outside the image."""
        new = transform(self.j_from_i(i, j), self.points(i))
        target = self.pixels(new)
        inside = (target > 0).all(1) & (target < [self.width - 1, self.height - 1]).all(1) & (new[:, 2] > 0)
        noise = np.random.default_rng((seed, i, j)).normal(0, noise_px, target.shape) if noise_px else 0.0
        return Matches(self.px, target + noise, inside.astype(float))

    def work_frame(self, i: int) -> WorkFrame:
        """View i as the stages pass it on; its picture is empty."""
        gray = np.zeros((self.height, self.width), np.uint8)
        return WorkFrame(i, i / 30, gray, self.px, self.grid, np.ones(len(self.px)), None, None)


def _wall(x: Array, y: Array) -> Array:
    return 3.0 + 0.7 * np.sin(1.3 * x + 0.4) * np.cos(1.1 * y) + 0.3 * np.sin(2.3 * y + 1.0)


def _arc(n: int, step: float) -> tuple[Array, ...]:
    poses = []
    for i in range(n):
        world_from_cam = np.eye(4)
        s = step * i
        world_from_cam[:3, 3] = [s, 0.25 * np.sin(2.0 * s), 0.5 * s * s + 0.1 * np.sin(3 * s)]
        world_from_cam[:3, :3] = so3_exp(np.array([0.15 * np.sin(1.5 * s), -0.3 * s, 0.2 * s]))
        poses.append(inverse(world_from_cam))
    return tuple(poses)


@pytest.fixture(scope="session")
def exact_scene() -> Callable[..., ExactScene]:
    """``exact_scene(n_views, step=…, focal_px=…, k=…)``."""

    def make(
        views: int,
        step: float = 0.15,
        focal_px: float = 260.0,
        k: float = 0.0,
        cell_px: int = 16,
        higher: tuple[float, float] = (0.0, 0.0),
        off_centre_px: tuple[float, float] = (0.0, 0.0),
    ) -> ExactScene:
        width, height = 320, 240
        rows, cols = height // cell_px, width // cell_px
        cy, cx = np.divmod(np.arange(rows * cols), cols)
        jitter = np.random.default_rng(0).uniform(0.2, 0.8, (rows * cols, 2))
        px = (np.stack([cx, cy], 1) + jitter) * cell_px
        arc = _arc(views, step)
        return ExactScene(width, height, focal_px, k, arc, px, (rows, cols), higher, off_centre_px)

    return make
