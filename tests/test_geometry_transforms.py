"""Rigid and similarity transforms: group axioms, tangent maps, and the corners at angle 0 and pi."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from mastd3r.geometry.quaternion import quaternion_from_rotation
from mastd3r.geometry.se3 import (
    adjoint,
    hat,
    interpolate,
    inverse,
    nearest_rotation,
    se3_exp,
    se3_log,
    so3_exp,
    so3_log,
    transform,
)
from mastd3r.geometry.sim3 import Sim3, procrustes

Array = NDArray[Any]
QUICK = settings(max_examples=60, deadline=None)


def vectors(limit: float, n: int = 3) -> st.SearchStrategy[Array]:
    return st.lists(st.floats(-limit, limit), min_size=n, max_size=n).map(np.array)


directions = vectors(1.0).filter(lambda v: np.linalg.norm(v) > 0.1).map(lambda v: v / np.linalg.norm(v))
twists = st.tuples(vectors(5.0), directions, st.floats(0, 3.1)).map(lambda t: np.r_[t[0], t[2] * t[1]])
poses = twists.map(se3_exp)
similarities = st.tuples(poses, st.floats(0.1, 10)).map(lambda t: Sim3.from_rigid(t[0], t[1]))


@QUICK
@given(poses, poses, poses, vectors(5.0))
def test_rigid_transforms_are_a_group_that_acts_on_points(a: Array, b: Array, c: Array, x: Array) -> None:
    np.testing.assert_allclose((a @ b) @ c, a @ (b @ c), atol=1e-9)
    np.testing.assert_allclose(a @ inverse(a), np.eye(4), atol=1e-9)
    np.testing.assert_allclose(inverse(a @ b), inverse(b) @ inverse(a), atol=1e-9)
    np.testing.assert_allclose(transform(a @ b, x), transform(a, transform(b, x)), atol=1e-9)
    np.testing.assert_allclose(a[:3, :3] @ a[:3, :3].T, np.eye(3), atol=1e-12)
    assert np.linalg.det(a[:3, :3]) == pytest.approx(1)


@QUICK
@given(twists)
def test_exp_and_log_are_inverse(xi: Array) -> None:
    np.testing.assert_allclose(se3_log(se3_exp(xi)), xi, atol=1e-7)


@QUICK
@given(directions, st.floats(-12, -3), vectors(2.0))
def test_near_the_identity(axis: Array, power: float, rho: Array) -> None:
    """Small angles down to nothing keep their digits, across the switch to the series."""
    phi = 10**power * axis
    np.testing.assert_allclose(so3_log(so3_exp(phi)), phi, rtol=1e-6, atol=1e-15)
    series = np.eye(3) + hat(phi) + hat(phi) @ hat(phi) / 2
    np.testing.assert_allclose(so3_exp(phi), series, atol=1e-9)
    xi = np.r_[rho, phi]
    np.testing.assert_allclose(se3_exp(xi)[:3, 3], rho + np.cross(phi, rho) / 2, atol=1e-6)
    np.testing.assert_allclose(se3_log(se3_exp(xi)), xi, atol=1e-9)


@QUICK
@given(directions, st.floats(0, 1e-3))
def test_near_half_a_turn(axis: Array, short: float) -> None:
    """At pi the axis has two signs; the rotation is one, and the angle is never above pi."""
    rotation = so3_exp((np.pi - short) * axis)
    phi = so3_log(rotation)
    assert np.linalg.norm(phi) <= np.pi + 1e-9
    assert np.linalg.norm(phi) == pytest.approx(np.pi - short, abs=1e-7)
    np.testing.assert_allclose(so3_exp(phi), rotation, atol=1e-9)


@pytest.mark.parametrize("axis", np.eye(3))
def test_exactly_half_a_turn(axis: Array) -> None:
    rotation = 2 * np.outer(axis, axis) - np.eye(3)
    np.testing.assert_allclose(np.abs(so3_log(rotation)), np.pi * axis, atol=1e-12)
    np.testing.assert_allclose(quaternion_from_rotation(rotation), np.r_[0, axis], atol=1e-12)


@QUICK
@given(poses, twists)
def test_adjoint_moves_a_perturbation_to_the_other_side(a: Array, xi: Array) -> None:
    small = 0.1 * xi
    np.testing.assert_allclose(a @ se3_exp(small), se3_exp(adjoint(a) @ small) @ a, atol=1e-8)


@QUICK
@given(poses, poses)
def test_adjoint_is_a_homomorphism(a: Array, b: Array) -> None:
    np.testing.assert_allclose(adjoint(a @ b), adjoint(a) @ adjoint(b), atol=1e-8)
    np.testing.assert_allclose(adjoint(inverse(a)) @ adjoint(a), np.eye(6), atol=1e-8)


def test_inverse_takes_stacks() -> None:
    stack = np.stack([se3_exp(np.arange(6) * 0.1 * k) for k in range(4)])
    np.testing.assert_allclose(inverse(stack) @ stack, np.tile(np.eye(4), (4, 1, 1)), atol=1e-12)


@QUICK
@given(poses, twists.filter(lambda xi: np.linalg.norm(xi[3:]) < 3.0), st.floats(0, 1))
def test_interpolation_runs_at_constant_speed_between_its_ends(a: Array, xi: Array, ratio: float) -> None:
    b = a @ se3_exp(xi)
    np.testing.assert_allclose(interpolate(a, b, 0.0), a, atol=1e-9)
    np.testing.assert_allclose(interpolate(a, b, 1.0), b, atol=1e-7)
    middle = interpolate(a, b, ratio)
    turned = np.linalg.norm(so3_log(a[:3, :3].T @ middle[:3, :3]))
    assert turned == pytest.approx(ratio * np.linalg.norm(xi[3:]), abs=1e-6)
    np.testing.assert_allclose(middle[:3, 3], a[:3, 3] + ratio * (b[:3, 3] - a[:3, 3]), atol=1e-9)


@QUICK
@given(poses, vectors(1e-3, 9))
def test_nearest_rotation_undoes_small_noise(a: Array, noise: Array) -> None:
    found = nearest_rotation(a[:3, :3] + noise.reshape(3, 3))
    np.testing.assert_allclose(found.T @ found, np.eye(3), atol=1e-12)
    assert np.linalg.det(found) > 0 and np.abs(found - a[:3, :3]).max() < 5e-3


@QUICK
@given(similarities, similarities, similarities, vectors(3.0))
def test_similarities_are_a_group_that_acts_on_points(a: Sim3, b: Sim3, c: Sim3, x: Array) -> None:
    np.testing.assert_allclose((a @ b).apply(x), a.apply(b.apply(x)), rtol=1e-9, atol=1e-8)
    np.testing.assert_allclose(((a @ b) @ c).apply(x), (a @ (b @ c)).apply(x), rtol=1e-9, atol=1e-7)
    np.testing.assert_allclose(a.inverse().apply(a.apply(x)), x, atol=1e-8)
    same = a @ Sim3.identity()
    np.testing.assert_allclose(same.apply(x), a.apply(x), atol=1e-12)
    np.testing.assert_allclose(Sim3.from_rigid(a.rigid, a.scale).apply(x), a.apply(x), atol=1e-12)
    np.testing.assert_allclose(transform(a.matrix, x), a.apply(x), rtol=1e-9, atol=1e-9)
    np.testing.assert_allclose(a.in_lengths(3.0).apply(x), 3 * a.apply(x), rtol=1e-12, atol=1e-12)


@QUICK
@given(similarities, st.integers(0, 10**6), st.booleans())
def test_procrustes_finds_the_motion(truth: Sim3, seed: int, with_scale: bool) -> None:
    rng = np.random.default_rng(seed)
    points_b = rng.normal(size=(12, 3))
    truth = truth if with_scale else Sim3.from_rigid(truth.rigid)
    points_a = truth.apply(points_b)
    weight = rng.uniform(0.1, 1, 12)
    weight[:2] = 0
    points_a[:2] += 100  # rows of weight 0 have no say
    found = procrustes(points_a, points_b, weight, with_scale)
    assert found.scale == pytest.approx(truth.scale, rel=1e-7)
    np.testing.assert_allclose(found.apply(points_b[2:]), points_a[2:], rtol=1e-7, atol=1e-7)


def test_procrustes_gives_a_rotation_even_where_a_mirror_fits_better() -> None:
    points = np.random.default_rng(0).normal(size=(20, 3))
    found = procrustes(points * [1, 1, -1], points, np.ones(20))
    assert np.linalg.det(found.rotation) == pytest.approx(1)


def test_procrustes_refuses_fewer_than_three_points() -> None:
    with pytest.raises(ValueError, match="at least 3 weighted points, got 2"):
        procrustes(np.eye(3), np.eye(3), np.array([1.0, 1.0, 0.0]))
