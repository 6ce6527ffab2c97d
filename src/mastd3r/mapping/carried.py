"""A splat that goes on in a new one: of the old, what the new views do not show."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import fields

import numpy as np
import torch

from ..geometry.se3 import inverse, transform
from ..geometry.sim3 import Sim3
from ..types import View
from .correction import visibility
from .gaussian_arrays import Array, GaussianArrays, of_degree
from .gaussians import GaussianMap
from .sh import sh_degree
from .splat import OPAQUE, Splat

MOST_VIEWS = 48  # that are drawn
BEHIND = 1.1  # times the depth that is drawn: what lies farther is hidden by it
NOT_STATIC = 0.5  # a view says nothing where something moves
MOST_SHOWN_PX = 0.1  # sum of blending weights in a view, above: it leaks into the picture


def with_unseen(
    new: GaussianArrays, old: GaussianArrays, views: Sequence[View], near: float, device: str = "cpu"
) -> GaussianArrays:
    """``new``, and those of ``old`` that no view shows: out of the picture, or hidden by what ``new`` has there.

    Both are in one frame and unit; what is nearer than ``near`` is not drawn.
    """
    drawn = views[:: max(1, -(-len(views) // MOST_VIEWS))]
    known = _known(new, drawn, near, device)
    keep = ~_before_or_at(old.means.astype(float), drawn, known)
    degree = max(sh_degree(new.sh_rest), sh_degree(old.sh_rest))
    new, rest = of_degree(new, degree), _rows(of_degree(old, degree), keep)
    return _joined(new, _rows(rest, ~_leaking(new, rest, drawn, known, near, device)))


def _known(new: GaussianArrays, views: Sequence[View], near: float, device: str) -> list[tuple[Array, Array]]:
    """Of each view: the depth (h, w) that ``new`` has there, and bool (h, w), where the view has a say on it."""
    splat = Splat(new, near, device=device)
    out = []
    for view in views:
        _, depth, alpha = splat.render(view.world_from_cam, view.camera)
        out.append((depth, (view.static > NOT_STATIC) & (alpha > OPAQUE)))
    return out


def _before_or_at(means: Array, views: Sequence[View], known: Sequence[tuple[Array, Array]]) -> Array:
    """(n,) bool: in the picture of a view, and not hidden."""
    shown = np.zeros(len(means), bool)
    for view, (depth, says) in zip(views, known, strict=True):
        height, width = depth.shape
        points = transform(inverse(view.world_from_cam), means)
        rows = np.flatnonzero(points[:, 2] > 0)
        px = view.camera.project(points[rows])
        inside = (px > -0.5).all(1) & (px < [width - 0.5, height - 0.5]).all(1)
        rows, at = rows[inside], np.clip(np.rint(px[inside]).astype(int), 0, [width - 1, height - 1])
        x, y = at.T
        shown[rows[says[y, x] & (points[rows, 2] < BEHIND * depth[y, x])]] = True
    return shown


def _leaking(
    new: GaussianArrays,
    rest: GaussianArrays,
    views: Sequence[View],
    known: Sequence[tuple[Array, Array]],
    near: float,
    device: str,
) -> Array:
    """(n,) bool: of ``rest`` what is drawn where a view has a say: large and beside it, or shining through."""
    both, leaking = GaussianMap.from_arrays(_joined(new, rest), device), np.zeros(len(rest.means), bool)
    for view, (_, says) in zip(views, known, strict=True):
        pose = torch.from_numpy(inverse(view.world_from_cam))
        intrinsics = torch.from_numpy(view.camera.matrix).to(device)
        weight = torch.from_numpy(says.astype(np.float32)).to(device)
        found = visibility(both, Sim3.identity(), pose, intrinsics, weight, near)
        leaking |= found.weight_px[len(new.means) :].cpu().numpy() > MOST_SHOWN_PX
    return leaking


def _joined(a: GaussianArrays, b: GaussianArrays) -> GaussianArrays:
    return GaussianArrays(*(np.concatenate([getattr(x, f.name) for x in (a, b)]) for f in fields(GaussianArrays)))


def _rows(gaussians: GaussianArrays, keep: Array) -> GaussianArrays:
    return GaussianArrays(*(getattr(gaussians, f.name)[keep] for f in fields(GaussianArrays)))
