"""Random Gaussians that a rasteriser must draw as the reference does; shared with benchmarks/bench_gpu_map.py."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch

WIDTH, HEIGHT = 53, 37  # not multiples of the tile
NAMES = ("means", "quats", "scales", "opacities", "colors", "viewmats")
KINDS = ("plain", "off-screen", "behind camera", "tiny", "huge", "transparent", "opaque")
Scene = dict[str, torch.Tensor]


def random_scene(kind: str, seed: int, count: int = 120) -> tuple[Scene, torch.Tensor]:
    """Gaussians in front of a slightly turned camera, as float64 tensors, and K."""
    rng = np.random.default_rng(seed)
    focal = 0.9 * WIDTH
    K = torch.tensor([[focal, 0, 25.3], [0, 1.1 * focal, 17.9], [0, 0, 1]], dtype=torch.float64)
    z = rng.uniform(1, 6, count)
    spread = {"off-screen": 2.5}.get(kind, 0.6)
    xy = rng.uniform(-spread, spread, (count, 2)) * z[:, None]
    sigma_px = {"tiny": (0.01, 0.3), "huge": (20, 150)}.get(kind, (1, 6))
    scales = rng.uniform(*sigma_px, (count, 3)) / focal * z[:, None]
    if kind == "behind camera":
        z[::2] *= -1
        z[1::7] = 0.005
    opacities = rng.uniform(0.1, 0.95, count)
    if kind == "transparent":
        opacities[::2] = rng.uniform(0.0, 0.01, len(opacities[::2]))
    if kind == "opaque":
        opacities[:] = rng.uniform(0.97, 1.0, count)
    view = np.eye(4)
    view[:3, :3] = [[np.cos(0.1), 0, np.sin(0.1)], [0, 1, 0], [-np.sin(0.1), 0, np.cos(0.1)]]
    view[:3, 3] = [0.02, -0.03, 0.001]
    scene = {
        "means": np.concatenate([xy, z[:, None]], 1),
        "quats": rng.normal(size=(count, 4)),
        "scales": scales,
        "opacities": opacities,
        "colors": rng.uniform(0, 1, (count, 3)),
        "viewmats": view,
    }
    # values that float32 holds exactly, so that both sides see the same scene
    return {k: torch.tensor(v, dtype=torch.float32).double() for k, v in scene.items()}, K


def weighted_loss(result: tuple[torch.Tensor, ...], seed: int = 5) -> torch.Tensor:
    """A fixed random linear function of colour, depth and alpha."""
    generator = torch.Generator().manual_seed(seed)
    return sum((r.double() * torch.rand(r.shape, generator=generator, dtype=torch.float64)).sum() for r in result)


def with_grads(function: Any, scene: Scene, K: torch.Tensor, **options: Any) -> tuple[Any, list[torch.Tensor]]:
    """What ``function`` draws, and the gradients of ``weighted_loss`` in the order of NAMES."""
    leaves = [scene[n].clone().requires_grad_() for n in NAMES]
    result = function(*leaves, K, WIDTH, HEIGHT, **options)
    return result, list(torch.autograd.grad(weighted_loss(result), leaves))
