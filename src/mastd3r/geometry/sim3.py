"""Similarity transforms: x_a = scale · R x_b + t."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

Array = NDArray[Any]


@dataclass(frozen=True)
class Sim3:
    """``a_from_b`` with a scale; ``@`` composes, ``apply`` maps points."""

    rotation: Array  # (3, 3)
    translation: Array  # (3,)
    scale: float = 1.0

    @staticmethod
    def identity() -> Sim3:
        """No motion, scale one."""
        return Sim3(np.eye(3), np.zeros(3), 1.0)

    @staticmethod
    def from_rigid(a_from_b: Array, scale: float = 1.0) -> Sim3:
        """From a (4, 4) rigid transform."""
        return Sim3(a_from_b[:3, :3], a_from_b[:3, 3], scale)

    def in_lengths(self, factor: float) -> Sim3:
        """The same with a's lengths times ``factor``."""
        return Sim3(self.rotation, factor * self.translation, factor * self.scale)

    @property
    def rigid(self) -> Array:
        """(4, 4) rotation and translation without the scale."""
        out = np.eye(4)
        out[:3, :3], out[:3, 3] = self.rotation, self.translation
        return out

    @property
    def matrix(self) -> Array:
        """(4, 4) of homogeneous points, the scale in its rotation block."""
        out = self.rigid
        out[:3, :3] *= self.scale
        return out

    def apply(self, points_b: Array) -> Array:
        """(..., 3) points of b to points of a."""
        return self.scale * points_b @ self.rotation.T + self.translation

    def inverse(self) -> Sim3:
        """b_from_a."""
        rotation = self.rotation.T
        return Sim3(rotation, -(rotation @ self.translation) / self.scale, 1 / self.scale)

    def __matmul__(self, other: Sim3) -> Sim3:
        return Sim3(
            self.rotation @ other.rotation,
            self.scale * self.rotation @ other.translation + self.translation,
            self.scale * other.scale,
        )


def procrustes(points_a: Array, points_b: Array, weight: Array, with_scale: bool = False) -> Sim3:
    """Weighted least-squares a_from_b of matched (n, 3) points in closed form (Umeyama).

    Raises ValueError for fewer than 3 points of positive weight.
    """
    if (weight > 0).sum() < 3:
        raise ValueError(f"procrustes: expected at least 3 weighted points, got {int((weight > 0).sum())}")
    w = weight / weight.sum()
    mean_a, mean_b = w @ points_a, w @ points_b
    a, b = points_a - mean_a, points_b - mean_b
    u, s, vt = np.linalg.svd((a * w[:, None]).T @ b)
    sign = np.array([1.0, 1.0, np.sign(np.linalg.det(u @ vt))])
    rotation = (u * sign) @ vt
    scale = float((s * sign).sum() / max((w[:, None] * b**2).sum(), 1e-300)) if with_scale else 1.0
    return Sim3(rotation, mean_a - scale * rotation @ mean_b, scale)
