"""Depth maps to a coloured triangle mesh: a truncated signed distance volume, and the surface net in it."""

from __future__ import annotations

import logging
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from ..concurrency import in_blocks
from ..geometry.se3 import inverse
from .depth_maps import DepthMaps, pinhole
from .tsdf_kernels import SIDE, integrate, net_faces, net_vertices, vertex_colors
from .views import StereoView

Array = NDArray[Any]
log = logging.getLogger(__name__)
VOXELS_A_DEPTH = 150  # of the median depth
TRUNCATION_VOXELS = 3.0
FREE_WEIGHT = 0.1  # of a view that sees a voxel well before its surface, so that one that is wrong carves little
FAR_RATIO = 5.0  # depth beyond so many median depths is left out
MAX_BLOCKS = 80_000  # of 512 voxels; where more would be needed, voxels are made twice as wide
AGREEING = 2  # other views that must agree; one less than for the cloud, as the volume takes means
LEAST_WEIGHT = 1.0  # agreeing views, summed over the views that see a voxel
SMALLEST_FACES = 60  # pieces of fewer triangles are left out
COLOR_TOLERANCE = 0.03  # relative depth up to which a view sees a vertex


@dataclass(frozen=True)
class Mesh:
    """Triangles of the static world."""

    vertices_world: Array  # (n, 3) float32
    faces: Array  # (m, 3) int32, counter-clockwise as the cameras saw them
    colors: Array  # (n, 3) uint8 RGB
    voxel: float  # in map units


def meshed(views: list[StereoView], maps: DepthMaps) -> Mesh:
    """The mesh of what views see alike in the depth maps; without vertices where nothing is."""
    median = maps.median_depth
    near_enough = maps.merged * (FAR_RATIO * median) > 1
    inv_depth = np.where((maps.agreeing >= AGREEING) & near_enough, maps.merged, 0).astype(np.float32)
    cam_from_world = np.stack([inverse(pose)[:3] for pose in maps.world_from_cam])
    voxel = median / VOXELS_A_DEPTH
    if not (inv_depth > 0).any():
        return Mesh(np.zeros((0, 3), np.float32), np.zeros((0, 3), np.int32), np.zeros((0, 3), np.uint8), voxel)
    while len(blocks := _blocks(inv_depth, maps, voxel)) > MAX_BLOCKS:
        voxel *= 2
        log.info("mesh: %d blocks are too many, voxels of %.3g map units instead", len(blocks), voxel)
    shape = (len(blocks), SIDE, SIDE, SIDE)
    value, weight = np.empty(shape, np.float32), np.empty(shape, np.float32)
    k = pinhole(maps.camera)
    in_blocks(
        integrate, len(blocks), blocks, voxel, TRUNCATION_VOXELS * voxel, FREE_WEIGHT, inv_depth, maps.agreeing, k,
        cam_from_world, value, weight,
    )  # fmt: skip
    vertices, faces = _without_crumbs(*surface_net(blocks, value, weight, LEAST_WEIGHT))
    points = (vertices * voxel).astype(np.float32)
    colors = np.empty((len(points), 3), np.uint8)
    images = np.stack([view.color for view in views])
    vertex_colors(points, inv_depth, images, k, cam_from_world, COLOR_TOLERANCE, colors)
    return Mesh(points, faces, colors, voxel)


def surface_net(blocks: Array, value: Array, weight: Array, least: float) -> tuple[Array, Array]:
    """(n, 3) vertices in voxels and (m, 3) int32 faces of where ``value`` (b, 8, 8, 8) changes its sign."""
    near = _around(blocks)
    number = np.empty(value.shape, np.int32)
    count = net_vertices(near, value, weight, least, number, np.zeros((0, 4)))
    placed = np.zeros((count, 4))
    net_vertices(near, value, weight, least, number, placed)
    faces = np.zeros((net_faces(near, value, weight, least, number, np.zeros((0, 3), np.int32)), 3), np.int32)
    net_faces(near, value, weight, least, number, faces)
    return placed[:, :3] + SIDE * blocks[placed[:, 3].astype(int)], faces


def _blocks(inv_depth: Array, maps: DepthMaps, voxel: float) -> Array:
    """(n, 3) int64 ascending blocks within a truncation of any point."""
    rays = maps.camera.rays(maps.camera.pixel_grid())
    reach = TRUNCATION_VOXELS * voxel
    found = []
    for pose, rho in zip(maps.world_from_cam, inv_depth, strict=True):
        known = np.zeros(rho.shape, bool)
        known[::2, ::2] = rho[::2, ::2] > 0
        ray, depth = rays[known], 1 / rho[known]
        for shift in (-reach, 0.0, reach):
            points = (ray * (depth + shift)[:, None]) @ pose[:3, :3].T + pose[:3, 3]
            found.append(np.unique(_keys(np.floor(points / (SIDE * voxel)).astype(np.int64))))
    keys = np.unique(np.concatenate(found))
    grown = [keys + _keys(np.array([[i, j, l]])) - _keys(np.zeros((1, 3), np.int64)) for i, j, l in _NEIGHBOURS]
    return _from_keys(np.unique(np.concatenate(grown)))


_HALF = 1 << 20  # blocks along an axis, each way
_NEIGHBOURS = [(i, j, l) for i in (-1, 0, 1) for j in (-1, 0, 1) for l in (-1, 0, 1)]


def _keys(blocks: Array) -> Array:
    """One int64 for every block (n, 3)."""
    return np.asarray(((blocks[:, 0] + _HALF) * 2 * _HALF + blocks[:, 1] + _HALF) * 2 * _HALF + blocks[:, 2] + _HALF)


def _from_keys(keys: Array) -> Array:
    span = 2 * _HALF
    return np.asarray(np.stack([keys // span**2, keys // span % span, keys % span], 1) - _HALF)


def _around(blocks: Array) -> Array:
    """(n, 3, 3, 3) int32 numbers of the blocks around every block; -1 where there is none."""
    keys = _keys(blocks)
    order = np.argsort(keys)
    out = np.full((len(blocks), 27), -1, np.int32)
    for n, step in enumerate(_NEIGHBOURS):
        wanted = _keys(blocks + np.array(step))
        at = np.minimum(np.searchsorted(keys, wanted, sorter=order), len(keys) - 1)
        hit = keys[order[at]] == wanted
        out[hit, n] = order[at[hit]]
    return out.reshape(-1, 3, 3, 3)


def _without_crumbs(vertices: Array, faces: Array) -> tuple[Array, Array]:
    """Without connected pieces of fewer than 60 triangles, and without vertices that no triangle has."""
    if not len(faces):
        return vertices[:0], faces
    ends = np.concatenate([faces[:, :2], faces[:, 1:]])
    graph = coo_array((np.ones(len(ends), np.uint8), (ends[:, 0], ends[:, 1])), shape=(len(vertices),) * 2)
    _, piece = connected_components(graph, directed=False)
    of_face = piece[faces[:, 0]]
    faces = faces[np.bincount(of_face)[of_face] >= SMALLEST_FACES]
    used, numbers = np.unique(faces, return_inverse=True)
    return vertices[used], numbers.reshape(-1, 3).astype(np.int32)
