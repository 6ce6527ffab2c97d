"""Numba kernels of the truncated signed distance volume: depth maps in, a surface net out.

The volume is made of blocks of 8 x 8 x 8 voxels, where there is surface. A voxel's value is at its lower corner, in
truncation lengths, positive before the surface.
"""

from __future__ import annotations

from typing import Any

import numba as nb
import numpy as np
from numpy.typing import NDArray

from .projection import JIT, projected

Array = NDArray[Any]
SIDE = 8  # voxels along a block


@nb.njit(**JIT)
def integrate(
    first: int,
    last: int,
    blocks: Array,
    voxel: float,
    truncation: float,
    free: float,
    maps: Array,
    weights: Array,
    k: Array,
    cam_from_world: Array,
    value: Array,
    weight: Array,
) -> None:
    """Sums of all views into blocks first … last-1 (Curless and Levoy, SIGGRAPH 1996).

    blocks: (n, 3) int64, in blocks from the origin. maps: (V, h, w) inverse depth, 0 = none; weights: (V, h, w) uint8.
    ``free``: what a view counts, of its weight, that sees a voxel more than a truncation before its surface.
    k: (4,) fx fy cx cy. cam_from_world: (V, 3, 4). value and weight: (n, 8, 8, 8) float32, written.
    """
    views, h, w = maps.shape
    for b in range(first, last):
        for i in range(SIDE):
            for j in range(SIDE):
                for l in range(SIDE):
                    x = (blocks[b, 0] * SIDE + i) * voxel
                    y = (blocks[b, 1] * SIDE + j) * voxel
                    z = (blocks[b, 2] * SIDE + l) * voxel
                    total, by = 0.0, 0.0
                    for n in range(views):
                        u, v, depth = projected(cam_from_world[n], k, x, y, z)
                        if depth <= 0 or not (-0.5 < u < w - 0.5 and -0.5 < v < h - 0.5):
                            continue
                        row, column = int(v + 0.5), int(u + 0.5)
                        rho = maps[n, row, column]
                        if rho <= 0:
                            continue
                        distance = (1.0 / rho - depth) / truncation
                        if distance < -1:
                            continue
                        own = float(weights[n, row, column])
                        if distance > 1:
                            own *= free
                        total += own * min(distance, 1.0)
                        by += own
                    weight[b, i, j, l] = by
                    value[b, i, j, l] = total / by if by > 0 else 1.0


@nb.njit(inline="always", **JIT)
def _find(near: Array, b: int, i: int, j: int, l: int) -> tuple[int, int, int, int]:
    """Block and place in it of a voxel that may lie just outside block ``b``; block -1: there is none."""
    di, dj, dl = 1 + (i >> 3), 1 + (j >> 3), 1 + (l >> 3)
    return near[b, di, dj, dl], i & 7, j & 7, l & 7


@nb.njit(**JIT)
def net_vertices(near: Array, value: Array, weight: Array, least: float, number: Array, out: Array) -> int:
    """One vertex in every cell that the surface crosses: the mean of its edges' crossings (Gibson, MICCAI 1998).

    near: (n, 3, 3, 3) blocks around every block, -1 = none. Cells with a corner that weighs less than ``least`` have
    none. number: (n, 8, 8, 8) int32 of a cell's vertex, -1 = none, written. out: (m, 3) places in voxels from the
    block's corner, and its block in the last column, written as far as it reaches. Gives how many there are.
    """
    corners = np.empty((2, 2, 2))
    found = 0
    for b in range(len(value)):
        for i in range(SIDE):
            for j in range(SIDE):
                for l in range(SIDE):
                    number[b, i, j, l] = -1
                    below, whole = 0, True
                    for c in range(8):
                        ci, cj, cl = c >> 2, (c >> 1) & 1, c & 1
                        o, oi, oj, ol = _find(near, b, i + ci, j + cj, l + cl)
                        if o < 0 or weight[o, oi, oj, ol] < least:
                            whole = False
                            break
                        corners[ci, cj, cl] = value[o, oi, oj, ol]
                        below += value[o, oi, oj, ol] < 0
                    if not whole or below in (0, 8):
                        continue
                    at, edges = np.zeros(3), 0
                    for c in range(8):
                        ci, cj, cl = c >> 2, (c >> 1) & 1, c & 1
                        here = corners[ci, cj, cl]
                        for axis in range(3):
                            if (ci, cj, cl)[axis] == 1:
                                continue
                            there = corners[ci + (axis == 0), cj + (axis == 1), cl + (axis == 2)]
                            if (here < 0) == (there < 0):
                                continue
                            along = here / (here - there)
                            at[0] += ci + along * (axis == 0)
                            at[1] += cj + along * (axis == 1)
                            at[2] += cl + along * (axis == 2)
                            edges += 1
                    if found < len(out):
                        out[found, 0], out[found, 1] = i + at[0] / edges, j + at[1] / edges
                        out[found, 2], out[found, 3] = l + at[2] / edges, b
                    number[b, i, j, l] = found
                    found += 1
    return found


@nb.njit(**JIT)
def net_faces(near: Array, value: Array, weight: Array, least: float, number: Array, out: Array) -> int:
    """Two triangles for every voxel edge that the surface crosses, between the four cells around it.

    near, value, weight, least, number: as of ``net_vertices``. out: (m, 3) int32, written as far as it reaches;
    counter-clockwise as seen from before the surface. Gives how many there are.
    """
    found = 0
    quad = np.empty(4, np.int64)
    for b in range(len(value)):
        for i in range(SIDE):
            for j in range(SIDE):
                for l in range(SIDE):
                    if weight[b, i, j, l] < least:
                        continue
                    here = value[b, i, j, l]
                    for axis in range(3):
                        o, oi, oj, ol = _find(near, b, i + (axis == 0), j + (axis == 1), l + (axis == 2))
                        if o < 0 or weight[o, oi, oj, ol] < least or (here < 0) == (value[o, oi, oj, ol] < 0):
                            continue
                        whole = True
                        for n in range(4):  # the cells around the edge, in a ring
                            p, q = -(0 < n < 3), -(n >= 2)
                            if axis == 0:
                                o, oi, oj, ol = _find(near, b, i, j + p, l + q)
                            elif axis == 1:
                                o, oi, oj, ol = _find(near, b, i + q, j, l + p)
                            else:
                                o, oi, oj, ol = _find(near, b, i + p, j + q, l)
                            if o < 0 or number[o, oi, oj, ol] < 0:
                                whole = False
                                break
                            quad[n] = number[o, oi, oj, ol]
                        if not whole:
                            continue
                        if found + 1 < len(out):
                            flip = here >= 0
                            for t in range(2):
                                a, c = quad[1 + t], quad[2 + t]
                                out[found + t, 0] = quad[0]
                                out[found + t, 1], out[found + t, 2] = (c, a) if flip else (a, c)
                        found += 2
    return found


@nb.njit(**JIT)
def vertex_colors(
    points: Array, maps: Array, images: Array, k: Array, cam_from_world: Array, tolerance: float, out: Array
) -> None:
    """Mean colour (n, 3) uint8 of points (n, 3) in the images (V, h, w, 3) of views that see them unhidden."""
    views, h, w = maps.shape
    for p in range(len(points)):
        x, y, z = points[p]
        total, by = np.zeros(3), 0.0
        for n in range(views):
            u, v, depth = projected(cam_from_world[n], k, x, y, z)
            if depth <= 0 or not (-0.5 < u < w - 0.5 and -0.5 < v < h - 0.5):
                continue
            row, column = int(v + 0.5), int(u + 0.5)
            rho = maps[n, row, column]
            if rho <= 0 or abs(1.0 / rho - depth) > tolerance * depth:
                continue
            own = 1.0 / (depth * depth)  # who is near sees more of it
            for c in range(3):
                total[c] += own * images[n, row, column, c]
            by += own
        for c in range(3):
            out[p, c] = int(total[c] / by + 0.5) if by > 0 else 128
