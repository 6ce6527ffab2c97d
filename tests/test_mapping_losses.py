"""Eq. (13) to (17) on numbers done by hand, and SSIM against scikit-image."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from skimage.metrics import structural_similarity

from mastd3r.dynamics.uncertainty import uncertainty_weight
from mastd3r.mapping.losses import (
    discounted,
    mask_loss,
    photometric_loss,
    pixel_weight,
    squared_color_error,
    static_weight,
    uncertainty_loss,
)
from mastd3r.mapping.ssim import _ssim_torch, ssim_map

STATIC = torch.tensor([[1.0, 0.5, 0.25, 0.0]])


def test_13_squared_norm_of_the_colour_difference() -> None:
    render, target = torch.tensor([[[0.1, 0.2, 0.3]]]), torch.tensor([[[0.4, 0.2, 0.7]]])
    assert float(squared_color_error(render, target)) == pytest.approx(0.09 + 0.16)
    error, weight = torch.tensor([[1.0, 4.0]]), torch.tensor([[1.0, 0.05]])
    assert float(mask_loss(error, weight)) == pytest.approx((1 + 0.2) / 2)


def test_14_soft_and_hard_weight() -> None:
    soft = static_weight(STATIC, 0.05, hard=False)
    assert torch.allclose(soft, torch.tensor([[1.0, 1 - 0.95 * 0.5, 1 - 0.95 * 0.75, 0.0]]))
    hard = static_weight(STATIC, 0.05, hard=True)
    assert torch.allclose(hard, torch.tensor([[1.0, 1.0, 0.05, 0.0]]))


def test_16_uncertainty_is_the_squared_residual_over_its_maximum_beyond_tau() -> None:
    residual_px = np.array([1.9, 2.1, 4.2, 0.0])
    u = torch.from_numpy(uncertainty_weight(residual_px**2, tau_px=2.0)).float()
    assert torch.allclose(u, torch.tensor([0.0, 0.25, 1.0, 0.0]))
    assert np.all(uncertainty_weight(np.zeros(4), 2.0) == 0)
    assert float(uncertainty_loss(torch.tensor([[8.0, 4.0, 2.0, 1.0]]), u)) == pytest.approx((1 + 2) / 4)


@pytest.mark.parametrize("paper", [True, False])
@pytest.mark.parametrize("kind", ["plain", "mask", "uncertainty", "full"])
def test_17_total(kind: str, paper: bool) -> None:
    u = torch.tensor([[0.0, 0.4, 1.0, 1.0]])
    error = torch.tensor([[1.0, 2.0, 3.0, 4.0]])
    w = static_weight(STATIC, 0.05, hard=False) if kind in ("mask", "full") else torch.tensor([[1.0, 1, 1, 0]])
    total = pixel_weight(kind, STATIC, u, 0.05, False, 0.1, paper)  # type: ignore[arg-type]
    if kind in ("plain", "mask"):
        assert torch.equal(total, w if paper or kind == "plain" else w * (1 - STATIC <= 0.5))
    elif paper:  # as printed; the pixel without data stays out
        seen_u = u * torch.tensor([[1.0, 1, 1, 0]])
        expected = mask_loss(error, w) + 0.1 * uncertainty_loss(error, seen_u)
        assert float(mask_loss(error, total)) == pytest.approx(float(expected))
    elif kind == "uncertainty":  # from 1 where nothing is uncertain to lambda where all is
        assert torch.allclose(total, w * (1 - 0.9 * u))
    else:
        p = 1 - discounted(STATIC, u, 0.1)
        assert torch.allclose(total[0, :3], (1 - 0.95 * p[0, :3]) * (p[0, :3] <= 0.5))
        assert float(total[0, 0]) == 1
    assert float(total[0, 3]) == 0


def test_doubt_is_bayes_rule_and_leaves_the_sure_alone() -> None:
    """The odds of moving grow by 1 / lambda where u is 1; what is surely static, or surely moving, stays so."""
    static = torch.tensor([[0.999, 0.7, 0.3, 0.0, 1.0]])
    assert torch.allclose(discounted(static, torch.zeros(1, 5), 0.1), static)
    after = discounted(static, torch.ones(1, 5), 0.1)
    odds = (1 - after[0, :3]) / after[0, :3] / ((1 - static[0, :3]) / static[0, :3])
    assert torch.allclose(odds, torch.tensor(10.0), rtol=1e-3)
    assert float(after[0, 0]) > 0.98 and float(after[0, 3]) == 0 and float(after[0, 4]) == pytest.approx(1)


def test_what_rather_moves_counts_in_the_paper_preset_only() -> None:
    static = torch.tensor([[0.4, 0.6]])
    for kind in ("mask", "full"):
        ours, paper = (pixel_weight(kind, static, None, 0.05, False, 0.1, p) for p in (False, True))  # type: ignore[arg-type]
        assert torch.allclose(paper, torch.tensor([[1 - 0.95 * 0.6, 1 - 0.95 * 0.4]]))
        assert torch.allclose(ours, torch.tensor([[0.0, 1 - 0.95 * 0.4]]))


def test_ssim_is_that_of_scikit_image() -> None:
    rng = np.random.default_rng(0)
    a = rng.uniform(0, 1, (40, 50, 3)).astype(np.float32)
    b = np.clip(a + rng.normal(0, 0.1, a.shape), 0, 1).astype(np.float32)
    _, full = structural_similarity(
        a,
        b,
        channel_axis=2,
        data_range=1,
        gaussian_weights=True,
        sigma=1.5,
        use_sample_covariance=False,
        full=True,
    )
    ours = ssim_map(torch.from_numpy(a), torch.from_numpy(b)).numpy()
    inner = (slice(5, -5), slice(5, -5))  # at the border the two pad differently
    assert np.abs(ours[inner] - full.mean(2)[inner]).max() < 1e-4


def test_ssim_gradient_is_that_of_finite_differences() -> None:
    rng = np.random.default_rng(1)
    a, b = (torch.from_numpy(rng.uniform(0.2, 0.8, (14, 15, 3))) for _ in range(2))
    a.requires_grad_()
    assert torch.autograd.gradcheck(lambda x: ssim_map(x, b)[4:9, 5:8].sum(), (a,), fast_mode=True)


@pytest.mark.parametrize("size", [(40, 53), (7, 5), (1, 1)])
def test_the_kernels_of_ssim_are_the_plain_torch_twin(size: tuple[int, int]) -> None:
    """Values and gradients, float32 kernels against float64 torch, also for images smaller than the window."""
    generator = torch.Generator().manual_seed(4)
    image, noise = torch.rand(*size, 3, generator=generator), torch.rand(*size, 3, generator=generator)
    target, grad = 0.7 * image + 0.3 * noise, torch.rand(*size, generator=generator)
    ours, theirs = image.clone().requires_grad_(), image.double().requires_grad_()
    for leaf, function in ((ours, ssim_map), (theirs, _ssim_torch)):
        value = function(leaf, target.to(leaf))
        value.backward(grad.to(leaf))
        if leaf is ours:
            drawn = value.detach()
    assert ours.grad is not None and theirs.grad is not None
    assert (drawn - value.detach()).abs().max() < 1e-5
    assert (ours.grad - theirs.grad).abs().max() <= 1e-5 * theirs.grad.abs().max()


def test_a_moving_thing_does_not_reach_static_pixels_through_the_ssim_window() -> None:
    """With weight 0 on a block, the other pixels' gradient must not depend on the block's photograph."""
    rng = np.random.default_rng(2)
    render = torch.from_numpy(rng.uniform(0, 1, (24, 24, 3)).astype(np.float32))
    weight = torch.ones(24, 24)
    weight[8:16, 8:16] = 0
    grads = []
    for fill in (0.0, 1.0):
        target = torch.full((24, 24, 3), 0.5)
        target[8:16, 8:16] = fill
        leaf = render.clone().requires_grad_()
        photometric_loss(leaf, target, weight).backward()
        assert leaf.grad is not None
        grads.append(leaf.grad)
    assert torch.allclose(grads[0], grads[1], atol=1e-9)
    assert float(grads[0].abs().max()) > 0
