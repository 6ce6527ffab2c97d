"""Real spherical harmonics up to degree 3: colour that depends on the direction of view.

Order and signs are those of 3-D Gaussian files (f_dc, then f_rest by degree): Condon-Shortley phase included.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import torch

from ..errors import InputError

_C0 = 0.28209479177387814  # 1 / (2 sqrt(pi))
_C1 = 0.4886025119029199  # sqrt(3 / (4 pi))
_C2_XY = 1.0925484305920792  # sqrt(15 / (4 pi))
_C2_Z = 0.31539156525252005  # sqrt(5 / (16 pi))
_C2_XX = 0.5462742152960396  # sqrt(15 / (16 pi))
_C3_3 = 0.5900435899266435  # sqrt(35 / (32 pi))
_C3_2 = 2.890611442640554  # sqrt(105 / (4 pi))
_C3_1 = 0.4570457994644658  # sqrt(21 / (32 pi))
_C3_0 = 0.3731763325901154  # sqrt(7 / (16 pi))
_C3_22 = 1.445305721320277  # sqrt(105 / (16 pi))


def sh_basis(directions: torch.Tensor, degree: int) -> torch.Tensor:
    """(N, 3) directions of any length to (N, (degree+1)²). Raises InputError for a degree outside 0..3."""
    if degree not in range(4):
        raise InputError(f"spherical harmonics: expected a degree of 0 to 3, got {degree}")
    x, y, z = (directions / directions.norm(dim=-1, keepdim=True).clamp_min(1e-12)).unbind(-1)
    values = [torch.full_like(x, _C0)]
    if degree >= 1:
        values += [-_C1 * y, _C1 * z, -_C1 * x]
    if degree >= 2:
        values += [_C2_XY * x * y, -_C2_XY * y * z, _C2_Z * (3 * z * z - 1), -_C2_XY * x * z]
        values += [_C2_XX * (x * x - y * y)]
    if degree >= 3:
        values += [-_C3_3 * y * (3 * x * x - y * y), _C3_2 * x * y * z, -_C3_1 * y * (5 * z * z - 1)]
        values += [_C3_0 * z * (5 * z * z - 3), -_C3_1 * x * (5 * z * z - 1)]
        values += [_C3_22 * z * (x * x - y * y), -_C3_3 * x * (x * x - 3 * y * y)]
    return torch.stack(values, -1)


def sh_colors(coefficients: torch.Tensor, means: torch.Tensor, camera_centre: torch.Tensor) -> torch.Tensor:
    """RGB (N, 3) of Gaussians seen from ``camera_centre`` (3,): max(0, 0.5 + basis · coefficients).

    coefficients (N, K, 3) with K = 1, 4, 9 or 16; means (N, 3) world. The direction runs from the camera
    to the Gaussian. Differentiable in all three. Raises InputError for another K.
    """
    degrees = {1: 0, 4: 1, 9: 2, 16: 3}
    count = coefficients.shape[1]
    if count not in degrees:
        raise InputError(f"spherical harmonics: expected 1, 4, 9 or 16 coefficients, got {count}")
    basis = sh_basis(means - camera_centre, degrees[count])
    return (0.5 + torch.einsum("nk,nkc->nc", basis, coefficients)).clamp_min(0)


def view_colors(
    colors: torch.Tensor, sh_rest: torch.Tensor, means: torch.Tensor, cam_from_world: torch.Tensor
) -> torch.Tensor:
    """RGB (N, 3) of Gaussians as one camera sees them: ``colors`` plus the bands above the constant one.

    colors (N, 3) is the mean over all directions; sh_rest (N, K - 1, 3) with K as in ``sh_colors``. With K = 1 the
    colours come back as they are, else they are cut at 0. Differentiable in all four.
    """
    if sh_rest.shape[1] == 0:
        return colors
    centre = -(cam_from_world[:3, :3].T @ cam_from_world[:3, 3])
    basis = sh_basis(means - centre.to(means), sh_degree(sh_rest))[:, 1:]
    return (colors + torch.einsum("nk,nkc->nc", basis, sh_rest)).clamp_min(0)


def sh_degree(sh_rest: Any) -> int:
    """Degree of (N, K - 1, 3) coefficients. Raises InputError where K is not 1, 4, 9 or 16."""
    degree = math.isqrt(sh_rest.shape[1] + 1) - 1
    if (degree + 1) ** 2 != sh_rest.shape[1] + 1 or degree > 3:
        raise InputError(f"spherical harmonics: expected 0, 3, 8 or 15 upper coefficients, got {sh_rest.shape[1]}")
    return degree


def sh_turned(sh_rest: torch.Tensor, rotation: Any) -> torch.Tensor:
    """(N, K - 1, 3) coefficients after the Gaussians were turned by ``rotation`` (3, 3): c'(R d) = c(d) for all d.

    Solved over directions that determine every band; exact, because bands do not mix.
    """
    degree = sh_degree(sh_rest)
    if degree == 0:
        return sh_rest
    directions = np.random.default_rng(0).normal(size=(64, 3))
    before, after = (sh_basis(torch.from_numpy(d), degree)[:, 1:] for d in (directions, directions @ rotation.T))
    turn = torch.linalg.lstsq(after, before).solution
    return torch.einsum("jk,nkc->njc", turn.to(sh_rest), sh_rest)
