"""Gaussians sorted by depth into groups of tiles; each tile then picks its own from its group's list."""

# mypy: disallow-untyped-defs=False
from __future__ import annotations

import numpy as np
from numba import njit

from .rasterise_cpu_project import JIT

_RADIX_BITS = 11


@njit(**JIT)
def depth_order(depth, radius):
    """Seen Gaussians, near to far; equal depths keep their order (radix sort of positive float32 bits)."""
    bits = depth.view(np.int32)
    buckets = 1 << _RADIX_BITS
    first = np.zeros((3, buckets + 1), np.int32)
    order = np.empty(len(depth), np.int32)
    count = 0
    for i in range(len(depth)):
        if radius[i, 0] > 0:
            order[count] = i
            count += 1
            for part in range(3):
                first[part, ((bits[i] >> (part * _RADIX_BITS)) & (buckets - 1)) + 1] += 1
    order = order[:count]
    other = np.empty_like(order)
    for part in range(3):
        shift = part * _RADIX_BITS
        for k in range(buckets):
            first[part, k + 1] += first[part, k]
        for i in order:
            key = (bits[i] >> shift) & (buckets - 1)
            other[first[part, key]] = i
            first[part, key] += 1
        order, other = other, order
    return order


@njit(**JIT)
def bin_groups(order, box, columns, lines):
    """Lists of Gaussians per group, near to far: start (groups+1,), gaussian (M,). ``box`` as projected."""
    start = np.zeros(columns * lines + 1, np.int64)
    for i in range(len(box)):
        for y in range(box[i, 2], box[i, 3]):
            for x in range(box[i, 0], box[i, 1]):
                start[y * columns + x + 1] += 1
    for group in range(columns * lines):
        start[group + 1] += start[group]
    gaussian, fill = np.empty(start[-1], np.int32), start[:-1].copy()
    for i in order:
        for y in range(box[i, 2], box[i, 3]):
            for x in range(box[i, 0], box[i, 1]):
                group = y * columns + x
                gaussian[fill[group]] = i
                fill[group] += 1
    return start, gaussian
