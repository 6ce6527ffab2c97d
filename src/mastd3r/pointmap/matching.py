"""Matches of two views from a pair's own points and descriptors, no camera needed.

Of a pair decoded with the TARGET as its first view, every point stands in the target's camera. A source pixel is
found in the target in three steps: the target pixel whose ray points at the source's point, by damped least squares
on the bilinear image of rays; the most alike descriptor around it; and the test, at both, that it is one place in
space: what is hidden fails at the ray, what the descriptors lead astray fails after them. Numbers are those of
MASt3R-SLAM where it has them (Murai et al., CVPR 2025, and its configuration), but that the second test is ours, and
that the limit in space is a share of the distance, not 0.1 m.

``networks/matching.py`` says the same in torch; tests hold both to a plain search over all pixels.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, Protocol

import cv2
import numba as nb
import numpy as np
from numpy.typing import NDArray

Array = NDArray[Any]
_JIT: dict[str, Any] = {"cache": True, "error_model": "numpy", "nogil": True}
_FAST: dict[str, Any] = {**_JIT, "fastmath": {"contract", "reassoc", "nsz", "arcp"}}  # NaN must stay NaN
_SETTLED_PX = 1e-3  # a smaller step ends the search
_FLAT = 1e-6  # likeness that bends less over a pixel has no top
_MOST_ALIKE = 1.1  # unit vectors give 1, half-precision ones a little more; beyond: nonsense
_CHANNELS = 9  # ray, its change along x, its change along y


class ViewMaps(Protocol):
    """One view of a decoded pair, dense at the network's size. Both views' points are in the FIRST view's camera."""

    @property
    def points(self) -> Array: ...  # (h, w, 3) float32

    @property
    def descriptors(self) -> Array: ...  # (h, w, c) float32, unit length

    @property
    def descriptor_confidence(self) -> Array: ...  # (h, w) float32, 0 or more


@dataclass(frozen=True)
class MatchOptions:
    """Parameters of the search; defaults as in MASt3R-SLAM unless said otherwise."""

    iterations: int = 10  # of the search on rays
    damping: float = 1e-8  # first lambda; x 0.1 when a step is kept, x 10 when not
    converged: float = 1e-6  # squared length of the difference of two unit rays; above: not in view
    radius: int = 3  # descriptors compared: -3 … 3 steps both ways
    dilation_max: int = 5  # steps of 5, 4 … 1 px, each round about the best of the one before
    distance_ratio: float = 0.1  # two points may differ by this share of their distance
    min_descriptor_confidence: float = 1.5  # geometric mean of both ends
    reciprocal_px: float = 0.0  # > 0: matched back, a pixel must come this near to where it set out (ours)


@dataclass(frozen=True)
class FoundPixels:
    """Where n source pixels are in the target view."""

    px: Array  # (n, 2) float64, sub-pixel, of the target's network image
    valid: Array  # (n,) bool: in view, one place in space, sure enough, mutual where that was asked
    confidence: Array  # (n,) float64, geometric mean of both descriptor confidences; 0 where not finite
    similarity: Array  # (n,) float64, scalar product of the descriptors; -1 where none could be compared


def match_pixels(
    target: ViewMaps, source: ViewMaps, px: Array, start_px: Array | None = None, options: MatchOptions | None = None
) -> FoundPixels:
    """Find source pixels in the target view.

    Args: target, source: first and second view of one decoded pair (points in target's camera); px (n, 2) pixels of
    source, rounded to whole ones; start_px (n, 2) where to begin in target, default: the same pixels.
    Raises ValueError where px lies outside the source view.
    """
    options = options or MatchOptions()
    x, y = _whole(px, source.points.shape)
    start = np.asarray(px if start_px is None else start_px, float)
    points = source.points[y, x].astype(np.float64)
    near, cost = search_rays(ray_image(target.points), points, start, options)
    wanted = np.ascontiguousarray(source.descriptors[y, x], np.float32)
    found, similarity = search_descriptors(target.descriptors, wanted, near, options)
    tx, ty = _whole(found, target.points.shape)
    valid = (cost < options.converged) & (similarity > -1)
    for x_there, y_there in (_whole(near, target.points.shape), (tx, ty)):  # hidden; then: led astray
        valid &= same_place(target.points[y_there, x_there], points, options.distance_ratio)
    ends = np.stack([target.descriptor_confidence[ty, tx], source.descriptor_confidence[y, x]]).astype(float)
    confidence = np.sqrt(np.where(np.isfinite(ends) & (ends > 0), ends, 0.0)).prod(0)
    valid &= confidence > options.min_descriptor_confidence
    if options.reciprocal_px > 0:
        alike = np.ascontiguousarray(target.descriptors[ty, tx], np.float32)
        back, _ = search_descriptors(source.descriptors, alike, np.stack([x, y], 1).astype(float), options)
        valid &= np.hypot(back[:, 0] - x, back[:, 1] - y) <= options.reciprocal_px
    return FoundPixels(found, valid, confidence, similarity)


def subsampled(height: int, width: int, step_px: int) -> tuple[Array, tuple[int, int]]:
    """(n, 2) float64 pixels at the centres of step x step cells, row by row, and (rows, cols).

    The last cell of a row or column may be cut; its pixel stays inside.
    """
    y = np.minimum(np.arange(0, height, step_px) + step_px // 2, height - 1)
    x = np.minimum(np.arange(0, width, step_px) + step_px // 2, width - 1)
    grid = np.stack(np.meshgrid(x, y), -1).reshape(-1, 2).astype(float)
    return grid, (len(y), len(x))


def _whole(px: Array, shape: tuple[int, ...]) -> tuple[Array, Array]:
    whole = np.round(np.asarray(px)).astype(np.int64)
    if len(whole) and ((whole < 0).any() or (whole >= [shape[1], shape[0]]).any()):
        raise ValueError(
            f"match_pixels: expected pixels inside {shape[1]}x{shape[0]}, got {whole.min(0)}…{whole.max(0)}"
        )
    return whole[:, 0], whole[:, 1]


def same_place(a: Array, b: Array, ratio: float) -> Array:
    """(n,) True where two points (n, 3) differ by less than ``ratio`` of the nearer one's distance."""
    known = np.asarray(np.isfinite(a).all(1) & np.isfinite(b).all(1))
    a, b = np.where(known[:, None], a, 0).astype(float), np.where(known[:, None], b, 0).astype(float)
    nearer = np.minimum(np.linalg.norm(a, axis=1), np.linalg.norm(b, axis=1))
    return np.asarray(known & (np.linalg.norm(a - b, axis=1) < ratio * nearer))


def ray_image(points: Array) -> Array:
    """(h, w, 9) float32: unit rays of a pointmap in its own camera, and their change a pixel along x and y.

    The change is Scharr's (3 10 3)/32 filter, mirrored at the border. Pixels without a finite point have ray 0.
    """
    points = np.asarray(points, np.float32)
    length = np.sqrt(np.einsum("hwc,hwc->hw", points, points))
    known = np.isfinite(length) & (length > 0)
    rays = np.where(known[..., None], points, 0) / np.where(known, length, 1)[..., None]
    along_x = cv2.Scharr(rays, cv2.CV_32F, 1, 0, scale=1 / 32, borderType=cv2.BORDER_REFLECT_101)
    along_y = cv2.Scharr(rays, cv2.CV_32F, 0, 1, scale=1 / 32, borderType=cv2.BORDER_REFLECT_101)
    return np.concatenate([rays, along_x, along_y], -1)


def search_rays(image: Array, points: Array, start_px: Array, options: MatchOptions) -> tuple[Array, Array]:
    """(n, 2) pixels whose rays point at ``points`` (n, 3), and (n,) squared differences of the rays; inf = no point.

    ``image`` is that of ``ray_image``; the search stays one pixel off the border, as the gradients want it.
    """
    length = np.linalg.norm(points, axis=1)
    known = np.isfinite(length) & (length > 0)
    rays = np.where(known[:, None], points, [0.0, 0.0, 1.0]) / np.where(known, length, 1)[:, None]
    start = np.where(np.isfinite(start_px), start_px, 0.0)
    px, cost = _search_rays(image, rays, start, options.iterations, options.damping)
    return px, np.where(known, cost, np.inf)


@nb.njit(inline="always", **_FAST)
def _sample(image: Array, x: float, y: float, out: Array) -> None:
    """Bilinear value of all channels; 0 <= x < w - 1, 0 <= y < h - 1."""
    i, j = int(y), int(x)
    b, a = y - i, x - j
    w00, w01, w10, w11 = (1 - a) * (1 - b), a * (1 - b), (1 - a) * b, a * b
    for c in range(_CHANNELS):
        out[c] = (
            w00 * image[i, j, c] + w01 * image[i, j + 1, c] + w10 * image[i + 1, j, c] + w11 * image[i + 1, j + 1, c]
        )


@nb.njit(inline="always", **_FAST)
def _difference(s: Array, ray: Array, e: Array) -> tuple[float, float]:
    """Renormalises the sampled ray in place, e = it - ray; (|e|², length before), the former inf without a ray."""
    length = math.sqrt(s[0] * s[0] + s[1] * s[1] + s[2] * s[2])
    if not length > 0.5:
        return np.inf, 1.0
    for c in range(3):
        s[c] /= length
        e[c] = s[c] - ray[c]
    return e[0] * e[0] + e[1] * e[1] + e[2] * e[2], length


@nb.njit(inline="always", **_FAST)
def _step(s: Array, length: float, e: Array, damping: float) -> tuple[float, float]:
    """(J^T J + lambda I)^-1 J^T e, J = (I - r r^T) G / length for unit ray r = s[0:3] and gradient G = s[3:9]."""
    along_x = s[0] * s[3] + s[1] * s[4] + s[2] * s[5]
    along_y = s[0] * s[6] + s[1] * s[7] + s[2] * s[8]
    xx, xy, yy, bx, by = damping, 0.0, damping, 0.0, 0.0
    for c in range(3):
        jx = (s[3 + c] - s[c] * along_x) / length
        jy = (s[6 + c] - s[c] * along_y) / length
        xx += jx * jx
        xy += jx * jy
        yy += jy * jy
        bx += jx * e[c]
        by += jy * e[c]
    det = xx * yy - xy * xy
    return (yy * bx - xy * by) / det, (xx * by - xy * bx) / det


@nb.njit(**_FAST)
def _search_rays(image: Array, rays: Array, start: Array, iterations: int, damping: float) -> tuple[Array, Array]:
    h, w = image.shape[:2]
    out, costs = np.empty((len(rays), 2)), np.empty(len(rays))
    s, trial_s, e, trial_e = np.empty(_CHANNELS), np.empty(_CHANNELS), np.empty(3), np.empty(3)
    for n in range(len(rays)):
        x = min(max(start[n, 0], 1.0), w - 2.0)
        y = min(max(start[n, 1], 1.0), h - 2.0)
        _sample(image, x, y, s)
        cost, length = _difference(s, rays[n], e)
        lam = damping
        for _ in range(iterations):
            if not cost < np.inf:
                break
            dx, dy = _step(s, length, e, lam)
            nx, ny = min(max(x - dx, 1.0), w - 2.0), min(max(y - dy, 1.0), h - 2.0)
            if not (abs(nx) < np.inf and abs(ny) < np.inf):
                break
            _sample(image, nx, ny, trial_s)
            trial, trial_length = _difference(trial_s, rays[n], trial_e)
            if trial < cost:
                moved = max(abs(nx - x), abs(ny - y))
                x, y, cost, length = nx, ny, trial, trial_length
                s, trial_s, e, trial_e = trial_s, s, trial_e, e
                lam *= 0.1
                if moved < _SETTLED_PX:
                    break
            else:
                lam *= 10.0
        out[n, 0], out[n, 1], costs[n] = x, y, cost
    return out, costs


def search_descriptors(
    descriptors: Array, wanted: Array, start_px: Array, options: MatchOptions
) -> tuple[Array, Array]:
    """(n, 2) sub-pixel places of the descriptors (h, w, c) most like ``wanted`` (n, c) about start_px, and likeness.

    Rounds with steps of ``dilation_max`` … 1 px, each about the best pixel of the one before, which stays unless
    another is better; then the top of the quadratic through the likeness of 3 x 3 pixels. What is not a unit
    vector is not alike: -1 where nothing is.
    """
    maps = np.ascontiguousarray(descriptors, np.float32)
    limit = [maps.shape[1] - 1, maps.shape[0] - 1]
    start = np.clip(np.round(start_px), 0, limit).astype(np.int64)
    rows = np.ascontiguousarray(wanted, np.float32)
    out: tuple[Array, Array] = _search_descriptors(maps, rows, start, options.radius, options.dilation_max)
    return out


@nb.njit(inline="always", **_FAST)
def _likeness(maps: Array, y: int, x: int, row: Array) -> float:
    total: Any = np.float32(0.0)
    for c in range(len(row)):
        total += maps[y, x, c] * row[c]
    return total


@nb.njit(**_FAST)
def _top(maps: Array, y: int, x: int, row: Array, best: float) -> tuple[float, float]:
    """Where the quadratic through the likeness of 3 x 3 pixels is highest, from the middle one, which is ``best``.

    Up to a pixel away, as slanted surfaces bend it askew; 0, 0 where it has no top so near.
    """
    left, right = _likeness(maps, y, x - 1, row), _likeness(maps, y, x + 1, row)
    above, below = _likeness(maps, y - 1, x, row), _likeness(maps, y + 1, x, row)
    corners = _likeness(maps, y + 1, x + 1, row) + _likeness(maps, y - 1, x - 1, row)
    corners -= _likeness(maps, y + 1, x - 1, row) + _likeness(maps, y - 1, x + 1, row)
    gx, gy = 0.5 * (right - left), 0.5 * (below - above)
    xx, yy, xy = left - 2 * best + right, above - 2 * best + below, 0.25 * corners
    det = xx * yy - xy * xy
    if not (xx < -_FLAT and yy < -_FLAT and det > _FLAT * _FLAT):
        return 0.0, 0.0
    dx, dy = (xy * gy - yy * gx) / det, (xy * gx - xx * gy) / det
    if not (abs(dx) <= 1.0 and abs(dy) <= 1.0):
        return 0.0, 0.0
    return dx, dy


@nb.njit(**_FAST)
def _search_descriptors(
    maps: Array, wanted: Array, start: Array, radius: int, dilation_max: int
) -> tuple[Array, Array]:
    h, w = maps.shape[:2]
    out, similarity = np.empty((len(wanted), 2)), np.empty(len(wanted))
    for n in range(len(wanted)):
        row = wanted[n]
        x, y, best = start[n, 0], start[n, 1], -1.0
        for step in range(dilation_max, 0, -1):
            cx, cy, best = x, y, _likeness(maps, y, x, row)
            if not -1.0 < best < _MOST_ALIKE:
                best = -1.0
            for oy in range(-radius, radius + 1):
                py = cy + oy * step
                if py < 0 or py >= h:
                    continue
                for ox in range(-radius, radius + 1):
                    px = cx + ox * step
                    if px < 0 or px >= w:
                        continue
                    value = _likeness(maps, py, px, row)
                    if best < value < _MOST_ALIKE:
                        best, x, y = value, px, py
        out[n, 0], out[n, 1], similarity[n] = x, y, best
        if best > -1.0 and 0 < x < w - 1 and 0 < y < h - 1:
            dx, dy = _top(maps, y, x, row, best)
            out[n, 0], out[n, 1] = x + dx, y + dy
    return out, similarity
