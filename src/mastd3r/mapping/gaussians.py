"""The Gaussian map: torch parameters, each Gaussian anchored to the keyframe that saw it first."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from ..geometry.quaternion import quaternion_from_rotation
from ..geometry.sim3 import Sim3
from ..registry import AUTO
from .gaussian_arrays import GaussianArrays
from .rasterise import rasterization
from .screen import ScreenStats
from .sh import sh_turned, view_colors

Array = NDArray[Any]
PARAMETERS = ("means", "log_scales", "quats", "opacity_logits", "colors", "sh_rest")


@dataclass
class GaussianMap:
    """Parameters as the optimiser sees them; all rows belong together."""

    means: torch.Tensor  # (n, 3) world
    log_scales: torch.Tensor  # (n, 3) natural logarithm of the standard deviations
    quats: torch.Tensor  # (n, 4) wxyz, any length
    opacity_logits: torch.Tensor  # (n,)
    colors: torch.Tensor  # (n, 3) RGB, 0..1 but not clamped: the mean over all directions
    sh_rest: torch.Tensor  # (n, K - 1, 3), see sh.view_colors; K = 1: the colour does not depend on the direction
    kf_id: torch.Tensor  # (n,) int32
    backend: str = AUTO  # what draws it, by its name in the registry; auto: by the device of the tensors

    def __len__(self) -> int:
        return len(self.means)

    def parameters(self) -> dict[str, torch.Tensor]:
        """The tensors that are optimised, by name."""
        return {name: getattr(self, name) for name in PARAMETERS}

    @staticmethod
    def from_arrays(arrays: GaussianArrays, device: str = "cpu") -> GaussianMap:
        """The map that ``arrays()`` gave, as new leaves on ``device``."""
        logits = np.log(np.clip(arrays.opacities, 1e-6, 1 - 1e-6) / np.clip(1 - arrays.opacities, 1e-6, 1))
        plain = {
            "means": arrays.means,
            "log_scales": np.log(arrays.scales),
            "quats": arrays.quats,
            "opacity_logits": logits,
            "colors": arrays.colors,
            "sh_rest": arrays.sh_rest,
        }
        leaves: dict[str, Any] = {
            name: torch.tensor(array, dtype=torch.float32, device=device).requires_grad_()
            for name, array in plain.items()
        }
        return GaussianMap(**leaves, kf_id=torch.tensor(arrays.kf_id, dtype=torch.int32, device=device))

    def picked(self, rows: torch.Tensor) -> GaussianMap:
        """A copy of some rows, in the order given (repeats allowed), as new leaves."""
        rows_of = self.parameters().items()
        tensors: dict[str, Any] = {name: tensor.detach()[rows].requires_grad_() for name, tensor in rows_of}
        return replace(self, **tensors, kf_id=self.kf_id[rows])

    def joined(self, other: GaussianMap) -> GaussianMap:
        """These rows, then the other's, as new leaves."""
        pairs = zip(self.parameters().items(), other.parameters().values(), strict=True)
        tensors: dict[str, Any] = {name: torch.cat([a.detach(), b.detach()]).requires_grad_() for (name, a), b in pairs}
        return replace(self, **tensors, kf_id=torch.cat([self.kf_id, other.kf_id]))

    def draw(
        self,
        cam_from_world: torch.Tensor,
        intrinsics: torch.Tensor,
        width: int,
        height: int,
        near: float,
        background: torch.Tensor | None = None,
        stats: ScreenStats | None = None,
    ) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
        """Colour (h,w,3), alpha-weighted depth sum (h,w) and alpha (h,w) from one camera."""
        return rasterization(
            self.means,
            self.quats,
            self.log_scales.exp(),
            self.opacity_logits.sigmoid(),
            view_colors(self.colors, self.sh_rest, self.means, cam_from_world),
            cam_from_world,
            intrinsics,
            width,
            height,
            near=near,
            background=background,
            stats=stats,
            backend=self.backend,
        )

    def moved(self, changes: dict[int, Sim3]) -> GaussianMap:
        """The map after a graph correction: every Gaussian goes with its keyframe, new_world_from_old_world.

        What hangs on keyframes without a change does not move.
        """
        names = ("means", "quats", "log_scales", "sh_rest")
        means, quats, log_scales, sh_rest = (getattr(self, name).detach().clone() for name in names)
        for kf, change in sorted(changes.items()):
            rows = torch.nonzero(self.kf_id == kf)[:, 0]
            if len(rows) == 0:
                continue
            matrix = torch.from_numpy(change.matrix).to(means.device)
            means[rows] = (means[rows].double() @ matrix[:3, :3].T + matrix[:3, 3]).to(means)
            turn = torch.from_numpy(quaternion_from_rotation(change.rotation)).to(quats)
            quats[rows] = quaternion_product(turn, quats[rows])
            log_scales[rows] += float(np.log(change.scale))
            sh_rest[rows] = sh_turned(sh_rest[rows], change.rotation)
        tensors = zip(names, (means, quats, log_scales, sh_rest), strict=True)
        return replace(self, **{name: t.requires_grad_() for name, t in tensors})

    def exposed(self, gain: Array, bias: Array) -> GaussianMap:
        """The map with every colour times ``gain`` (3,) plus ``bias`` (3,), cut to 0..1."""
        g, b = (torch.from_numpy(np.asarray(v, np.float32)).to(self.colors) for v in (gain, bias))
        colors, sh_rest = (self.colors.detach() * g + b).clamp(0, 1), self.sh_rest.detach() * g
        return replace(self, colors=colors.requires_grad_(), sh_rest=sh_rest.requires_grad_())

    def arrays(self) -> GaussianArrays:
        """Plain numpy arrays for export."""
        with torch.no_grad():
            quats = self.quats / self.quats.norm(dim=1, keepdim=True)
            return GaussianArrays(
                means=_numpy(self.means),
                scales=_numpy(self.log_scales.exp()),
                quats=_numpy(quats),
                opacities=_numpy(self.opacity_logits.sigmoid()),
                colors=_numpy(self.colors.clamp(0, 1)),
                kf_id=self.kf_id.cpu().numpy(),
                sh_rest=_numpy(self.sh_rest),
            )


def _numpy(tensor: torch.Tensor) -> Array:
    return tensor.float().cpu().numpy().copy()


def quaternion_product(a: torch.Tensor, b: torch.Tensor) -> torch.Tensor:
    """Hamilton product, wxyz; shapes broadcast."""
    aw, ax, ay, az = a.unbind(-1)
    bw, bx, by, bz = b.unbind(-1)
    parts = [
        aw * bw - ax * bx - ay * by - az * bz,
        aw * bx + ax * bw + ay * bz - az * by,
        aw * by - ax * bz + ay * bw + az * bx,
        aw * bz + ax * by - ay * bx + az * bw,
    ]
    return torch.stack(parts, -1)
