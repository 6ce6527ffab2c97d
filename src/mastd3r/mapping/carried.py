"""A splat that goes on in a new one: of the old, what the new views do not show."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import fields

import numpy as np

from ..camera.pinhole import Camera
from ..geometry.se3 import inverse, transform
from ..types import View
from .gaussian_arrays import Array, GaussianArrays, of_degree
from .sh import sh_degree
from .splat import OPAQUE

Render = Callable[[Array, Camera], tuple[Array, Array, Array]]
MOST_VIEWS = 48  # that are drawn
BEHIND = 1.1  # times the depth that is drawn: what lies farther is hidden by it
NOT_STATIC = 0.5  # a view says nothing where something moves


def with_unseen(new: GaussianArrays, old: GaussianArrays, render: Render, views: Sequence[View]) -> GaussianArrays:
    """``new``, and those of ``old`` that no view shows: out of the picture, or behind what ``new`` has there.

    ``render`` draws ``new``. Both are in one frame and unit.
    """
    keep = ~_shown(old.means.astype(float), render, views)
    if not keep.any():
        return new
    degree = max(sh_degree(new.sh_rest), sh_degree(old.sh_rest))
    parts = [of_degree(new, degree), of_degree(_rows(old, keep), degree)]
    return GaussianArrays(*(np.concatenate([getattr(p, f.name) for p in parts]) for f in fields(GaussianArrays)))


def _shown(means: Array, render: Render, views: Sequence[View]) -> Array:
    """(n,) bool: a view has a say on what is there."""
    shown = np.zeros(len(means), bool)
    for view in views[:: -(-len(views) // MOST_VIEWS)]:
        _, depth, alpha = render(view.world_from_cam, view.camera)
        height, width = depth.shape
        points = transform(inverse(view.world_from_cam), means)
        rows = np.flatnonzero(points[:, 2] > 0)
        px = view.camera.project(points[rows])
        inside = (px > -0.5).all(1) & (px < [width - 0.5, height - 0.5]).all(1)
        rows, at = rows[inside], np.clip(np.rint(px[inside]).astype(int), 0, [width - 1, height - 1])
        x, y = at.T
        says = (view.static[y, x] > NOT_STATIC) & (alpha[y, x] > OPAQUE)
        shown[rows[says & (points[rows, 2] < BEHIND * depth[y, x])]] = True
    return shown


def _rows(gaussians: GaussianArrays, keep: Array) -> GaussianArrays:
    return GaussianArrays(*(getattr(gaussians, f.name)[keep] for f in fields(GaussianArrays)))
