"""CUDA backend of ``rasterise.rasterization``: a thin adapter to gsplat (Apache-2.0, extra ``[gpu]``).

gsplat has the CPU backend's rules (eps2d, the 1/255 cut, 0.999, 1e-4, the clamped Jacobian), computes in float32
throughout, and sums gradients by atomics: the same call twice differs in the last bits.
"""

from __future__ import annotations

import torch

from ..errors import MissingPackage
from .screen import ScreenStats


def rasterise_gsplat(
    means: torch.Tensor,
    quats: torch.Tensor,
    scales: torch.Tensor,
    opacities: torch.Tensor,
    colors: torch.Tensor,
    view: torch.Tensor,
    intrinsics: torch.Tensor,
    width: int,
    height: int,
    near: float,
    eps2d: float,
    stats: ScreenStats | None,
) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """See ``rasterise.rasterization``. Raises MissingPackage where gsplat is not installed."""
    try:
        import gsplat
    except ImportError as e:
        raise MissingPackage(
            f"CUDA rasteriser: expected the package gsplat, got {e}; pip install 'mastd3r-slam[gpu]'"
        ) from e
    shifted = intrinsics.detach().to(means.device, torch.float64, copy=True)
    shifted[:2, 2] += 0.5  # our integers are pixel centres, gsplat samples at +0.5
    image, alpha, info = gsplat.rasterization(
        *(t.float().contiguous() for t in (means, quats, scales, opacities, colors)),
        view.to(means.device).float()[None],
        shifted.float()[None],
        width,
        height,
        near_plane=near,
        far_plane=1e10,
        eps2d=eps2d,
        packed=False,
        render_mode="RGB+D",
    )
    if stats is not None:
        radii = info["radii"][0]
        stats.radii_px = radii if radii.ndim == 2 else radii[:, None].expand(-1, 2)
        if info["means2d"].requires_grad:
            info["means2d"].register_hook(lambda grad: setattr(stats, "mean_grad_px", grad[0]))
    return image[0, ..., :3], image[0, ..., 3], alpha[0, ..., 0]


class GsplatBackend:
    """gsplat, as the registry names it."""

    device = "cuda"
    rasterise = staticmethod(rasterise_gsplat)


def build() -> GsplatBackend:
    """The backend; gsplat itself is loaded when it draws."""
    return GsplatBackend()
