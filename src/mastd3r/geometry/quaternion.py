"""Unit quaternions wxyz and rotation matrices."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

Array = NDArray[Any]


def quaternion_from_rotation(rotation: Array) -> Array:
    """(..., 3, 3) rotations to (..., 4) unit quaternions wxyz with w >= 0, at every angle.

    The columns of 4 q q^T (Shepperd 1978) are all q times something: the one with the largest pivot is made to length
    one, so that nothing is ever divided by nearly 0.
    """
    r = np.asarray(rotation, float)
    r00, r01, r02, r10, r11, r12, r20, r21, r22 = r.reshape(-1, 9).T
    trace = r00 + r11 + r22
    x, y, z, xy, xz, yz = r21 - r12, r02 - r20, r10 - r01, r01 + r10, r02 + r20, r12 + r21
    columns = [
        *(1 + trace, x, y, z),
        *(x, 1 + 2 * r00 - trace, xy, xz),
        *(y, xy, 1 + 2 * r11 - trace, yz),
        *(z, xz, yz, 1 + 2 * r22 - trace),
    ]
    largest = np.stack([trace, r00, r11, r22]).argmax(0)
    q = np.concatenate(columns).reshape(4, 4, -1)[largest, :, np.arange(len(trace))]
    q /= np.sqrt(q[:, None] @ q[:, :, None])[:, 0]
    return np.where(q[:, :1] < 0, -q, q).reshape(*r.shape[:-2], 4)


def rotation_from_quaternion(wxyz: Array) -> Array:
    """(..., 4) quaternions wxyz, of any length but 0, to (..., 3, 3) rotations."""
    w, x, y, z = np.moveaxis(wxyz / np.linalg.norm(wxyz, axis=-1, keepdims=True), -1, 0)
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    return np.stack([np.stack(row, -1) for row in rows], -2)
