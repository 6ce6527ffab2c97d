"""CPU backend of ``rasterise.rasterization``: numba kernels under one torch autograd function."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch

from ..concurrency import in_blocks
from .rasterise_cpu_blend import CHANNELS, TILE
from .rasterise_cpu_project import GRADS, project_backward, project_forward, view_parameters
from .rasterise_cpu_tiles import bin_tiles, depth_order, tiles_backward, tiles_forward
from .screen import ScreenStats

_CHUNKS = 64  # fixed, so that sums do not depend on the number of threads


class _Rasterise(torch.autograd.Function):
    @staticmethod
    def forward(  # type: ignore[override]
        ctx: Any,
        means: torch.Tensor,
        quats: torch.Tensor,
        scales: torch.Tensor,
        opacities: torch.Tensor,
        colors: torch.Tensor,
        view: torch.Tensor,
        intrinsics: Any,
        size: tuple[int, int],
        near: float,
        eps2d: float,
        stats: ScreenStats | None,
    ) -> tuple[torch.Tensor, torch.Tensor]:
        inputs = [np.ascontiguousarray(t.detach().numpy()) for t in (means, quats, scales, opacities)]
        count, (width, height) = len(inputs[0]), size
        columns, rows = -(-width // TILE), -(-height // TILE)
        view_array, lens = view_parameters(view.detach().numpy(), intrinsics, width, height)
        centre, conic = np.zeros((count, 2), np.float32), np.zeros((count, 3), np.float32)
        depth, radius = np.empty(count, np.float32), np.empty((count, 2), np.int32)
        projected = centre, conic, depth, radius
        in_blocks(project_forward, count, *inputs, view_array, lens, near, eps2d, *projected)
        pairs = bin_tiles(depth_order(depth, radius), centre, radius, columns, rows)
        features = np.empty((count, CHANNELS), np.float32)
        features[:, :3], features[:, 3] = colors.detach().numpy(), depth
        image = np.empty((height, width, CHANNELS), np.float32)
        transmittance, stop = np.empty((height, width), np.float32), np.empty(columns * rows, np.int64)
        tile_input = (*pairs[:2], centre, conic, inputs[3], features)
        in_blocks(tiles_forward, rows * columns, width, height, columns, *tile_input, image, transmittance, stop)
        ctx.state = inputs, view_array, lens, radius, pairs, tile_input, image, transmittance, stop, columns
        ctx.stats = stats
        if stats is not None:
            stats.radii_px = torch.from_numpy(radius)
        return torch.from_numpy(image), torch.from_numpy(1 - transmittance)

    @staticmethod
    def backward(ctx: Any, image_grad: torch.Tensor, alpha_grad: torch.Tensor) -> tuple[Any, ...]:  # type: ignore[override]
        inputs, view, lens, radius, pairs, tile_input, image, transmittance, stop, columns = ctx.state
        means, quats, scales, _ = inputs
        count, (height, width) = len(means), transmittance.shape
        upstream = [np.ascontiguousarray(g.numpy()) for g in (image_grad, alpha_grad)]
        pair_grads = np.zeros((len(pairs[1]), GRADS), np.float32)
        blended = image, transmittance, stop, *upstream, pair_grads
        in_blocks(tiles_backward, len(stop), width, height, columns, *tile_input, *blended)
        grads, outputs = np.zeros((count, GRADS), np.float32), np.zeros((count, 10), np.float32)
        view_grad = np.zeros((_CHUNKS, 4, 4), np.float64)
        conic, start, place = tile_input[3], pairs[2], pairs[3]
        chain = conic, radius, start, place, pair_grads, grads, outputs, view_grad
        in_blocks(project_backward, _CHUNKS, means, quats, scales, view, lens, *chain)
        if ctx.stats is not None:
            ctx.stats.mean_grad_px = torch.from_numpy(grads[:, :2].copy())
        g, o = torch.from_numpy(grads), torch.from_numpy(outputs)
        view_sum = torch.from_numpy(view_grad.sum(0))
        return o[:, :3], o[:, 3:7], o[:, 7:], g[:, 5], g[:, 6:9], view_sum, None, None, None, None, None


def rasterise_cpu(
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
    """See ``rasterise.rasterization``; float32 blending, float64 projection, same for any thread count."""
    shifted = intrinsics.detach().double().numpy().copy()
    shifted[:2, 2] += 0.5  # our integers are pixel centres; the kernels sample at +0.5, as gsplat does
    arrays = (means.float(), quats.float(), scales.float(), opacities.float(), colors.float(), view.double())
    image, alpha = _Rasterise.apply(*arrays, shifted, (width, height), near, eps2d, stats)
    return image[..., :3], image[..., 3], alpha


class NumbaBackend:
    """Our rasteriser, as the registry names it."""

    device = "cpu"
    rasterise = staticmethod(rasterise_cpu)


def build() -> NumbaBackend:
    """The backend."""
    return NumbaBackend()
