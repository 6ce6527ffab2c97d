"""A furnished corridor without an end, ray-cast, with exact poses: for runs of any length that never come back."""

from __future__ import annotations

from collections import OrderedDict
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from mastd3r.camera.pinhole import Camera
from mastd3r.sources import room_textures as tex

Array = NDArray[Any]
SEGMENT_M, HALF_WIDTH_M, HALF_HEIGHT_M = 4.0, 1.6, 1.3
AHEAD = 6  # segments that are drawn; what is farther is grey
KEPT = 12  # segments whose textures are kept
STEP_M = 0.05  # a frame
NOISE_GREY = 1.6  # standard deviation of the sensor
FAR_GREY = 96.0
LEFT, RIGHT, CEILING, FLOOR, BOXES = 0, 1, 2, 3, 4  # textures of a segment


@dataclass(frozen=True)
class _Segment:
    atlas: tex.Atlas
    boxes: tuple[tuple[Array, Array], ...]  # low and high corners, metres in the world


class EndlessCorridor:
    """The corridor of one seed: along +z, y down. No two of its segments are alike."""

    def __init__(self, width: int = 320, height: int = 240, seed: int = 0) -> None:
        self.camera, self.seed = Camera.centred(0.9375 * width, width, height), seed
        rays = self.camera.rays(self.camera.pixel_grid()).reshape(-1, 3).T
        self._rays = np.ascontiguousarray(rays, np.float32)
        self._number = np.arange(width * height).reshape(height, width)
        self._length = np.sqrt((self._rays**2).sum(0))
        self._segments: OrderedDict[int, _Segment] = OrderedDict()

    def pose(self, frame: int) -> Array:
        """world_from_cam (4, 4) of somebody who walks along it and looks left and right."""
        z = STEP_M * frame
        yaw, pitch = 0.7 * np.sin(2 * np.pi * z / 23), 0.08 * np.sin(2 * np.pi * z / 9)
        out = np.eye(4)
        out[:3, :3] = Rotation.from_euler("yx", [yaw, pitch]).as_matrix()
        out[:3, 3] = 0.35 * np.sin(2 * np.pi * z / 7), 0.03 * np.sin(2 * np.pi * z / 1.4), z
        return out

    def image(self, frame: int) -> Array:
        """(h, w, 3) uint8."""
        pose = self.pose(frame)
        rays = pose[:3, :3].astype(np.float32) @ self._rays
        rays = np.where(np.abs(rays) < 1e-6, np.float32(1e-6), rays)
        origin = pose[:3, 3].astype(np.float32)
        first = int(np.floor(origin[2] / SEGMENT_M)) - 1
        depth, where, uv, normal = _walls(rays, origin, first)
        for n in range(first, first + AHEAD + 2):
            for k, (low, high) in enumerate(self._segment(n).boxes):
                seen = self._rows(low, high, pose)
                _box(rays, origin, low, high, seen, (n - first) * 16 + BOXES + k, (depth, where, uv, normal))
        colour = np.full((len(depth), 3), FAR_GREY, np.float32)
        slant = np.abs(np.take_along_axis(rays, normal[None], 0)[0]) / self._length
        footprint = depth / np.float32(self.camera.fx_px * tex.TEXEL_M) / np.sqrt(np.maximum(slant, 0.05))
        for n in range(AHEAD + 2):
            rows = np.flatnonzero((where >= 0) & (where // 16 == n))
            if len(rows):
                atlas = self._segment(first + n).atlas
                colour[rows] = atlas.sample(where[rows] % 16, uv[:, rows], footprint[rows])
        colour *= np.choose(normal, (np.float32(0.9), np.float32(1.0), np.float32(0.8)))[:, None]
        colour += np.random.default_rng((self.seed, 1, frame)).normal(0, NOISE_GREY, colour.shape)
        return np.rint(colour.clip(0, 255)).astype(np.uint8).reshape(self.camera.height, self.camera.width, 3)

    def _rows(self, low: Array, high: Array, pose: Array) -> Array:
        """Pixels (m,), row by row, around a box; those of the whole image where it reaches beside the camera."""
        camera, number = self.camera, self._number
        corners = np.array([[x, y, z] for x in (low[0], high[0]) for y in (low[1], high[1]) for z in (low[2], high[2])])
        in_cam = (corners - pose[:3, 3]) @ pose[:3, :3]
        if (in_cam[:, 2] < 0.05).all():
            return number[:0, 0]
        if (in_cam[:, 2] < 0.05).any():
            return number.ravel()
        px = camera.project(in_cam)
        size = np.array([camera.width, camera.height])
        start, end = np.floor(px.min(0)).clip(0, size).astype(int), np.ceil(px.max(0) + 1).clip(0, size).astype(int)
        return number[start[1] : end[1], start[0] : end[0]].ravel()

    def _segment(self, n: int) -> _Segment:
        if n not in self._segments:
            self._segments[n] = _made(n, np.random.default_rng((self.seed, 0, n + 1000)))
            if len(self._segments) > KEPT:
                self._segments.popitem(last=False)
        return self._segments[n]


def _made(n: int, rng: tex.Rng) -> _Segment:
    """The textures and the furniture of a segment."""
    high, wide = 2 * HALF_HEIGHT_M, 2 * HALF_WIDTH_M

    def colour() -> Array:
        return rng.uniform(90, 200, 3)

    def wall() -> Array:
        made: Array = tex.plaster(colour())(high, SEGMENT_M, rng)
        for left_m in (0.3, 1.6, 2.9):
            if rng.random() < 0.7:
                size = rng.uniform(0.4, 0.8, 2)
                tex.put_on(made, tex.painting(size[0], size[1], rng), left_m, rng.uniform(0.3, 1.2))
        return made

    kinds = (lambda: tex.shelf(int(rng.integers(3, 6))), lambda: tex.drawers(colour(), 3, 2), lambda: tex.painting,
             lambda: tex.checker(colour(), colour(), rng.uniform(0.05, 0.1)))  # fmt: skip
    floor = tex.planks(colour(), rng.uniform(0.1, 0.2)) if rng.random() < 0.5 else tex.checker(colour(), colour(), 0.4)
    textures = [wall(), wall(), tex.checker(colour(), colour(), 0.6)(SEGMENT_M, wide, rng), floor(SEGMENT_M, wide, rng)]
    boxes = []
    for side in (-1, 1):
        for along in rng.uniform([0.2, 2.2], [1.2, 3.2]):
            size = rng.uniform([0.3, 0.5, 0.4], [0.6, 1.8, 0.8])
            low = np.array([side * HALF_WIDTH_M, HALF_HEIGHT_M - size[1], n * SEGMENT_M + along])
            low[0] -= size[0] if side > 0 else 0.0
            boxes.append((low.astype(np.float32), (low + size).astype(np.float32)))
            textures.append(kinds[rng.integers(len(kinds))]()(size[1], max(size[0], size[2]), rng))
    return _Segment(tex.make_atlas(textures), tuple(boxes))


def _walls(rays: Array, origin: Array, first: int) -> tuple[Array, Array, Array, Array]:
    """Depth (n,), 16 x segment from ``first`` + texture (n,) or -1, uv (2, n), and the axis of the normal (n,)."""
    half = np.array([HALF_WIDTH_M, HALF_HEIGHT_M], np.float32)[:, None]
    to_wall = (np.sign(rays[:2]) * half - origin[:2, None]) / rays[:2]
    depth = to_wall.min(0)
    normal = np.where(to_wall[0] <= to_wall[1], 0, 1)
    x, y, z = origin[:, None] + rays * depth
    along = z / np.float32(SEGMENT_M)
    segment = np.floor(along).astype(int)
    side = np.where(normal == 0, rays[0] > 0, 2 + (rays[1] > 0)).astype(int)
    where = np.where((segment >= first) & (segment < first + AHEAD + 2), (segment - first) * 16 + side, -1)
    v = np.where(normal == 0, y / (2 * half[1]) + 0.5, along - segment)
    u = np.where(normal == 0, along - segment, x / (2 * half[0]) + 0.5)
    return depth, where, np.stack([u, v]).astype(np.float32), normal


def _box(rays: Array, origin: Array, low: Array, high: Array, rows: Array, which: int, hit: tuple[Array, ...]) -> None:
    """What is seen of an upright box among some pixels (m,): depth, texture, uv and normal of a hit, in place."""
    depth, where, uv, normal = hit
    if not len(rows):
        return
    to_low, to_high = (low - origin)[:, None] / rays[:, rows], (high - origin)[:, None] / rays[:, rows]
    enters = np.minimum(to_low, to_high)
    near, far = enters.max(0), np.maximum(to_low, to_high).min(0)
    seen = np.flatnonzero((near > 0.02) & (near < far) & (near < depth[rows]))
    if not len(seen):
        return
    axis, near, rows = enters[:, seen].argmax(0), near[seen], rows[seen]
    size = high - low
    x, y, z = (origin[:, None] + rays[:, rows] * near - low[:, None]) / size[:, None]
    longest = max(size[0], size[2])
    depth[rows], where[rows], normal[rows] = near, which, axis
    uv[0, rows] = np.where(axis == 0, z * (size[2] / longest), x * (size[0] / longest))
    uv[1, rows] = np.where(axis == 1, z, y)
