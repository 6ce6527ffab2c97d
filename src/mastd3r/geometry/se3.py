"""Rigid transforms as (4, 4) float64 arrays. Tangent order: translation, rotation; perturbations act on the left."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from .quaternion import quaternion_from_rotation

Array = NDArray[Any]
_SMALL = 1e-7


def hat(v: Array) -> Array:
    """(3,) to the (3, 3) matrix of v x."""
    return np.array([[0.0, -v[2], v[1]], [v[2], 0.0, -v[0]], [-v[1], v[0], 0.0]])


def so3_exp(phi: Array) -> Array:
    """(3,) rotation vector to (3, 3) rotation (Rodrigues)."""
    angle = float(np.linalg.norm(phi))
    k = hat(phi)
    if angle < _SMALL:
        return np.eye(3) + k + 0.5 * k @ k
    return np.eye(3) + np.sin(angle) / angle * k + (1 - np.cos(angle)) / angle**2 * k @ k


def so3_log(rotation: Array) -> Array:
    """(3, 3) rotation to its (3,) rotation vector, angle in 0..pi."""
    wxyz = quaternion_from_rotation(rotation)
    sine = float(np.linalg.norm(wxyz[1:]))
    if sine < _SMALL:
        return 2 * wxyz[1:] / wxyz[0]
    return 2 * np.arctan2(sine, wxyz[0]) / sine * wxyz[1:]


def _left_jacobian(phi: Array) -> Array:
    angle = float(np.linalg.norm(phi))
    k = hat(phi)
    if angle < 1e-5:
        return np.eye(3) + 0.5 * k + k @ k / 6
    return np.eye(3) + (1 - np.cos(angle)) / angle**2 * k + (angle - np.sin(angle)) / angle**3 * k @ k


def se3_exp(xi: Array) -> Array:
    """(6,) [translation, rotation] to (4, 4)."""
    out = np.eye(4)
    out[:3, :3] = so3_exp(xi[3:])
    out[:3, 3] = _left_jacobian(xi[3:]) @ xi[:3]
    return out


def se3_log(a_from_b: Array) -> Array:
    """(4, 4) to (6,) [translation, rotation]."""
    phi = so3_log(a_from_b[:3, :3])
    return np.concatenate([np.linalg.solve(_left_jacobian(phi), a_from_b[:3, 3]), phi])


def inverse(a_from_b: Array) -> Array:
    """(..., 4, 4) rigid inverse."""
    rotation = np.swapaxes(a_from_b[..., :3, :3], -1, -2)
    out = np.zeros_like(a_from_b, dtype=float)
    out[..., :3, :3] = rotation
    out[..., :3, 3] = -(rotation @ a_from_b[..., :3, 3:])[..., 0]
    out[..., 3, 3] = 1
    return out


def adjoint(a_from_b: Array) -> Array:
    """(6, 6) Ad with a_from_b exp(xi) = exp(Ad xi) a_from_b."""
    rotation = a_from_b[:3, :3]
    out = np.zeros((6, 6))
    out[:3, :3] = out[3:, 3:] = rotation
    out[:3, 3:] = hat(a_from_b[:3, 3]) @ rotation
    return out


def transform(a_from_b: Array, points_b: Array) -> Array:
    """Apply (4, 4) to (..., 3) points."""
    return points_b @ a_from_b[:3, :3].T + a_from_b[:3, 3]


def interpolate(world_from_a: Array, world_from_b: Array, ratio: float) -> Array:
    """Pose between a (ratio 0) and b (ratio 1): straight line and constant angular velocity."""
    out = np.eye(4)
    out[:3, :3] = world_from_a[:3, :3] @ so3_exp(ratio * so3_log(world_from_a[:3, :3].T @ world_from_b[:3, :3]))
    out[:3, 3] = (1 - ratio) * world_from_a[:3, 3] + ratio * world_from_b[:3, 3]
    return out


def nearest_rotation(matrix: Array) -> Array:
    """Project (3, 3) on to the rotations (orthogonal Procrustes)."""
    u, _, vt = np.linalg.svd(matrix)
    return u @ np.diag([1, 1, np.sign(np.linalg.det(u @ vt))]) @ vt
