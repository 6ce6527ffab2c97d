"""Rotations as quaternions: at every angle, one by one and many at once."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from mastd3r.geometry.quaternion import quaternion_from_rotation, rotation_from_quaternion

ANGLES = [0.0, 1e-12, 1e-8, np.pi, np.pi - 1e-9, np.pi + 1e-9]


@settings(max_examples=200, deadline=None)
@given(
    axis=st.tuples(*[st.floats(-1, 1)] * 3).filter(lambda a: np.linalg.norm(a) > 1e-3),
    angle=st.one_of(st.floats(-7, 7), st.sampled_from(ANGLES)),
)
def test_quaternions_hold_at_every_angle(axis: tuple[float, float, float], angle: float) -> None:
    rotation = Rotation.from_rotvec(np.array(axis) / np.linalg.norm(axis) * angle).as_matrix()
    wxyz = quaternion_from_rotation(rotation)
    assert wxyz.shape == (4,) and np.linalg.norm(wxyz) == pytest.approx(1, abs=1e-12) and wxyz[0] >= 0
    assert np.allclose(rotation_from_quaternion(wxyz), rotation, atol=1e-12)
    assert np.allclose(Rotation.from_quat(wxyz[[1, 2, 3, 0]]).as_matrix(), rotation, atol=1e-12)


def test_half_turns_about_the_axes() -> None:
    turns = np.stack([np.diag([1.0, -1, -1]), np.diag([-1.0, 1, -1]), np.diag([-1.0, -1, 1]), np.eye(3)])
    wanted = [[0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1], [1, 0, 0, 0]]
    assert np.allclose(np.abs(quaternion_from_rotation(turns)), wanted)


def test_many_at_once_are_those_one_by_one() -> None:
    """To the last bit: a trajectory's file does not depend on how many rows are written together."""
    turns = Rotation.from_rotvec(np.random.default_rng(0).normal(0, 2, (60, 3))).as_matrix()
    alone = np.stack([quaternion_from_rotation(turn) for turn in turns])
    assert (quaternion_from_rotation(turns) == alone).all()
    assert (quaternion_from_rotation(turns.reshape(3, 20, 3, 3)) == alone.reshape(3, 20, 4)).all()
    assert quaternion_from_rotation(np.zeros((0, 3, 3))).shape == (0, 4)


def test_the_length_of_a_quaternion_does_not_matter() -> None:
    wxyz = np.random.default_rng(0).normal(size=(3, 5, 4))
    assert np.allclose(rotation_from_quaternion(wxyz), rotation_from_quaternion(-7 * wxyz), atol=1e-12)
