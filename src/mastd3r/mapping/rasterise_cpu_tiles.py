"""The loops over 16 x 16 tiles that blend Gaussians, forward and backward."""

# mypy: disallow-untyped-defs=False
from __future__ import annotations

import numpy as np
from numba import njit

from .rasterise_cpu_blend import (
    BANDS,
    BLOCK_BACKWARD,
    BLOCK_FORWARD,
    BLOCKS,
    CHANNELS,
    GROUP,
    GROUP_PIXELS,
    PIXELS,
    PLANE_BEHIND,
    PLANE_COLOR,
    PLANE_COLOR_GRAD,
    PLANE_TRANSMITTANCE,
    ROW,
    ROW_REACH_X,
    ROW_REACH_Y,
    ROW_X,
    ROW_Y,
    TILE,
    blend_backward,
    blend_forward,
    block_open,
    ellipse_blocks,
)
from .rasterise_cpu_matrices import JIT
from .simd import LANES

# Gaussians blended between two looks at which blocks of a tile are opaque. Backward looks more often, because there a
# Gaussian costs more; so it meets no Gaussian that forward did not count.
CHUNK, CHUNK_BACKWARD = 32, 16
_F = np.float32


@njit(**JIT)
def _next_chunk(at, end, group_gaussian, rows, x0, y0, blocks, near, number, reached):
    """The next Gaussians of a group's list that reach ``blocks`` of the tile at x0, y0: how many, and where it goes on.

    Their rows go to ``near`` (n,16), centres relative to the tile, their numbers and blocks to the other two (n,).
    """
    count = 0
    while at < end and count < len(number):
        g = group_gaussian[at]
        at += 1
        x, y = _F(rows[g, ROW_X] - _F(x0) - _F(0.5)), _F(rows[g, ROW_Y] - _F(y0) - _F(0.5))
        reach_x, reach_y = rows[g, ROW_REACH_X], rows[g, ROW_REACH_Y]
        if x + reach_x < 0 or x - reach_x > TILE - 1 or y + reach_y < 0 or y - reach_y > TILE - 1:
            continue
        here = ellipse_blocks(rows, g, x, y) & blocks
        if here:
            for k in range(ROW):
                near[count, k] = rows[g, k]
            near[count, ROW_X], near[count, ROW_Y] = x, y
            number[count], reached[count] = g, here
            count += 1
    return count, at


@njit(**JIT)
def _blocks_inside(rows, columns):
    """Blocks that have a pixel among the first rows and columns of a tile."""
    blocks = 0
    for block in range(BLOCKS):
        if block // BANDS * LANES < columns and block % BANDS * 2 < rows:
            blocks |= 1 << block
    return blocks


@njit(**JIT)
def _place(block, pixel):
    """Row and column in the tile of a pixel of a block."""
    return block % BANDS * 2 + pixel // LANES, block // BANDS * LANES + pixel % LANES


@njit(**JIT)
def _start_forward(tile, rows, columns):
    for block in range(BLOCKS):
        start = block * BLOCK_FORWARD
        for k in range(BLOCK_FORWARD):
            tile[start + k] = 0
        for pixel in range(PIXELS):
            y, x = _place(block, pixel)
            tile[start + PLANE_TRANSMITTANCE * PIXELS + pixel] = 1 if y < rows and x < columns else -1


@njit(**JIT)
def _finish_forward(tile, rows, columns, x0, y0, color, depth, alpha):
    for block in range(BLOCKS):
        for pixel in range(PIXELS):
            y, x = _place(block, pixel)
            if y < rows and x < columns:
                at = block * BLOCK_FORWARD + pixel
                alpha[y0 + y, x0 + x] = _F(1) - abs(tile[at + PLANE_TRANSMITTANCE * PIXELS])
                for channel in range(CHANNELS - 1):
                    color[y0 + y, x0 + x, channel] = tile[at + (PLANE_COLOR + channel) * PIXELS]
                depth[y0 + y, x0 + x] = tile[at + (PLANE_COLOR + CHANNELS - 1) * PIXELS]


@njit(**JIT)
def tiles_forward(first, last, width, height, group_start, group_gaussian, rows, color, depth, alpha, used):
    """Draw groups first … last-1 of tiles: color (h,w,3), depth (h,w), alpha (h,w).

    ``used`` (groups, 4): how many Gaussians of the list came to each tile before it was opaque.
    """
    tile = np.empty(BLOCKS * BLOCK_FORWARD, np.float32)
    near, number, reached = np.empty((CHUNK, ROW), np.float32), np.empty(CHUNK, np.int32), np.empty(CHUNK, np.int64)
    listed, length = np.empty(BLOCKS * CHUNK, np.int32), np.empty(BLOCKS, np.int64)
    weights = np.empty((CHUNK, PIXELS), np.float32)
    across = (width + GROUP_PIXELS - 1) // GROUP_PIXELS
    for group in range(first, last):
        for t in range(GROUP * GROUP):
            x0, y0 = (group % across * GROUP + t % GROUP) * TILE, (group // across * GROUP + t // GROUP) * TILE
            used[group, t] = 0
            if x0 >= width or y0 >= height:
                continue
            inside = min(TILE, height - y0), min(TILE, width - x0)
            _start_forward(tile, *inside)
            blocks = _blocks_inside(*inside)
            at, end = group_start[group], group_start[group + 1]
            while blocks and at < end:
                count, at = _next_chunk(at, end, group_gaussian, rows, x0, y0, blocks, near, number, reached)
                used[group, t] += count
                length[:] = 0
                for k in range(count):
                    for block in range(BLOCKS):  # without a branch: guessing one wrong costs more than this loop
                        listed[block * CHUNK + length[block]] = k
                        length[block] += (reached[k] >> block) & 1
                for block in range(BLOCKS):
                    lines = near, listed, block * CHUNK, length[block], weights
                    if length[block] and not blend_forward(tile, block, *lines):
                        blocks &= ~(1 << block)
            _finish_forward(tile, *inside, x0, y0, color, depth, alpha)


@njit(**JIT)
def _start_backward(tile, rows, columns, x0, y0, color, depth, alpha, color_grad, depth_grad, alpha_grad):
    for block in range(BLOCKS):
        for pixel in range(PIXELS):
            y, x = _place(block, pixel)
            at = block * BLOCK_BACKWARD + pixel
            behind, last = _F(0), (PLANE_COLOR_GRAD + CHANNELS - 1) * PIXELS
            for channel in range(CHANNELS):
                tile[at + (PLANE_COLOR_GRAD + channel) * PIXELS] = 0
            inside = y < rows and x < columns
            if inside:
                v, u = y0 + y, x0 + x
                behind = (alpha[v, u] - _F(1)) * alpha_grad[v, u]
                for channel in range(CHANNELS - 1):
                    tile[at + (PLANE_COLOR_GRAD + channel) * PIXELS] = color_grad[v, u, channel]
                    behind += color_grad[v, u, channel] * color[v, u, channel]
                tile[at + last] = depth_grad[v, u]
                behind += depth_grad[v, u] * depth[v, u]
            tile[at + PLANE_TRANSMITTANCE * PIXELS] = 1 if inside else -1
            tile[at + PLANE_BEHIND * PIXELS] = behind


@njit(**JIT)
def tiles_backward(
    first, last, width, height, group_start, group_gaussian, rows, images, grads, pair_start, pair_gaussian, pair_sums
):  # fmt: skip
    """Groups first … last-1: what ``tiles_forward`` did again, and the gradient sums of every Gaussian in every tile.

    The pairs of tile t are rows pair_start[t] … of pair_gaussian (M,), -1 = none, and pair_sums (M,10). ``images`` =
    colour, depth and alpha as drawn, ``grads`` = the loss gradients of the three.
    """
    tile = np.empty(BLOCKS * BLOCK_BACKWARD, np.float32)
    near, number = np.empty((CHUNK_BACKWARD, ROW), np.float32), np.empty(CHUNK_BACKWARD, np.int32)
    reached = np.empty(CHUNK_BACKWARD, np.int64)
    across = (width + GROUP_PIXELS - 1) // GROUP_PIXELS
    for group in range(first, last):
        for t in range(GROUP * GROUP):
            pair, pair_end = pair_start[group * GROUP * GROUP + t], pair_start[group * GROUP * GROUP + t + 1]
            if pair == pair_end:
                continue
            x0, y0 = (group % across * GROUP + t % GROUP) * TILE, (group // across * GROUP + t // GROUP) * TILE
            inside = min(TILE, height - y0), min(TILE, width - x0)
            _start_backward(tile, *inside, x0, y0, *images, *grads)
            blocks = _blocks_inside(*inside)
            at, end = group_start[group], group_start[group + 1]
            while blocks and at < end and pair < pair_end:
                count, at = _next_chunk(at, end, group_gaussian, rows, x0, y0, blocks, near, number, reached)
                for k in range(min(count, pair_end - pair)):  # rounding could differ from the pass forward
                    pair_gaussian[pair] = number[k]
                    blend_backward(tile, near, k, reached[k], pair_sums, pair)
                    pair += 1
                for block in range(BLOCKS):
                    if (blocks >> block) & 1 and not block_open(tile, block):
                        blocks &= ~(1 << block)
            pair_gaussian[pair:pair_end] = -1
