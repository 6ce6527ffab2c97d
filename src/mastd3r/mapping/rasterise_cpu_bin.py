"""Gaussians sorted by depth into groups of tiles; each tile then picks its own from its group's list."""

# mypy: disallow-untyped-defs=False
from __future__ import annotations

from typing import Any

import numpy as np
from numba import njit

from ..concurrency import in_blocks
from .rasterise_cpu_matrices import JIT

_RADIX_BITS = 11
_PARTS = 8  # of the order, which are binned at the same time
_SMALL = 2**16  # Gaussians that one thread bins sooner than several can be told to


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
def _count(first, last, order, box, counts):
    """Parts first … last-1 of the order: counts (parts, lines, columns) of what they put into each group."""
    parts = len(counts)
    for part in range(first, last):
        counts[part] = 0
        for i in order[part * len(order) // parts : (part + 1) * len(order) // parts]:
            for y in range(box[i, 2], box[i, 3]):
                for x in range(box[i, 0], box[i, 1]):
                    counts[part, y, x] += 1


@njit(**JIT)
def _fill(first, last, order, box, place, gaussian):
    """Parts first … last-1 of the order; ``place`` (parts, lines, columns): where each part begins in each group."""
    parts = len(place)
    for part in range(first, last):
        for i in order[part * len(order) // parts : (part + 1) * len(order) // parts]:
            for y in range(box[i, 2], box[i, 3]):
                for x in range(box[i, 0], box[i, 1]):
                    gaussian[place[part, y, x]] = i
                    place[part, y, x] += 1


def bin_groups(order: Any, box: Any, columns: int, lines: int) -> tuple[Any, Any]:
    """Lists of Gaussians per group, near to far: start (groups+1,), gaussian (M,). ``box`` as projected."""
    counts = np.empty((_PARTS, lines, columns), np.int64)
    threads = 1 if len(order) < _SMALL else None
    in_blocks(_count, _PARTS, order, box, counts, threads=threads)
    by_group = counts.reshape(_PARTS, -1).T
    end = by_group.cumsum().reshape(by_group.shape)
    place = np.ascontiguousarray((end - by_group).T).reshape(counts.shape)
    gaussian = np.empty(end[-1, -1], np.int32)
    in_blocks(_fill, _PARTS, order, box, place, gaussian, threads=threads)
    return np.concatenate([np.zeros(1, np.int64), end[:, -1]]), gaussian
