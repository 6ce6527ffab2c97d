"""How the evidence terms are joined; the filter and the smoother share it (III-A)."""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from .config import DynamicsConfig
from .data import DynamicMask, DynamicsInput
from .flow import HalfFlow
from .motion import Information
from .photometric import mismatch, photo_variance
from .refinement import EdgeRefinement

Array = NDArray[Any]
HELD_LOG_ODDS = 2.0  # of what is carried and of the appearance, from which a thing that stops is held to be the same


def kept_share(
    config: DynamicsConfig, flow: HalfFlow, small: Array, other: Array, to_other: Array, texture: Information
) -> Array:
    """(h, w) 1 where grey values agree with the flow small -> other, fading to 0 where they belie it."""
    pulled = flow.pull(other.astype(np.float32), to_other, -100.0)
    found = mismatch(small.astype(np.float32), pulled, photo_variance(texture, config))
    beyond = found - config.temporal.carry_mismatch
    share: Array = np.exp(-0.5 * np.maximum(beyond, 0))
    return share


def with_depth(fresh: Array, depth: Array) -> Array:
    """Motion and depth log ratios joined: a thing where the map has nothing is no part of it, also standing still."""
    static_share = np.clip(1 - depth, 0, 1)
    return np.maximum(fresh, 0) + static_share * np.minimum(fresh, 0) + depth


def held(carried: Array, fresh: Array, appearance: Array | None, config: DynamicsConfig) -> tuple[Array, Array]:
    """(carried, fresh) where what was seen to move, and looks like what moves, is not refuted by standing still.

    Log-odds at half size; ``appearance`` (h', w') is the classifier's. Both must hold: a parked car of the same
    appearance was never seen to move, and is judged by its own evidence.
    """
    if appearance is None:
        return carried, fresh
    alike = np.clip(resized(appearance, carried) / HELD_LOG_ODDS - 0.5, 0, 1)
    hold = np.clip(carried / HELD_LOG_ODDS, 0, 1) * alike
    unforgotten = carried * (1 + hold * np.float32(1 / config.temporal.memory - 1))
    return unforgotten, np.maximum(fresh, 0) + (1 - hold) * np.minimum(fresh, 0)


def accumulated(carried: Array, fresh: Array, config: DynamicsConfig) -> Array:
    """Log-odds carried over and log ratios of this frame added, clipped, float32."""
    limit = config.max_log_odds
    return np.clip(carried + config.evidence_gain * fresh, -limit, limit).astype(np.float32)


def shown_mask(
    refinement: EdgeRefinement, log_odds: Array, frame: DynamicsInput, appearance: Array | None, terms: dict[str, Array]
) -> DynamicMask:
    """The mask of log-odds at half size, with the semantics and the appearance that the frame has."""
    p = refinement.probability(log_odds, frame, appearance, terms.get("depth"))
    if frame.semantic is not None and refinement.config.semantic.enabled:
        terms["semantic"] = refinement.semantic_log_odds(frame.semantic)
    if appearance is not None:
        terms["appearance"] = appearance
    return DynamicMask(p, p > 0.5, terms)


def resized(values: Array, like: Array) -> Array:
    """``values`` at the size of ``like``."""
    return cv2.resize(values, (like.shape[1], like.shape[0]), interpolation=cv2.INTER_LINEAR)
