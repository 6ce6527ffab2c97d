"""Outlines by colour: two densities over an image's colours, of what moves and of what is around it."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import cv2
import numba
import numpy as np
from numpy.typing import NDArray

from .config import ColoursConfig

Array = NDArray[Any]
Pooled = Callable[[Array, Array, float], Array]  # (log-odds, colours in Lab, their scale) -> pooled inside edges
CELL_L, CELL_AB = 32.0, 4.0  # of 255: shading changes lightness, not the two colour differences
CELLS = (int(255 / CELL_L) + 2, int(255 / CELL_AB) + 2, int(255 / CELL_AB) + 2)
LEAST_PX = 20  # moving pixels that say what moving ones look like
UNSEEN_PX = 0.5  # pixels of either kind that a colour is taken to have been seen in


def by_colours(log_odds: Array, color: Array, config: ColoursConfig, pooled: Pooled, semantic: bool = False) -> Array:
    """Log-odds (h, w) float32 of P(moving), of which each pixel now also says which side has its colour.

    What moves and what lies within ``config.margin_ratio`` of it are two densities over Lab (a grid with linear
    weights), of log-odds above and below 0; the log of their ratio is evidence, joined with the log-odds that came
    and pooled inside edges; from those the densities are made anew, ``config.rounds`` times, the last at full size.
    Nothing begins to move that is not within ``config.reach_ratio`` of what did (both in sqrt(h·w)); nothing at all
    where a ``semantic`` map has said where things end.

    ``color`` is (h, w, 3) uint8 RGB. The idea is that of GrabCut (Rother, Kolmogorov, Blake 2004), with histograms
    for its mixtures and a filter for its cut. As it came where next to nothing moves.
    """
    inside = log_odds > 0
    if np.count_nonzero(inside) < LEAST_PX:
        return log_odds
    size = float(np.sqrt(log_odds.size))
    gain, reach = (config.gain_semantic, 0) if semantic else (config.gain, max(1, round(config.reach_ratio * size)))
    margin = max(1, round(config.margin_ratio * size))
    near = cv2.dilate(inside.view(np.uint8), np.ones((2 * reach + 1, 2 * reach + 1), np.uint8))
    x, y, w, h = cv2.boundingRect(near)
    box = np.s_[max(y - margin, 0) : y + h + margin, max(x - margin, 0) : x + w + margin]
    known = np.clip(log_odds[box], -config.trusted_log_odds, config.trusted_log_odds)
    lab = cv2.cvtColor(np.ascontiguousarray(color[box]), cv2.COLOR_RGB2LAB)
    half = (known.shape[1] + 1) // 2, (known.shape[0] + 1) // 2
    small, small_lab = (cv2.resize(a, half, interpolation=cv2.INTER_AREA) for a in (known, lab))
    found = small
    for _ in range(config.rounds - 1):
        found = pooled(small + _evidence(small_lab, found, gain, config), small_lab, 0.5)
    evidence = cv2.resize(_evidence(small_lab, found, gain, config), known.shape[::-1], interpolation=cv2.INTER_LINEAR)
    found = pooled(known + evidence, lab, 1.0)
    out = log_odds.copy()
    out[box] = np.where(near[box] > 0, found, np.minimum(found, log_odds[box]))
    return out


def _evidence(lab: Array, log_odds: Array, gain: float, config: ColoursConfig) -> Array:
    """``gain`` times the log of the ratio of the two densities at each pixel's colour, (h, w) float32, bounded."""
    p = 1 / (1 + np.exp(-log_odds))
    moving, still = (np.where(log_odds > 0, p, 0), np.where(log_odds > 0, 0, 1 - p))
    seen = np.zeros((*CELLS, 2), np.float32)
    add_colours(lab, moving.astype(np.float32), still.astype(np.float32), seen)
    share = float(np.log(max(moving.sum(), 1.0) / max(still.sum(), 1.0)))
    ratio = np.empty(log_odds.shape, np.float32)
    colour_ratio(lab, seen, UNSEEN_PX, share, ratio)
    return np.clip(gain * ratio, -config.max_still_log_odds, config.max_log_odds)


_JIT: dict[str, Any] = {"cache": True, "nogil": True, "error_model": "numpy", "fastmath": True}
_F = np.float32


@numba.njit(inline="always", **_JIT)
def _cell(value: int, size: float) -> tuple[int, Any]:
    """(cell below, share of the one above) of a colour's part."""
    at = _F(value) * _F(1 / size)
    below = int(at)
    return below, at - _F(below)


@numba.njit(inline="always", **_JIT)
def _corner(n: int, tl: float, ta: float, tb: float) -> tuple[int, int, int, Any]:
    """(steps to the n-th of eight cells, its share of a colour)."""
    dl, da, db = n >> 2, n >> 1 & 1, n & 1
    w = tl if dl else _F(1) - tl
    w *= ta if da else _F(1) - ta
    w *= tb if db else _F(1) - tb
    return dl, da, db, w


@numba.njit(**_JIT)
def add_colours(lab: Array, moving: Array, still: Array, seen: Array) -> None:
    """Add the weights of each pixel to the eight cells around its colour; ``lab`` (h, w, 3), ``seen`` (l, a, b, 2)."""
    for y in range(lab.shape[0]):
        for x in range(lab.shape[1]):
            m, s = moving[y, x], still[y, x]
            l, tl = _cell(lab[y, x, 0], CELL_L)
            a, ta = _cell(lab[y, x, 1], CELL_AB)
            b, tb = _cell(lab[y, x, 2], CELL_AB)
            for n in range(8):
                dl, da, db, w = _corner(n, tl, ta, tb)
                seen[l + dl, a + da, b + db, 0] += w * m
                seen[l + dl, a + da, b + db, 1] += w * s


@numba.njit(**_JIT)
def colour_ratio(lab: Array, seen: Array, unseen: float, share: float, out: Array) -> None:
    """Write the log of P(colour | moving) / P(colour | still); ``share`` is the log of their pixels' ratio."""
    prior = np.exp(_F(share)) * _F(unseen)
    for y in range(lab.shape[0]):
        for x in range(lab.shape[1]):
            l, tl = _cell(lab[y, x, 0], CELL_L)
            a, ta = _cell(lab[y, x, 1], CELL_AB)
            b, tb = _cell(lab[y, x, 2], CELL_AB)
            moving, still = prior, _F(unseen)
            for n in range(8):
                dl, da, db, w = _corner(n, tl, ta, tb)
                moving += w * seen[l + dl, a + da, b + db, 0]
                still += w * seen[l + dl, a + da, b + db, 1]
            out[y, x] = np.log(moving / still) - _F(share)
