"""A weak prior that a camera's speed goes on: it decides what the matches do not tell.

Behind somebody who fills the picture, or before a bare wall, a few keyframes may lie twice as far apart as they are,
and all that they see twice as far away, and no match says otherwise.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

Array = NDArray[Any]
GOES_ON_S = 1.0  # gaps between keyframes up to which the prior has its whole weight
STILL = 1e-9  # sum of two speeds, map units a second, below which nothing is said


@dataclass(frozen=True)
class SteadySpeed:
    """Keyframes in a row, three at a time: (b - a) / gap and (c - b) / gap are alike.

    The residual is r = (v2 - v1) / (|v1| + |v2|), of the velocities of the camera's centre. It does not depend on the
    unit of length, so that it pulls at no scale as a whole, and is never longer than 1.
    """

    ids: Array  # (n, 3) keyframes, or rows of their poses
    gaps_s: Array  # (n, 2) between them
    weight: Array  # (n,) px²

    @classmethod
    def of(cls, rows: Sequence[tuple[int, int, int]], times_s: Mapping[int, float], weight: float) -> SteadySpeed:
        """Three keyframes in a row each, by their times; the longer the gaps, the less a prior weighs."""
        ids = np.array(rows, int).reshape(-1, 3)
        gaps_s = np.diff(np.array([[times_s[k] for k in row] for row in rows], float).reshape(-1, 3), axis=1)
        known = (gaps_s > 0).all(axis=1) & (weight > 0)
        ids, gaps_s = ids[known], gaps_s[known]
        return cls(ids, gaps_s, weight / np.maximum(gaps_s.max(axis=1, initial=0) / GOES_ON_S, 1) ** 2)

    def by_rows(self, row_of: Mapping[int, int]) -> SteadySpeed:
        """The same of poses that stand in an array, by the row of each keyframe."""
        return replace(self, ids=np.array([[row_of[k] for k in some] for some in self.ids.tolist()], int))

    def cost(self, poses: Array) -> float:
        """Sum of w r² under cam_from_world (q, 4, 4)."""
        if not len(self.ids):
            return 0.0
        r, *_ = self._residuals(poses[self.ids])
        return float(self.weight @ (r**2).sum(axis=1))

    def system(self, poses: Array) -> tuple[Array, Array]:
        """(n, 18, 18) JᵀwJ and (n, 18) -Jᵀwr, by the left perturbations (rho, phi) of the three poses.

        A centre c = -Rᵀ t moves by -Rᵀ rho.
        """
        pose = poses[self.ids]
        r, velocity, speed, total = self._residuals(pose)
        away = r[:, None, :, None] * (velocity / np.maximum(speed, STILL)[..., None])[:, :, None, :]
        by_velocity = (np.array([-1.0, 1.0])[:, None, None] * np.eye(3) - away) / total[:, None, None, None]
        by_velocity /= self.gaps_s[:, :, None, None]
        by_centre = np.stack([-by_velocity[:, 0], by_velocity[:, 0] - by_velocity[:, 1], by_velocity[:, 1]], axis=1)
        jacobian = np.zeros((len(r), 3, 18))
        for n in range(3):
            jacobian[:, :, 6 * n : 6 * n + 3] = -by_centre[:, n] @ pose[:, n, :3, :3].transpose(0, 2, 1)
        weighted = self.weight[:, None, None] * jacobian.transpose(0, 2, 1)
        return weighted @ jacobian, -(weighted @ r[..., None])[..., 0]

    def _residuals(self, pose: Array) -> tuple[Array, Array, Array, Array]:
        """(n, 3) r, (n, 2, 3) velocities, (n, 2) speeds, (n,) their sum, from (n, 3, 4, 4) cam_from_world."""
        centre = -(pose[..., :3, :3].swapaxes(-1, -2) @ pose[..., :3, 3:])[..., 0]
        velocity = np.diff(centre, axis=1) / self.gaps_s[..., None]
        speed = np.linalg.norm(velocity, axis=-1)
        total = speed.sum(axis=1)
        total = np.where(total > STILL, total, np.inf)
        return (velocity[:, 1] - velocity[:, 0]) / total[:, None], velocity, speed, total
