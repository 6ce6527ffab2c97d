"""Scale stage, eq. (9)(10): patch medians over the same surface."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..geometry.se3 import transform
from ..types import USABLE_WEIGHT

Array = NDArray[Any]


def patch_scale(depth_pre: Array, depth_new: Array, patch: Array, weight: Array, min_points: int = 5) -> float:
    """Factor s that brings new's depths to the previous scale: median over patches of med(z_pre)/med(z_t).

    The paper prints the inverse ratio, which would double the error (docs/paper_map.md, (9) (10)).
    Args: depth_pre, depth_new (n,) of the same surface points; patch (n,) integer patch of each; weight (n,).
    Returns 1.0 where no patch has ``min_points`` weighted points.
    """
    used = (weight > USABLE_WEIGHT) & (depth_pre > 0) & (depth_new > 0)
    _, patch = np.unique(patch[used], return_inverse=True)
    count = np.bincount(patch)
    many = count >= min_points
    ratio = _medians(depth_pre[used], patch, count)[many] / _medians(depth_new[used], patch, count)[many]
    return float(np.median(ratio)) if len(ratio) else 1.0


def _medians(values: Array, patch: Array, count: Array) -> Array:
    """(k,) median of the values (n,) of each patch 0 … k - 1; ``count`` (k,) says how many each has."""
    ordered = values[np.lexsort((values, patch))]
    first = np.cumsum(count) - count
    return np.asarray((ordered[first + (count - 1) // 2] + ordered[first + count // 2]) / 2)


def correct_scale(
    points_ref: Array,
    points_new: Array,
    px: Array,
    weight: Array,
    new_from_ref: Array,
    patch_px: float = 64.0,
) -> float:
    """Eq. (9) for matched clouds: depths of ref's points seen from new against new's own, patches of ``patch_px``."""
    depth_pre = transform(new_from_ref, points_ref)[:, 2]
    patch = (px[:, 1] // patch_px).astype(int) * 4096 + (px[:, 0] // patch_px).astype(int)
    return patch_scale(depth_pre, points_new[:, 2], patch, weight)
