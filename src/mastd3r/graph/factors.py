"""The unknowns of a keyframe, and the matches that hold two keyframes together."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..types import USABLE_WEIGHT, Matches

Array = NDArray[Any]
KEPT_MATCHES = 600  # matches kept of a frame that is no keyframe, for the final pose


@dataclass
class ReprojectionFactor:
    """An edge: matches of anchor keyframe i's grid pixels in keyframe j."""

    i: int
    j: int
    target: Array  # (p, 2) float32 pixels in j
    weight: Array  # (p,) float32, 0 = no match


def thinned_edge(edge: ReprojectionFactor, step: int) -> ReprojectionFactor:
    """Every ``step``-th match, in arrays of their own: kernels are compiled for arrays without gaps."""
    return ReprojectionFactor(edge.i, edge.j, edge.target[::step].copy(), edge.weight[::step].copy())


@dataclass
class KeyframeVariables:
    """One keyframe's unknowns in the problem, and their priors."""

    px: Array  # (p, 2)
    inv_depth: Array  # (p,)
    prior_depth: Array  # (p,)
    prior_info: Array  # (p,) information of prior_depth
    cam_from_world: Array  # (4, 4)
    depth_info: Array = field(default_factory=lambda: np.zeros(0))  # (p,) H_dd of the last solve


Variables = dict[int, KeyframeVariables]  # by keyframe
Factors = dict[int, list[ReprojectionFactor]]  # by anchor keyframe


def strongest(matches: Matches, weight: Array) -> tuple[Array, Array, Array]:
    """Points, targets and weights of the matches that a frame keeps."""
    strong = np.flatnonzero(weight > USABLE_WEIGHT)
    keep = np.sort(strong[np.argsort(-weight[strong], kind="stable")[:KEPT_MATCHES]])
    return keep, matches.new_px[keep].astype(np.float32), weight[keep].astype(np.float32)


def no_matches() -> tuple[Array, Array, Array]:
    """The same of a frame that keeps none."""
    return np.zeros(0, int), np.zeros((0, 2), np.float32), np.zeros(0, np.float32)
