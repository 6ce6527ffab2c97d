"""The map's first Gaussians, one for each chosen point of the fused static cloud."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch

from ..errors import InputError
from ..types import StaticCloud
from .gaussians import GaussianMap

START_OPACITY = 0.5
SIGMA_OF_SPACING = 0.5  # standard deviation as a share of the patch that a point stands for


def seed_gaussians(cloud: StaticCloud, limit: int, seed: int, device: str = "cpu", sh_degree: int = 0) -> GaussianMap:
    """One Gaussian a point; where there are more than ``limit``, a fair draw.

    Fair: every keyframe keeps the same share of its points, and inside a keyframe a point's chance does
    not depend on its place. The survivors stand for more, so their spacing grows by the square root of
    the share. Points that are not finite, or have no positive spacing, are left out. Raises InputError
    where none is left. Colours start without a dependence on direction, whatever ``sh_degree`` is.
    """
    points = np.asarray(cloud.points_world, np.float32)
    spacing = np.asarray(cloud.spacing, np.float32)
    usable = np.flatnonzero(np.isfinite(points).all(1) & np.isfinite(spacing) & (spacing > 0))
    if len(usable) == 0:
        raise InputError(f"Gaussian map: expected static points to start from, got none of {len(points)} usable")
    rows = _fair_draw(usable, np.asarray(cloud.kf_id)[usable], limit, seed)
    growth = np.sqrt(len(usable) / len(rows))
    log_scales = np.log(spacing[rows] * SIGMA_OF_SPACING * growth)[:, None].repeat(3, 1)
    quats = np.zeros((len(rows), 4), np.float32)
    quats[:, 0] = 1
    logit = float(np.log(START_OPACITY / (1 - START_OPACITY)))
    tensors = {
        "means": points[rows],
        "log_scales": log_scales,
        "quats": quats,
        "opacity_logits": np.full(len(rows), logit),
        "colors": np.asarray(cloud.colors)[rows] / 255.0,
        "sh_rest": np.zeros((len(rows), (sh_degree + 1) ** 2 - 1, 3)),
    }
    leaves: dict[str, Any] = {
        name: torch.tensor(array, dtype=torch.float32, device=device).requires_grad_()
        for name, array in tensors.items()
    }
    return GaussianMap(**leaves, kf_id=torch.tensor(np.asarray(cloud.kf_id)[rows].astype(np.int32), device=device))


def _fair_draw(rows: np.ndarray, kf_id: np.ndarray, limit: int, seed: int) -> np.ndarray:
    if len(rows) <= limit:
        return rows
    shuffled = np.random.default_rng(seed).permutation(len(rows))
    by_keyframe = shuffled[np.argsort(kf_id[shuffled], kind="stable")]
    chosen = by_keyframe[np.floor(np.arange(limit) * (len(rows) / limit)).astype(int)]
    return np.sort(rows[chosen])
