"""How the evidence terms are joined; the filter and the smoother share it (III-A)."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import cv2
import numba as nb
import numpy as np
from numpy.typing import NDArray

from .config import DynamicsConfig
from .data import DynamicMask, DynamicsInput
from .people import believed
from .pixels import JIT, between_pixels
from .refinement import EdgeRefinement

Array = NDArray[Any]
_F = np.float32
OUTSIDE_GREY = -100.0  # of what lies outside of an image: like nothing in it
HELD_LOG_ODDS = 2.0  # of what is carried and of the appearance, from which a thing that stops is held to be the same


def kept_share(config: DynamicsConfig, small: Array, other: Array, to_other: Array, variance: Array) -> Array:
    """(h, w) 1 where grey values agree with the flow small -> other, fading to 0 where they belie it.

    ``variance`` (h, w) of grey values: ``photo_variance``.
    """
    share = np.empty(small.shape, np.float32)
    _squared_difference(small, other, to_other, share)
    share = cv2.blur(share, (3, 3))
    share /= variance
    np.maximum(share - np.float32(config.temporal.carry_mismatch), 0, out=share)
    share *= np.float32(-0.5)
    return np.exp(share, out=share)


@nb.njit(**JIT)
def _squared_difference(small: Array, other: Array, flow: Array, out: Array) -> None:
    """(small - other along the flow)²; outside of ``other`` it differs by far."""
    h, w = out.shape
    for j in range(h):
        for i in range(w):
            u, v = _F(i) + flow[j, i, 0], _F(j) + flow[j, i, 1]
            there = _F(OUTSIDE_GREY)
            if 0 <= u <= w - 1 and 0 <= v <= h - 1:
                there = between_pixels(other, u, v)
            there -= _F(small[j, i])
            out[j, i] = there * there


def carried_along(log_odds: Array, flow: Array, kept: Array | None, memory: float) -> Array:
    """(h, w) float32: log-odds of another frame, seen along the flow to it, forgetting; 0 where that leaves it.

    ``kept`` (h, w): the share that survives, by ``kept_share``.
    """
    out = np.empty(log_odds.shape, np.float32)
    _carried_along(log_odds, flow, _F(memory), out)
    return out if kept is None else np.multiply(out, kept, out=out)


@nb.njit(**JIT)
def _carried_along(log_odds: Array, flow: Array, memory: float, out: Array) -> None:
    h, w = out.shape
    for j in range(h):
        for i in range(w):
            u, v = _F(i) + flow[j, i, 0], _F(j) + flow[j, i, 1]
            out[j, i] = 0
            if 0 <= u <= w - 1 and 0 <= v <= h - 1:
                out[j, i] = memory * between_pixels(log_odds, u, v)


def with_depth(fresh: Array, depth: Array) -> Array:
    """Motion and depth log ratios joined: a thing where the map has nothing is no part of it, also standing still."""
    static_share = np.clip(1 - depth, 0, 1)
    return np.maximum(fresh, 0) + static_share * np.minimum(fresh, 0) + depth


def alike(appearance: Array | None, shape: tuple[int, ...]) -> Array | None:
    """(h, w) float32 0..1: how much a pixel looks like what moves, of the classifier's log-odds (h', w')."""
    if appearance is None:
        return None
    return np.clip(resized(appearance, shape) * np.float32(1 / HELD_LOG_ODDS) - np.float32(0.5), 0, 1)


def accumulated(carried: Array, fresh: Array, like: Array | None, config: DynamicsConfig) -> Array:
    """Log-odds carried over and log ratios of this frame added, clipped, (h, w) float32 at half size.

    What was seen to move, and looks like what moves (``like``, by ``alike``), is not refuted by standing still, and
    not forgotten. Both must hold: a parked car of the same appearance was never seen to move, and is judged by its
    own evidence.
    """
    out = np.empty(carried.shape, np.float32)
    limits = _F(config.evidence_gain), _F(config.max_log_odds)
    _accumulated(
        carried, fresh, carried if like is None else like, _F(like is not None), _F(_forgotten(config)), *limits, out
    )
    return out


def _forgotten(config: DynamicsConfig) -> float:
    """What ``carried_along`` took, for what is held to be given back."""
    return 1 / max(config.temporal.memory, 1e-3) - 1


@nb.njit(**JIT)
def _accumulated(
    carried: Array, fresh: Array, like: Array, holds: float, forgotten: float, gain: float, limit: float, out: Array
) -> None:
    one = _F(1)
    for j in range(out.shape[0]):
        for i in range(out.shape[1]):
            old, new = carried[j, i], fresh[j, i]
            hold = holds * min(max(old * _F(1 / HELD_LOG_ODDS), _F(0)), one) * like[j, i]
            old *= one + hold * forgotten
            new = max(new, _F(0)) + (one - hold) * min(new, _F(0))
            out[j, i] = min(max(old + gain * new, -limit), limit)


def shown_mask(
    refinement: EdgeRefinement, log_odds: Array, frame: DynamicsInput, appearance: Array | None, terms: dict[str, Array]
) -> DynamicMask:
    """The mask of log-odds at half size, with the semantics and the appearance that the frame has."""
    frame = replace(frame, semantic=believed(frame.semantic, log_odds, refinement.config.semantic))
    p = refinement.probability(log_odds, frame, appearance, terms.get("depth"))
    if frame.semantic is not None and refinement.config.semantic.enabled:
        terms["semantic"] = refinement.semantic_log_odds(frame.semantic)
    if appearance is not None:
        terms["appearance"] = appearance
    return DynamicMask(p, p > 0.5, terms)


def resized(values: Array, shape: tuple[int, ...]) -> Array:
    """``values`` at another size (h, w)."""
    return cv2.resize(values, (shape[1], shape[0]), interpolation=cv2.INTER_LINEAR)
