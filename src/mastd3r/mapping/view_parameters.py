"""What the map learns of each training view: exposure (gain and bias a channel) and, on request, its pose."""

from __future__ import annotations

import numpy as np
import torch

from ..geometry.sim3 import Sim3
from ..types import View
from .adam import RowAdam
from .gaussians import Array

_EXPOSURE_RATE = 2e-3
_EXPOSURE_PRIOR = 0.3  # holds every exposure near neutral: what few views see could as well be darker, all of it
_POSE_RATE = 2e-3  # radians, and map units per unit of median depth
_POSE_RATE_LAST_RATIO = 0.1
_EXPOSURE = ("log_gain", "bias")
_NAMES = (*_EXPOSURE, "shift", "turn")


class ViewParameters:
    """Exposure and pose corrections of all training views, one row a view.

    A pose correction acts on the left of cam_from_world: shift in units of ``depth``, turn a rotation vector.
    They stay on the CPU wherever the map lives: a few numbers a view, not worth a kernel each.
    """

    def __init__(self, views: list[View], refine_poses: bool, depth: float, exposure: bool = True) -> None:
        self._timestamps_s = np.zeros(0)
        self._kf_id: list[int] = []
        self._world_from_cam: list[Array] = []
        self._cam_from_world: list[torch.Tensor] = []
        self._rows: list[dict[str, torch.Tensor]] = []
        self._adams: list[RowAdam] = []
        self.extend(views)
        self._refine_poses, self._depth, self._exposure = refine_poses, depth, exposure

    def extend(self, views: list[View]) -> None:
        """Rows for more views, at neutral exposure and where tracking put them."""
        poses = [np.asarray(v.world_from_cam, float) for v in views]
        rows = [{name: torch.zeros(3, requires_grad=True) for name in _NAMES} for _ in views]
        self._timestamps_s = np.concatenate([self._timestamps_s, [v.timestamp_s for v in views]])
        self._kf_id += [v.kf_id for v in views]
        self._world_from_cam += poses
        self._cam_from_world += [torch.from_numpy(np.linalg.inv(p)) for p in poses]
        self._rows += rows
        self._adams += [RowAdam(row) for row in rows]

    def cam_from_world(self, number: int) -> torch.Tensor:
        """(4, 4) float64 of one training view, with its correction."""
        start, row = self._cam_from_world[number], self._rows[number]
        return self._motion(row["shift"], row["turn"]) @ start if self._refine_poses else start

    def tracked_cam_from_world(self, number: int) -> Array:
        """(4, 4) of one training view, without its correction."""
        return self._cam_from_world[number].numpy()

    def correct(self, number: int, shift: Array, turn: Array) -> None:
        """Put a pose correction in place of what was learned."""
        for name, value in (("shift", shift), ("turn", turn)):
            self._rows[number][name].data.copy_(torch.from_numpy(np.asarray(value, np.float32)))

    def exposed(self, color: torch.Tensor, alpha: torch.Tensor, number: int, share: float = 1.0) -> torch.Tensor:
        """Colour (h, w, 3) over black as that view's exposure shows it: gain * colour + bias * alpha.

        ``share`` of it alone, 0..1: the rest is left to the colours of the map, which no file can tell apart by view.
        """
        if not self._exposure or share <= 0:
            return color
        row = self._rows[number]
        log_gain, bias = (share * row[name].to(color.device) for name in _EXPOSURE)
        return color * log_gain.exp() + alpha[..., None] * bias

    def centre_exposure(self, share: float = 1.0) -> tuple[Array, Array]:
        """Make the mean exposure of all views the neutral one: gain and bias (3,) that the map's colours must take.

        The views' exposures become what ``share`` of them was.
        """
        for row in self._rows:
            for name in _EXPOSURE:
                row[name].data.mul_(share)
        mean = {name: torch.stack([row[name].detach() for row in self._rows]).mean(0) for name in _EXPOSURE}
        gain = mean["log_gain"].exp()
        for row in self._rows:  # g c + b = (g / G) (G c + B) + b - (g / G) B
            ratio = (row["log_gain"].detach() - mean["log_gain"]).exp()
            row["bias"].data.sub_(ratio * mean["bias"])
            row["log_gain"].data.sub_(mean["log_gain"])
        return gain.numpy(), mean["bias"].numpy()

    def corrected_at(self, cam_from_world: torch.Tensor, timestamp_s: float) -> torch.Tensor:
        """A tracked pose under the correction interpolated linearly in time between training views."""
        if not self._refine_poses:
            return cam_from_world
        return self._motion(self._at("shift", timestamp_s), self._at("turn", timestamp_s)) @ cam_from_world

    def _at(self, name: str, timestamp_s: float) -> torch.Tensor:
        order = np.argsort(self._timestamps_s, kind="stable")
        rows = np.stack([self._rows[i][name].detach().cpu().numpy() for i in order])
        at = [np.interp(timestamp_s, self._timestamps_s[order], rows[:, k]) for k in range(3)]
        return torch.tensor(at, dtype=torch.float32)

    def prior(self, number: int) -> torch.Tensor:
        """A weak pull to neutral exposure."""
        row = self._rows[number]
        return _EXPOSURE_PRIOR * (row["log_gain"].square().mean() + row["bias"].square().mean())

    def step(self, number: int, done_ratio: float) -> None:
        """One Adam step of the view that was just drawn."""
        pose_rate = _POSE_RATE * _POSE_RATE_LAST_RATIO**done_ratio
        rates = {"log_gain": _EXPOSURE_RATE, "bias": _EXPOSURE_RATE, "shift": pose_rate, "turn": pose_rate}
        self._adams[number].step(self._rows[number], rates)

    def move_keyframes(self, changes: dict[int, Sim3]) -> None:
        """Views follow their keyframes, new_world_from_old_world; a scale moves their centres only."""
        for i, kf in enumerate(self._kf_id):
            if kf in changes:
                pose = (changes[kf] @ Sim3.from_rigid(self._world_from_cam[i])).rigid
                self._world_from_cam[i] = pose
                self._cam_from_world[i] = torch.from_numpy(np.linalg.inv(pose))

    def _motion(self, shift: torch.Tensor, turn: torch.Tensor) -> torch.Tensor:
        """(4, 4) float64: the exponential of SE(3)."""
        (x, y, z), move = turn.double(), shift.double() * self._depth
        zero = torch.zeros_like(x)
        rows = [
            torch.stack([zero, -z, y, move[0]]),
            torch.stack([z, zero, -x, move[1]]),
            torch.stack([-y, x, zero, move[2]]),
            torch.stack([zero, zero, zero, zero]),
        ]
        return torch.linalg.matrix_exp(torch.stack(rows))
