"""What the map must explain: eq. (13) to (17), and the default L1 + D-SSIM under the same weights.

Sums over pixels are divided by the number of pixels, so that learning rates do not depend on the image size.
``static`` is 1 - P(moving); exactly 0 marks a pixel without data, which no loss sees.
"""

from __future__ import annotations

import torch

from ..config import MapLossKind
from .ssim import ssim_map

MOVING = 0.5  # P(moving) above this is "moving" in the hard variant, and not looked at by the default trainer


def squared_color_error(render: torch.Tensor, target: torch.Tensor) -> torch.Tensor:
    """||C_render - C_gt||², (h, w): the square of eq. (13)."""
    return (render - target).square().sum(-1)


def static_weight(static: torch.Tensor, dynamic_weight: float, hard: bool) -> torch.Tensor:
    """w of eq. (14), (h, w): 1 on static pixels, ``dynamic_weight`` on moving ones, 0 where there is no data.

    hard: two values, as printed. Otherwise linear in p = P(moving): w = 1 - (1 - dynamic_weight) p.
    """
    moving = 1 - static
    if hard:
        weight = torch.where(moving > MOVING, torch.full_like(static, dynamic_weight), torch.ones_like(static))
    else:
        weight = 1 - (1 - dynamic_weight) * moving
    return weight * (static > 0)


def mask_loss(error: torch.Tensor, weight: torch.Tensor) -> torch.Tensor:
    """Mean over pixels of weight times error: eq. (13)."""
    return (weight * error).mean()


def uncertainty_loss(error: torch.Tensor, u: torch.Tensor) -> torch.Tensor:
    """Sum over R of u times error, divided by the number of pixels: eq. (15)."""
    return (u * error).mean()


def pixel_weight(
    kind: MapLossKind,
    static: torch.Tensor,
    u: torch.Tensor | None,
    dynamic_weight: float,
    hard: bool,
    lambda_uncertainty: float,
    paper: bool,
) -> torch.Tensor:
    """The whole of eq. (17) as one weight a pixel, so that sum(weight * error) is the loss.

    paper: w + lambda u, as printed: uncertain pixels count MORE.
    Otherwise the reading that does what the text says ("suppressing the influence of dynamic and
    low-confidence points"): u is evidence. Alone (uncertainty) it takes a pixel's weight from 1 to lambda; beside the
    mask (full) it divides the odds of standing still by lambda^-u, so that it decides where the mask doubts and
    leaves alone what is surely static: flow is wrong at outlines and where the other views were covered.
    Also, pixels that rather move than not get weight 0 under mask and full: Adam's steps do not depend on the size of a
    gradient, so where the background was never seen 5 % of the weight builds the whole ghost.
    plain has w = 1, mask has no u, uncertainty has w = 1 and u, full has both. 0 where there is no data.
    """
    seen = (static > 0).to(static)
    if not paper and kind == "full" and u is not None:
        static = seen * discounted(static, u, lambda_uncertainty)
    weight = static_weight(static, dynamic_weight, hard) if kind in ("mask", "full") else seen
    if not paper and kind in ("mask", "full"):
        return weight * (1 - static <= MOVING)
    if u is None or kind in ("plain", "mask"):
        return weight
    if paper:
        return weight + lambda_uncertainty * u * seen
    return weight * (1 - (1 - lambda_uncertainty) * u)


def discounted(static: torch.Tensor, u: torch.Tensor, lambda_uncertainty: float) -> torch.Tensor:
    """P(static) after evidence u (0..1) against it: its odds times lambda^u."""
    against = static * lambda_uncertainty**u
    return against / (against + 1 - static).clamp_min(1e-12)


def photometric_loss(
    render: torch.Tensor, target: torch.Tensor, weight: torch.Tensor, ssim_share: float = 0.2
) -> torch.Tensor:
    """(1 - share) L1 + share D-SSIM, both under the pixel weight of eq. (17): the default trainer's loss.

    Where the weight is below 1 the SSIM window sees the render itself in place of the photograph, so
    that a moving thing's edge does not reach its static neighbours through the window.
    """
    l1 = ((render - target).abs().mean(-1) * weight).mean()
    if ssim_share == 0:
        return l1
    share = weight.clamp(0, 1)[..., None]
    seen = share * target + (1 - share) * render.detach()
    dissimilarity = (1 - ssim_map(render, seen)) * 0.5
    return (1 - ssim_share) * l1 + ssim_share * (dissimilarity * weight).mean()
