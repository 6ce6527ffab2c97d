"""Which way is down, from how cameras were held."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from mastd3r.geometry.upright import PITCH_RAD, TOLD_RAD, down, turn_upright


def walk(yaw_deg: float, pitch_deg: float, roll_deg: float, count: int = 60, seed: int = 0) -> np.ndarray:
    """Cameras that look about by ``yaw_deg``, all pitched, with a random roll; down is +y."""
    rng = np.random.default_rng(seed)
    yaws = np.linspace(-yaw_deg / 2, yaw_deg / 2, count)
    rolls = rng.normal(0, roll_deg, count)
    poses = np.tile(np.eye(4), (count, 1, 1))
    for pose, yaw, roll in zip(poses, yaws, rolls, strict=True):
        pose[:3, :3] = Rotation.from_euler("YXZ", [yaw, pitch_deg, roll], degrees=True).as_matrix()
    return poses


def angle_deg(a: np.ndarray, b: np.ndarray) -> float:
    return float(np.degrees(np.arccos(np.clip(a @ b, -1, 1))))


@pytest.mark.parametrize("seed", range(5))
def test_a_camera_that_looks_about_tells_its_own_pitch(seed: int) -> None:
    """In a world of any orientation: the first camera is tilted by 25 degrees, and gravity is found to 3."""
    turn = Rotation.random(random_state=seed).as_matrix()
    poses = walk(120, 25, 2, seed=seed)
    poses[:, :3, :3] = turn @ poses[:, :3, :3]
    found, sigma = down(poses)
    assert angle_deg(found, turn @ [0, 1, 0]) < 3
    assert sigma < TOLD_RAD


def test_a_camera_that_never_turns_says_how_little_it_tells() -> None:
    found, sigma = down(walk(0, 0, 1))
    assert angle_deg(found, np.array([0, 1.0, 0])) < 1
    assert sigma == pytest.approx(PITCH_RAD, rel=0.05)


@pytest.mark.parametrize("direction", [[0.1, 0.9, 0.2], [0, 1, 0], [0, -1, 0], [1, 0, 0]])
def test_upright_is_the_least_turn(direction: list[float]) -> None:
    unit = np.asarray(direction, float) / np.linalg.norm(direction)
    turn = turn_upright(unit)
    assert np.allclose(turn @ unit, [0, 1, 0], atol=1e-12) and np.isclose(np.linalg.det(turn), 1)
    assert Rotation.from_matrix(turn).magnitude() == pytest.approx(np.arccos(np.clip(unit[1], -1, 1)), abs=1e-6)
