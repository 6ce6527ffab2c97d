"""Spherical harmonics: orthonormal, scipy's functions, and the DC term of the file format."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation
from scipy.special import sph_harm_y

from gaussian_scenes import HEIGHT, WIDTH, random_scene, weighted_loss
from mastd3r.errors import InputError
from mastd3r.mapping.rasterise import rasterization
from mastd3r.mapping.rasterise_reference import rasterise_reference
from mastd3r.mapping.sh import sh_basis, sh_colors, sh_degree, sh_turned, view_colors


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


def harmonics(count: int, degree: int, seed: int = 0) -> torch.Tensor:
    generator = torch.Generator().manual_seed(seed)
    return 0.2 * torch.randn(count, (degree + 1) ** 2 - 1, 3, generator=generator, dtype=torch.float64)


def test_colors_of_a_view_are_the_file_formats() -> None:
    """The same as f_dc and f_rest give, from the camera's centre; degree 0 leaves the colours untouched."""
    scene, _ = random_scene("plain", 1)
    centre = torch.linalg.inv(scene["viewmats"])[:3, 3]
    rest = harmonics(len(scene["means"]), 3)
    dc = (scene["colors"] - 0.5)[:, None] / 0.28209479177387814
    expected = sh_colors(torch.cat([dc, rest], 1), scene["means"], centre)
    assert torch.allclose(view_colors(scene["colors"], rest, scene["means"], scene["viewmats"]), expected)
    colors = scene["colors"] - 0.7
    assert view_colors(colors, rest[:, :0], scene["means"], scene["viewmats"]) is colors


@pytest.mark.parametrize("degree", [1, 2, 3])
def test_gradients_through_rasteriser_and_harmonics_match_the_reference(degree: int) -> None:
    """Coefficients, places and the view matrix, which also turns the direction of view."""
    scene, K = random_scene("plain", degree)
    names = ("means", "quats", "scales", "opacities", "colors", "viewmats")
    results = []
    for function, kind in ((rasterization, torch.float32), (rasterise_reference, torch.float64)):
        leaves = {name: scene[name].to(kind).requires_grad_() for name in names}
        rest = harmonics(len(scene["means"]), degree).to(kind).requires_grad_()
        seen = view_colors(leaves["colors"], rest, leaves["means"], leaves["viewmats"])
        parts = [seen if name == "colors" else leaves[name] for name in names]
        loss = weighted_loss(function(*parts, K, WIDTH, HEIGHT))
        results.append(torch.autograd.grad(loss, [rest, leaves["means"], leaves["viewmats"], leaves["colors"]]))
    for ours, exact in zip(*results, strict=True):
        assert exact.abs().max() > 0 and (ours - exact).norm() <= 1e-4 * exact.norm()


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
@pytest.mark.parametrize("seed", [0, 1])
def test_turned_harmonics_show_the_same_from_the_turned_side(degree: int, seed: int) -> None:
    rotation = Rotation.random(rng=np.random.default_rng(seed)).as_matrix()
    rest, directions = harmonics(6, degree, seed), sphere(40)
    turned = sh_turned(rest, rotation)
    moved = directions @ torch.from_numpy(rotation.T)
    before, after = (sh_basis(d, degree)[:, 1:] for d in (directions, moved))
    assert torch.allclose(torch.einsum("dk,nkc->ndc", after, turned), torch.einsum("dk,nkc->ndc", before, rest))


def test_degrees_are_told_from_the_shape() -> None:
    assert [sh_degree(torch.zeros(2, k, 3)) for k in (0, 3, 8, 15)] == [0, 1, 2, 3]
    for k in (1, 4, 24):
        with pytest.raises(InputError, match="upper coefficients"):
            sh_degree(torch.zeros(2, k, 3))
