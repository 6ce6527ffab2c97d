"""CPU backend of ``rasterise.rasterization``: numba kernels under one torch autograd function."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch

from ..concurrency import in_blocks
from .rasterise_cpu_bin import bin_groups, depth_order
from .rasterise_cpu_blend import GROUP, GROUP_PIXELS, ROW, SUMS
from .rasterise_cpu_project import project_backward, project_forward, view_parameters
from .rasterise_cpu_tiles import tiles_backward, tiles_forward
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
    ) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
        inputs = tuple(np.ascontiguousarray(t.detach().numpy()) for t in (means, quats, scales, opacities))
        count, (width, height) = len(means), size
        columns, lines = -(-width // GROUP_PIXELS), -(-height // GROUP_PIXELS)
        view_array, lens = view_parameters(view.detach().numpy(), intrinsics, width, height)
        rows = np.empty((count, ROW), np.float32)
        depth, radius = np.empty(count, np.float32), np.empty((count, 2), np.int32)
        box, rgb = np.empty((count, 4), np.int16), np.ascontiguousarray(colors.detach().numpy())
        projected = rows, depth, radius, box
        in_blocks(project_forward, count, *inputs, rgb, view_array, lens, near, eps2d, *projected)
        groups = bin_groups(depth_order(depth, radius), box, columns, lines)
        images = tuple(np.empty((height, width, *channels), np.float32) for channels in ((3,), (), ()))
        used = np.empty((columns * lines, GROUP * GROUP), np.int64)
        in_blocks(tiles_forward, columns * lines, width, height, *groups, rows, *images, used)
        ctx.state, ctx.stats = (inputs, view_array, lens, groups, rows, images, used), stats
        if stats is not None:
            stats.radii_px = torch.from_numpy(radius)
        color, z, alpha = (torch.from_numpy(image) for image in images)
        return color, z, alpha

    @staticmethod
    def backward(ctx: Any, *upstream: torch.Tensor) -> tuple[Any, ...]:  # type: ignore[override]
        inputs, view, lens, groups, rows, images, used = ctx.state
        count, (height, width) = len(rows), images[1].shape
        grads = tuple(np.ascontiguousarray(g.numpy()) for g in upstream)
        pair_start = np.concatenate([np.zeros(1, np.int64), used.ravel().cumsum()])
        pairs = np.empty(pair_start[-1], np.int32), np.empty((pair_start[-1], SUMS), np.float32)
        in_blocks(tiles_backward, len(used), width, height, *groups, rows, images, grads, pair_start, *pairs)
        outputs = tuple(np.empty((count, *shape), np.float32) for shape in ((3,), (4,), (3,), (), (3,), (2,)))
        view_grad = np.zeros((_CHUNKS, 4, 4), np.float64)
        in_blocks(project_backward, _CHUNKS, inputs, view, lens, rows, *pairs, outputs, view_grad)
        *input_grads, pixel_grad = (torch.from_numpy(output) for output in outputs)
        if ctx.stats is not None:
            ctx.stats.mean_grad_px = pixel_grad
        return *input_grads, torch.from_numpy(view_grad.sum(0)), None, None, None, None, None


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
    drawn: tuple[torch.Tensor, torch.Tensor, torch.Tensor] = _Rasterise.apply(
        *arrays, shifted, (width, height), near, eps2d, stats
    )
    return drawn


class NumbaBackend:
    """Our rasteriser, as the registry names it."""

    device = "cpu"
    rasterise = staticmethod(rasterise_cpu)


def build() -> NumbaBackend:
    """The backend."""
    return NumbaBackend()
