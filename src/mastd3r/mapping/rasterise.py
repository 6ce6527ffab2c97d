"""The one rasteriser signature; the backend is named, or follows from the device of ``means``."""

from __future__ import annotations

import subprocess

import torch

from ..config import MapDeviceKind
from ..errors import ConfigError, InputError, MissingPackage
from ..registry import AUTO, MAP_BACKENDS
from .screen import ScreenStats

OF_DEVICE = {"cpu": "numba", "cuda": "gsplat"}  # the backend that draws tensors of a device


def torch_device() -> str:
    """ "cuda" where torch has an accelerator, "cpu" otherwise: what the networks run on."""
    return "cuda" if torch.cuda.is_available() else "cpu"


def accelerator() -> tuple[str, float] | None:
    """Name of the accelerator and the most of its memory that tensors have held, in MiB; None without one."""
    if torch_device() == "cpu":
        return None
    return torch.cuda.get_device_name(), torch.cuda.max_memory_allocated() / 2**20


def map_device(asked: MapDeviceKind, backend: str = AUTO) -> tuple[str, str]:
    """Where the map lives, and why ``auto`` chose it; no reason where the user did. A named backend says where.

    The accelerator is believed once gsplat has drawn on it (it compiles its kernels then, which takes minutes,
    once a machine). Raises InputError where it was asked for by name and cannot be used.
    """
    if backend != AUTO:
        where: str = MAP_BACKENDS.create(backend).device
        if asked not in (AUTO, where):
            raise ConfigError(f"mapping.device: expected auto or {where}, which {backend} draws on, got {asked}")
        return where, ""
    if asked == "cpu":
        return asked, ""
    lack = _lack_of_accelerator()
    if asked == "cuda" and lack:
        raise InputError(f"mapping.device cuda: expected an accelerator that draws, got none: {lack}")
    if asked == "cuda":
        return asked, ""
    return ("cpu", lack) if lack else ("cuda", f"gsplat draws on {torch.cuda.get_device_name()}")


def _lack_of_accelerator() -> str:
    """What keeps the map from the accelerator, or nothing: one Gaussian is drawn to find out."""
    device = torch_device()
    if device == "cpu":
        return "torch finds no accelerator"
    one, eye = torch.ones(1, 4).to(device), torch.eye(4).to(device)
    gaussian = one[:, :3], one, one[:, :3], one[0, :1] / 2, one[:, :3]
    try:
        drawn = float(rasterization(*gaussian, eye, eye[:3, :3], 4, 4)[2].max())
    except (MissingPackage, ImportError, AttributeError, OSError, RuntimeError, subprocess.CalledProcessError) as e:
        return " ".join(str(e).split())[:200] or type(e).__name__
    return "" if 0.4 < drawn < 0.6 else f"gsplat drew {drawn:.3g} where 0.5 was expected"


def rasterization(
    means: torch.Tensor,
    quats: torch.Tensor,
    scales: torch.Tensor,
    opacities: torch.Tensor,
    colors: torch.Tensor,
    viewmats: torch.Tensor,
    Ks: torch.Tensor,
    width: int,
    height: int,
    near: float = 0.01,
    eps2d: float = 0.3,
    background: torch.Tensor | None = None,
    stats: ScreenStats | None = None,
    backend: str = AUTO,
) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """Draw 3-D Gaussians; differentiable in the Gaussians and the view matrix.

    means (N,3) world; quats (N,4) wxyz, any length; scales (N,3) standard deviations; opacities (N,) 0..1;
    colors (N,3); viewmats (4,4) cam_from_world; Ks (3,3) for pixels whose integers are their centres;
    near: Gaussians whose centre is nearer are not drawn; eps2d: px² added to the 2-D variances;
    background (3,) colour behind everything, None = black. ``stats`` receives what densification needs;
    ``backend``: a name of the registry.

    Returns color (H,W,3), depth (H,W) = sum of weight · z, NOT divided by alpha, alpha (H,W) = sum of weight.
    Raises InputError for wrong shapes or an unknown device, MissingPackage for CUDA without gsplat.
    """
    _check(means, quats, scales, opacities, colors, viewmats, Ks, width, height)
    arguments = (means, quats, scales, opacities, colors, viewmats, Ks, width, height, near, eps2d, stats)
    name = backend if backend != AUTO else OF_DEVICE.get(means.device.type)
    if name is None:
        raise InputError(f"rasterization: expected tensors on cpu or cuda, got {means.device}")
    color, depth, alpha = MAP_BACKENDS.create(name).rasterise(*arguments)
    if background is not None:
        color = color + (1 - alpha)[..., None] * background
    return color, depth, alpha


def _check(
    means: torch.Tensor,
    quats: torch.Tensor,
    scales: torch.Tensor,
    opacities: torch.Tensor,
    colors: torch.Tensor,
    viewmats: torch.Tensor,
    Ks: torch.Tensor,
    width: int,
    height: int,
) -> None:
    n = len(means)
    expected = {
        "means": (means, (n, 3)),
        "quats": (quats, (n, 4)),
        "scales": (scales, (n, 3)),
        "opacities": (opacities, (n,)),
        "colors": (colors, (n, 3)),
        "viewmats": (viewmats, (4, 4)),
        "Ks": (Ks, (3, 3)),
    }
    for name, (tensor, shape) in expected.items():
        if tuple(tensor.shape) != shape:
            raise InputError(f"rasterization {name}: expected shape {shape}, got {tuple(tensor.shape)}")
    if width < 1 or height < 1:
        raise InputError(f"rasterization size: expected at least 1 x 1, got {width} x {height}")
