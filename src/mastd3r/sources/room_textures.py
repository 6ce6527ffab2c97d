"""Procedural textures of the made room, and an atlas of them with mip levels.

A texture is an (h, w, 3) float32 image in grey levels 0..255. Every surface gets noise over several octaves
and some large shapes, so that corners are found at several scales.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

Array = NDArray[Any]
Rng = np.random.Generator
Texture = Callable[[float, float, Rng], Array]
TEXEL_M = 0.006  # size of a texel on the finest level
BORDER = 16  # texels repeated around a texture, so that filtering never sees its neighbour in the atlas


def noise(h: int, w: int, rng: Rng, coarsest: int = 128, octaves: int = 6, gain: float = 0.72) -> Array:
    """Sum of smooth random grids from ``coarsest`` texels a cell downwards, (h, w) float32, deviation 1."""
    total = np.zeros((h, w), np.float32)
    for k in range(octaves):
        cell = max(coarsest / 2**k, 2)
        grid = rng.standard_normal((int(h / cell) + 4, int(w / cell) + 4)).astype(np.float32)
        fine = cv2.resize(grid, None, fx=cell, fy=cell, interpolation=cv2.INTER_CUBIC)
        total += gain**k * fine[int(cell) : int(cell) + h, int(cell) : int(cell) + w]
    return total / total.std()


def plaster(colour: Sequence[float], strength: float = 13.0) -> Texture:
    """A painted wall: one colour, stained and grained."""

    def make(height_m: float, width_m: float, rng: Rng) -> Array:
        h, w = texels(height_m), texels(width_m)
        grain = noise(h, w, rng, 96, 6, 0.85) * strength
        tint = noise(h, w, rng, 256, 2)[..., None] * np.array([5.0, 1.0, -4.0])
        return _levels(np.asarray(colour, np.float32) + grain[..., None] + tint)

    return make


def planks(colour: Sequence[float], board_m: float = 0.14) -> Texture:
    """Wooden boards along the width, each of its own tone, with grain."""

    def make(height_m: float, width_m: float, rng: Rng) -> Array:
        h, w = texels(height_m), texels(width_m)
        row = np.arange(h) * height_m / h / board_m
        board = row.astype(int)
        shift = rng.uniform(0, 1.2, board.max() + 1)[board]
        column = ((np.arange(w) * width_m / w)[None] + shift[:, None]) / 1.2
        tone = rng.normal(0, 16, (board.max() + 1, int(column.max()) + 2))[board[:, None], column.astype(int)]
        grain = cv2.resize(noise(h, w // 6 + 1, rng, 32, 4), (w, h), interpolation=cv2.INTER_CUBIC) * 12
        dark = ((row % 1)[:, None] < 0.05) | (column % 1 < 0.008)
        wood = np.asarray(colour, np.float32) + (tone + grain + noise(h, w, rng, 24, 4, 0.9) * 7)[..., None]
        return _levels(wood * np.where(dark, 0.45, 1.0)[..., None])

    return make


def checker(first: Sequence[float], second: Sequence[float], cell_m: float) -> Texture:
    """Tiles of two colours with grain."""

    def make(height_m: float, width_m: float, rng: Rng) -> Array:
        h, w = texels(height_m), texels(width_m)
        y, x = np.mgrid[0:h, 0:w] * np.float32(height_m / h) / cell_m
        odd = ((y.astype(int) + x.astype(int)) % 2)[..., None]
        base = np.where(odd == 1, np.asarray(first, np.float32), np.asarray(second, np.float32))
        return _levels(base + noise(h, w, rng, 48, 5, 0.85)[..., None] * 11)

    return make


def shelf(rows: int) -> Texture:
    """Rows of book spines between boards."""

    def make(height_m: float, width_m: float, rng: Rng) -> Array:
        h, w = texels(height_m), texels(width_m)
        image = np.full((h, w, 3), (92, 64, 42), np.float32)
        step = h / rows
        for r in range(rows):
            top, bottom, x = int(r * step + 0.08 * step), int((r + 0.93) * step), int(0.02 * w)
            while x < 0.96 * w:
                wide = int(rng.uniform(0.02, 0.06) / TEXEL_M)
                high = int((bottom - top) * rng.uniform(0.6, 1.0))
                spine = image[bottom - high : bottom, x : min(x + wide, int(0.98 * w))]
                spine[:] = rng.uniform(30, 225, 3)
                for _ in range(rng.integers(1, 4)):
                    at = int(rng.uniform(0.05, 0.9) * high)
                    spine[at : at + max(high // 14, 2)] = rng.uniform(20, 240, 3)
                x += wide + int(rng.integers(0, 3))
        return _levels(image + noise(h, w, rng, 32, 5, 0.9)[..., None] * 8)

    return make


def drawers(colour: Sequence[float], rows: int, columns: int) -> Texture:
    """The front of a cupboard: panels with handles."""

    def make(height_m: float, width_m: float, rng: Rng) -> Array:
        h, w = texels(height_m), texels(width_m)
        image = planks(colour, 0.3)(height_m, width_m, rng)
        for r in range(rows):
            for c in range(columns):
                a = (int((c + 0.06) * w / columns), int((r + 0.08) * h / rows))
                b = (int((c + 0.94) * w / columns), int((r + 0.92) * h / rows))
                cv2.rectangle(image, a, b, (45.0, 34.0, 26.0), 3)
                middle = ((a[0] + b[0]) // 2, (a[1] + b[1]) // 2)
                cv2.ellipse(image, middle, (10, 5), 0, 0, 360, (215.0, 205.0, 180.0), -1)
        return image

    return make


def painting(height_m: float, width_m: float, rng: Rng) -> Array:
    """A framed picture: discs, boxes and lines over a coloured ground."""
    h, w = texels(height_m), texels(width_m)
    image = np.ascontiguousarray(rng.uniform(90, 200, 3).astype(np.float32) + noise(h, w, rng, 64, 4)[..., None] * 18)
    for _ in range(26):
        colour = tuple(float(v) for v in rng.uniform(10, 245, 3))
        at = (int(rng.uniform(0, w)), int(rng.uniform(0, h)))
        size = int(rng.uniform(0.03, 0.16) * min(h, w)) + 2
        kind = rng.integers(3)
        if kind == 0:
            cv2.circle(image, at, size, colour, -1, cv2.LINE_AA)
        elif kind == 1:
            cv2.rectangle(image, at, (at[0] + size, at[1] + int(size * 1.4)), colour, -1)
        else:
            to = (int(rng.uniform(0, w)), int(rng.uniform(0, h)))
            cv2.line(image, at, to, colour, max(size // 6, 2), cv2.LINE_AA)
    frame = max(int(0.035 / TEXEL_M), 3)
    cv2.rectangle(image, (0, 0), (w - 1, h - 1), (40.0, 28.0, 20.0), 2 * frame)
    return _levels(image)


def ball(height_m: float, width_m: float, rng: Rng) -> Array:
    """A patchwork ball: (height, width) cover latitude and longitude."""
    h, w = texels(height_m), texels(width_m)
    rows, columns = 6, 10
    tones = rng.uniform(25, 235, (rows, columns, 3)).astype(np.float32)
    image = cv2.resize(tones, (w, h), interpolation=cv2.INTER_NEAREST)
    for _ in range(60):
        at = (int(rng.uniform(0, w)), int(rng.uniform(0.1, 0.9) * h))
        colour = tuple(float(v) for v in rng.uniform(10, 245, 3))
        cv2.circle(image, at, int(rng.uniform(3, 12)), colour, -1, cv2.LINE_AA)
    return _levels(image + noise(h, w, rng, 24, 4, 0.9)[..., None] * 8)


def put_on(wall: Array, picture: Array, left_m: float, top_m: float) -> None:
    """Hang ``picture`` on a wall texture, in place."""
    x, y = round(left_m / TEXEL_M), round(top_m / TEXEL_M)
    h, w = picture.shape[:2]
    shade = cv2.GaussianBlur(
        np.pad(np.zeros((h, w), np.float32), 12, constant_values=1.0),
        (0, 0),
        4,
        borderType=cv2.BORDER_REPLICATE,
    )
    around = wall[y - 12 : y + h + 12, x - 12 : x + w + 12]
    around *= (0.45 + 0.55 * shade[: around.shape[0], : around.shape[1], None]).astype(np.float32)
    target = wall[y : y + h, x : x + w]
    target[:] = picture[: target.shape[0], : target.shape[1]]


def texels(length_m: float) -> int:
    """Texels along a length."""
    return max(round(length_m / TEXEL_M), 8)


def _levels(image: Array) -> Array:
    return np.clip(image, 5, 250).astype(np.float32)


@dataclass(frozen=True)
class Atlas:
    """All textures in one image a mip level; texture k starts at ``origin[k]`` (x, y) on the finest level."""

    levels: tuple[Array, ...]  # (H / 2**l, W / 2**l, 3) float32
    origin: Array  # (k, 2) float32 texels
    size: Array  # (k, 2) float32 texels (w, h)

    def sample(self, which: Array, uv: Array, footprint_texels: Array) -> Array:
        """Colour at ``uv`` (2, n) in 0..1 of texture ``which`` (n,): (n, 3) float32, trilinear."""
        at = (self.origin.T[:, which] + uv * self.size.T[:, which]).astype(np.float32)
        level = np.log2(np.clip(footprint_texels, 1, 2 ** (len(self.levels) - 1))).astype(np.float32)
        colour = np.zeros((len(which), 3), np.float32)
        for k in range(len(self.levels)):
            weight = 1 - np.abs(level - k)
            near = np.flatnonzero(weight > 0)
            if len(near):
                xy = at[:, near] / np.float32(2**k) - np.float32(0.5)
                colour[near] += weight[near, None] * _bilinear(self.levels[k], xy)
        return colour


def _bilinear(image: Array, xy: Array) -> Array:
    """Bilinear look-up at (2, n) pixels: (n, 3). cv2.remap wants its points in rows below 32767."""
    n, wide = xy.shape[1], 4096
    x, y = np.pad(xy, ((0, 0), (0, -n % wide))).reshape(2, -1, wide)
    looked = cv2.remap(image, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    out: Array = looked.reshape(-1, 3)[:n]
    return out


def make_atlas(textures: Sequence[Array], levels: int = 4) -> Atlas:
    """Pack textures below one another, each with a repeated border, and average down to ``levels`` levels."""
    step = 2 ** (levels - 1)
    origin, rows, y = [], [], 0
    wide = max(t.shape[1] for t in textures) + 2 * BORDER + step
    for t in textures:
        origin.append((BORDER, y + BORDER))
        below = BORDER + (-(t.shape[0] + 2 * BORDER) % step)
        right = wide - t.shape[1] - BORDER
        rows.append(cv2.copyMakeBorder(t, BORDER, below, BORDER, right, cv2.BORDER_REPLICATE))
        y += rows[-1].shape[0]
    image = np.concatenate(rows)
    image = image[:, : image.shape[1] // step * step]
    pyramid = [image]
    for _ in range(levels - 1):
        a = pyramid[-1]
        pyramid.append((a[0::2, 0::2] + a[1::2, 0::2] + a[0::2, 1::2] + a[1::2, 1::2]) / 4)
    size = [(t.shape[1], t.shape[0]) for t in textures]
    return Atlas(tuple(pyramid), np.array(origin, np.float32), np.array(size, np.float32))
