"""Spherical harmonics: orthonormal, scipy's functions, and the DC term of the file format."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from scipy.special import sph_harm_y

from mastd3r.errors import InputError
from mastd3r.mapping.sh import sh_basis, sh_colors


def sphere(count: int = 4000) -> torch.Tensor:
    """Evenly spread directions (Fibonacci lattice)."""
    i = np.arange(count) + 0.5
    z, turn = 1 - 2 * i / count, np.pi * (1 + 5**0.5) * i
    radius = np.sqrt(1 - z * z)
    return torch.from_numpy(np.stack([radius * np.cos(turn), radius * np.sin(turn), z], 1))


def test_basis_is_orthonormal() -> None:
    basis = sh_basis(sphere(), 3)
    gram = basis.T @ basis * (4 * np.pi / len(basis))
    assert torch.allclose(gram, torch.eye(16, dtype=gram.dtype), atol=2e-3)


def test_basis_is_the_real_form_of_scipys() -> None:
    """Real harmonics: sqrt(2) Im Y_l|m| for m < 0, Y_l0, sqrt(2) Re Y_lm for m > 0, with (-1)^m inside Y."""
    directions = sphere(50)
    x, y, z = directions.numpy().T
    polar, azimuth = np.arccos(z), np.arctan2(y, x)
    basis, column = sh_basis(3.7 * directions, 3), 0
    for degree in range(4):
        for m in range(-degree, degree + 1):
            value = sph_harm_y(degree, abs(m), polar, azimuth)
            expected = value.real if m == 0 else np.sqrt(2) * (value.imag if m < 0 else value.real)
            assert np.allclose(basis[:, column], expected, atol=1e-12), (degree, m)
            column += 1


def test_degree_0_is_the_constant_of_the_file_format() -> None:
    rgb = torch.tensor([[0.1, 0.5, 0.9]], dtype=torch.float64)
    dc = ((rgb - 0.5) / 0.28209479177387814)[:, None]
    assert torch.allclose(sh_colors(dc, torch.tensor([[1.0, 2, 3]]).double(), torch.zeros(3).double()), rgb)


def test_gradients_and_refusals() -> None:
    generator = torch.Generator().manual_seed(0)
    leaves = [torch.randn(s, generator=generator, dtype=torch.float64) for s in ((5, 16, 3), (5, 3), (3,))]
    leaves[0] *= 0.05
    assert torch.autograd.gradcheck(sh_colors, tuple(t.requires_grad_() for t in leaves))
    with pytest.raises(InputError, match="coefficients"):
        sh_colors(torch.zeros(2, 5, 3), torch.ones(2, 3), torch.zeros(3))
    with pytest.raises(InputError, match="degree"):
        sh_basis(torch.ones(2, 3), 4)
