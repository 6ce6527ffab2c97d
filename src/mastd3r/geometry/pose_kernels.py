"""Numba kernels of the joint optimisation: poses of edges, poses moved by a step, parts added to the system.

What ``se3`` does for one pose, for all of them in one call.
"""

from __future__ import annotations

import math
from typing import Any

import numba as nb
import numpy as np
from numpy.typing import NDArray

Array = NDArray[Any]
_JIT: dict[str, Any] = {"cache": True, "error_model": "numpy", "nogil": True}
SMALL_RAD = 1e-3  # angles below which series are exact to rounding


@nb.njit(**_JIT)
def edge_poses(poses: Array, ends: Array) -> Array:
    """(m, 4, 4) j_from_i, from cam_from_world (q, 4, 4); ``ends`` (m + 1,): which of them is i, and which are j."""
    out = np.zeros((len(ends) - 1, 4, 4))
    i_from_world = poses[ends[0]]
    for e in range(len(out)):
        pose, t = out[e], poses[ends[e + 1]]
        for r in range(3):
            pose[r, 3] = t[r, 3]
            for c in range(3):
                for k in range(3):
                    pose[r, c] += t[r, k] * i_from_world[c, k]
                pose[r, 3] -= pose[r, c] * i_from_world[c, 3]
        pose[3, 3] = 1.0
    return out


@nb.njit(**_JIT)
def to_anchor_pose(j_from_i: Array) -> Array:
    """(m, 6, 6) -Ad(j_from_i): derivatives by the pose of i are those by the pose of j times it."""
    out = np.zeros((len(j_from_i), 6, 6))
    for e in range(len(j_from_i)):
        t = j_from_i[e]
        for r in range(3):
            a, b = (r + 1) % 3, (r + 2) % 3
            for c in range(3):
                out[e, r, c] = out[e, 3 + r, 3 + c] = -t[r, c]
                out[e, r, 3 + c] = -(t[a, 3] * t[b, c] - t[b, 3] * t[a, c])
    return out


@nb.njit(**_JIT)
def moved_poses(poses: Array, block_of: Array, step: Array) -> Array:
    """exp(step) T of poses (q, 4, 4), by the ``step`` (s, 6) of blocks; ``block_of`` (q,), -1: stays."""
    out = poses.copy()
    for k in range(len(poses)):
        if block_of[k] < 0:
            continue
        t, moved = poses[k], out[k]
        rotation, shift = _exp(step[block_of[k]])
        for r in range(3):
            for c in range(4):
                moved[r, c] = shift[r] if c == 3 else 0.0
                for i in range(3):
                    moved[r, c] += rotation[r, i] * t[i, c]
    return out


@nb.njit(**_JIT)
def _exp(xi: Array) -> tuple[Array, Array]:
    """Rotation (3, 3) and translation (3,) of a twist (6,) [translation, rotation]: Rodrigues' formula."""
    x, y, z = xi[3], xi[4], xi[5]
    square = x * x + y * y + z * z
    angle = math.sqrt(square)
    if angle < SMALL_RAD:
        sine = 1.0 - square / 6.0 * (1.0 - square / 20.0)
        cosine = 0.5 - square / 24.0 * (1.0 - square / 30.0)
        third = 1.0 / 6.0 - square / 120.0
    else:
        sine, cosine = math.sin(angle) / angle, 2.0 * (math.sin(0.5 * angle) / angle) ** 2
        third = (1.0 - sine) / square
    hat = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    rotation, shift = np.eye(3), np.zeros(3)
    for r in range(3):
        shift[r] = xi[r]
        for c in range(3):
            twice = hat[r, 0] * hat[0, c] + hat[r, 1] * hat[1, c] + hat[r, 2] * hat[2, c]
            rotation[r, c] += sine * hat[r, c] + cosine * twice
            shift[r] += (cosine * hat[r, c] + third * twice) * xi[c]
    return rotation, shift


@nb.njit(**_JIT)
def add_part(hess: Array, rhs: Array, blocks: Array, part_h: Array, part_b: Array) -> None:
    """Add a part (6 k, 6 k) and (6 k,) of the system, of ``blocks`` (k,), to H and b; -1: it is left out."""
    for p in range(len(blocks)):
        if blocks[p] < 0:
            continue
        for r in range(6):
            at = 6 * blocks[p] + r
            rhs[at] += part_b[6 * p + r]
            for q in range(len(blocks)):
                if blocks[q] >= 0:
                    for c in range(6):
                        hess[at, 6 * blocks[q] + c] += part_h[6 * p + r, 6 * q + c]
