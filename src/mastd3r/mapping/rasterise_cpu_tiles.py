"""Sorting of Gaussians into 16 x 16 tiles, and the loops over tiles that blend them."""

# mypy: disallow-untyped-defs=False
from __future__ import annotations

import math

import numpy as np
from numba import njit

from .rasterise_cpu_blend import (
    CHANNELS,
    PLANE_BEHIND,
    PLANE_COLOR,
    PLANE_COLOR_GRAD,
    PLANE_LIVE,
    PLANE_TRANSMITTANCE,
    ROW_BACKWARD,
    ROW_FORWARD,
    SUMS,
    TILE,
    blend_backward,
    blend_forward,
)
from .rasterise_cpu_project import JIT

_LANES = 8
_LIVE_CHECK = 64  # Gaussians blended between two looks at whether a tile is opaque
_RADIX_BITS = 11
_F = np.float32


@njit(**JIT)
def depth_order(depth, radius):
    """Seen Gaussians, near to far; equal depths keep their order (radix sort of positive float32 bits)."""
    bits = depth.view(np.int32)
    order = np.flatnonzero(radius[:, 0] > 0).astype(np.int32)
    other = np.empty_like(order)
    buckets = 1 << _RADIX_BITS
    for part in range(3):
        shift = part * _RADIX_BITS
        first = np.zeros(buckets + 1, np.int32)
        for i in order:
            first[((bits[i] >> shift) & (buckets - 1)) + 1] += 1
        for k in range(buckets):
            first[k + 1] += first[k]
        for i in order:
            key = (bits[i] >> shift) & (buckets - 1)
            other[first[key]] = i
            first[key] += 1
        order, other = other, order
    return order


@njit(**JIT)
def bin_tiles(order, centre, radius, columns, rows):
    """Lists of Gaussians per tile, near to far, and the way back.

    Returns tile_start (tiles+1), pair_gaussian (M), gaussian_start (N+1), pair_place (M): the pairs of
    Gaussian i are pair_place[gaussian_start[i] : gaussian_start[i+1]].
    """
    count = radius.shape[0]
    tile_start = np.zeros(columns * rows + 1, np.int64)
    gaussian_start = np.zeros(count + 1, np.int64)
    box = np.zeros((count, 4), np.int32)
    for i in order:
        u, v, rx, ry = float(centre[i, 0]), float(centre[i, 1]), float(radius[i, 0]), float(radius[i, 1])
        box[i, 0] = max(0.0, math.floor((u - rx) / TILE))
        box[i, 1] = min(float(columns), math.ceil((u + rx) / TILE))
        box[i, 2] = max(0.0, math.floor((v - ry) / TILE))
        box[i, 3] = min(float(rows), math.ceil((v + ry) / TILE))
        gaussian_start[i + 1] = max(0, box[i, 1] - box[i, 0]) * max(0, box[i, 3] - box[i, 2])
        for ty in range(box[i, 2], box[i, 3]):
            for tx in range(box[i, 0], box[i, 1]):
                tile_start[ty * columns + tx + 1] += 1
    for t in range(columns * rows):
        tile_start[t + 1] += tile_start[t]
    for i in range(count):
        gaussian_start[i + 1] += gaussian_start[i]
    pair_gaussian = np.empty(tile_start[-1], np.int32)
    pair_place = np.empty(tile_start[-1], np.int32)
    fill = tile_start[:-1].copy()
    for i in order:
        q = gaussian_start[i]
        for ty in range(box[i, 2], box[i, 3]):
            for tx in range(box[i, 0], box[i, 1]):
                place = fill[ty * columns + tx]
                fill[ty * columns + tx] = place + 1
                pair_gaussian[place] = i
                pair_place[q] = place
                q += 1
    return tile_start, pair_gaussian, gaussian_start, pair_place


@njit(**JIT)
def _reach(i, centre, conic, opacities, x0, y0):
    """What blending needs of a Gaussian in a tile: conic, opacity, centre, largest power, rows, half rows."""
    a, b, c, opacity = conic[i, 0], conic[i, 1], conic[i, 2], opacities[i]
    x, y = _F(centre[i, 0] - _F(x0) - _F(0.5)), _F(centre[i, 1] - _F(y0) - _F(0.5))
    power_max = _F(math.log(opacity * _F(255.0)))
    spread = _F(2) * power_max / (a * c - b * b)
    reach_y, reach_x = _F(math.sqrt(spread * a)), _F(math.sqrt(spread * c))
    row0, row1 = int(max(_F(0), math.ceil(y - reach_y))), int(min(_F(TILE), math.floor(y + reach_y) + _F(1)))
    half0 = 1 if x - reach_x > _F(7) else 0
    half1 = 1 if x + reach_x < _F(8) else 2
    if x + reach_x < _F(0) or x - reach_x > _F(15):
        row1 = row0
    return a, b, c, opacity, x, y, power_max, row0, max(row0, row1), half0, half1


@njit(**JIT)
def tiles_forward(
    first,
    last,
    width,
    height,
    columns,
    tile_start,
    pair_gaussian,
    centre,
    conic,
    opacities,
    features,
    image,
    transmittance,
    stop,
):
    """Blend tiles first … last-1 into image (h,w,4) and transmittance (h,w).

    ``stop`` = end of the part of each tile's list that counted.
    """
    for t in range(first, last):
        y0, x0 = (t // columns) * TILE, (t % columns) * TILE
        rows, cols = min(TILE, height - y0), min(TILE, width - x0)
        tile = np.zeros(TILE * ROW_FORWARD, np.float32)
        for y in range(TILE):
            for x in range(TILE):
                tile[y * ROW_FORWARD + PLANE_TRANSMITTANCE * TILE + x] = _F(1)
                tile[y * ROW_FORWARD + PLANE_LIVE * TILE + x] = _F(1 if y < rows and x < cols else 0)
        k, end = tile_start[t], tile_start[t + 1]
        while k < end:
            until = min(end, k + _LIVE_CHECK)
            for pair in range(k, until):
                g = pair_gaussian[pair]
                a, b, c, opacity, x, y, power_max, row0, row1, half0, half1 = _reach(
                    g, centre, conic, opacities, x0, y0
                )
                blend_forward(tile, row0, row1, half0, half1, a, b, c, opacity, x, y, power_max, features, g)
            k = until
            live = _F(0)
            for y in range(TILE):
                for x in range(TILE):
                    live += tile[y * ROW_FORWARD + PLANE_LIVE * TILE + x]
            if live == _F(0):
                break
        stop[t] = k
        for y in range(rows):
            for x in range(cols):
                transmittance[y0 + y, x0 + x] = tile[y * ROW_FORWARD + PLANE_TRANSMITTANCE * TILE + x]
                for channel in range(CHANNELS):
                    value = tile[y * ROW_FORWARD + (PLANE_COLOR + channel) * TILE + x]
                    image[y0 + y, x0 + x, channel] = value


@njit(**JIT)
def _start_backward(tile, x0, y0, rows, cols, image, transmittance, image_grad, alpha_grad):
    for y in range(TILE):
        for x in range(TILE):
            tile[y * ROW_BACKWARD + PLANE_TRANSMITTANCE * TILE + x] = _F(1)
    for y in range(rows):
        for x in range(cols):
            tile[y * ROW_BACKWARD + PLANE_LIVE * TILE + x] = _F(1)
            behind = -transmittance[y0 + y, x0 + x] * alpha_grad[y0 + y, x0 + x]
            for channel in range(CHANNELS):
                grad = image_grad[y0 + y, x0 + x, channel]
                tile[y * ROW_BACKWARD + (PLANE_COLOR_GRAD + channel) * TILE + x] = grad
                behind += grad * image[y0 + y, x0 + x, channel]
            tile[y * ROW_BACKWARD + PLANE_BEHIND * TILE + x] = behind


@njit(**JIT)
def tiles_backward(
    first, last, width, height, columns, tile_start, pair_gaussian, centre, conic, opacities, features,
    image, transmittance, stop, image_grad, alpha_grad, pair_grads,
):  # fmt: skip
    """Tiles first … last-1: fill pair_grads (M, 10) of every pair before the tile's stop."""
    for t in range(first, last):
        y0, x0 = (t // columns) * TILE, (t % columns) * TILE
        tile = np.zeros(TILE * ROW_BACKWARD, np.float32)
        lanes = np.zeros(_LANES * SUMS, np.float32)
        sums = np.zeros(SUMS, np.float32)
        rows, cols = min(TILE, height - y0), min(TILE, width - x0)
        _start_backward(tile, x0, y0, rows, cols, image, transmittance, image_grad, alpha_grad)
        for pair in range(tile_start[t], stop[t]):
            g = pair_gaussian[pair]
            a, b, c, opacity, x, y, power_max, row0, row1, half0, half1 = _reach(g, centre, conic, opacities, x0, y0)
            blend_backward(tile, lanes, row0, row1, half0, half1, a, b, c, opacity, x, y, power_max, features, g)
            for i in range(SUMS):
                total = _F(0)
                for lane in range(_LANES):
                    total += lanes[i * _LANES + lane]
                sums[i] = total
            pair_grads[pair, 0] = a * sums[1] + b * sums[2]
            pair_grads[pair, 1] = b * sums[1] + c * sums[2]
            pair_grads[pair, 2] = -_F(0.5) * sums[3]
            pair_grads[pair, 3] = -sums[4]
            pair_grads[pair, 4] = -_F(0.5) * sums[5]
            pair_grads[pair, 5] = sums[0] / opacity
            for channel in range(CHANNELS):
                pair_grads[pair, 6 + channel] = sums[6 + channel]
