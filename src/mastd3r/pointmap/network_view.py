"""What a network's points say of one view: inverse depth, focal length; and where its image lies in the photograph."""

from __future__ import annotations

from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

Array = NDArray[Any]
MIN_CONFIDENCE = 1.5  # of a point, in the network's own 1 … inf, for it to count as own depth
EDGE_RATIO = 1.05  # inverse depths of neighbours that differ by more belong to two surfaces
MAX_INV_DEPTH = 1e4  # nearer than 0.1 mm is not a measurement
MIN_INV_DEPTH = 1e-4  # farther than 10 km neither


class Window(Protocol):
    """Where the network's image lies in the photograph at the network's scale."""

    @property
    def resized_size(self) -> tuple[int, int]: ...  # (width, height) of the whole photograph at that scale
    @property
    def crop_left_px(self) -> int: ...
    @property
    def crop_top_px(self) -> int: ...
    @property
    def net_size(self) -> tuple[int, int]: ...  # (width, height) of what the network sees


def as_array(values: Any) -> Array:
    """A tensor of any device as numpy; an array as it is."""
    return np.asarray(values.cpu() if hasattr(values, "cpu") else values)


def own_inv_depth(points: Array, confidence: Array) -> Array:
    """(h, w) float32 1/z of a view's points in its own camera; 0 where they are unsure or nonsense."""
    with np.errstate(divide="ignore", invalid="ignore"):
        inv_depth = 1 / points[..., 2]
    known = (inv_depth > MIN_INV_DEPTH) & (inv_depth < MAX_INV_DEPTH) & (confidence > MIN_CONFIDENCE)
    known &= np.isfinite(points).all(-1)
    return np.where(known, inv_depth, 0).astype(np.float32)


def in_window(values: Array, window: Window) -> Array:
    """The part of a working-size map (h, w, …) that the network sees; a view, not a copy."""
    x, y, (w, h) = window.crop_left_px, window.crop_top_px, window.net_size
    return values[y : y + h, x : x + w]


def corner_of(window: Window) -> Array:
    return np.array([window.crop_left_px, window.crop_top_px], float)


def focal_from_points(points: Array, known: Array, centre_px: tuple[float, float]) -> float | None:
    """Focal length in px of a pointmap in its own camera (h, w, 3): median of u·q/|q|², u = px - centre, q = xy/z.

    One pixel of 4 x 4 speaks, if off the centre by a tenth of the diagonal; None for fewer than 50 of them.
    """
    y, x = np.argwhere(known[::4, ::4]).T * 4
    u = np.stack([x - centre_px[0], y - centre_px[1]], 1)
    far = np.hypot(*u.T) > 0.1 * np.hypot(*known.shape)
    at = points[y[far], x[far]].astype(float)
    q, u = at[:, :2] / at[:, 2:], u[far]
    along = (u * q).sum(1)
    fine = along > 0
    if fine.sum() < 50:
        return None
    return float(np.median(along[fine] / (q[fine] ** 2).sum(1)))


def sample_smooth(inv_depth: Array | None, px: Array) -> Array:
    """(p,) bilinear inverse depth; 0 where a corner is unknown or outside, or the corners are two surfaces.

    Inverse depth, because that of a plane is linear in the pixel.
    """
    if inv_depth is None:
        return np.zeros(len(px))
    h, w = inv_depth.shape
    inside = (px[:, 0] >= 0) & (px[:, 1] >= 0) & (px[:, 0] <= w - 1) & (px[:, 1] <= h - 1)
    at = np.where(inside[:, None], px, 0.0)
    x, y = np.minimum(at.astype(int), [max(w - 2, 0), max(h - 2, 0)]).T
    a, b = at[:, 0] - x, at[:, 1] - y
    corners = np.stack([inv_depth[y + j, x + i] for j in (0, 1) for i in (0, 1)]).astype(float)
    share = np.stack([(1 - a) * (1 - b), a * (1 - b), (1 - a) * b, a * b])
    counts = share > 1e-9
    low = np.where(counts, corners, np.inf).min(0)
    high = np.where(counts, corners, 0.0).max(0)
    return np.where(inside & (low > 0) & (high < EDGE_RATIO * low), (share * corners).sum(0), 0.0)
