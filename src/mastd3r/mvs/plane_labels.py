"""The plane of the scene that a view's bare pixels lie on: what is seen, what supports it, and what its neighbours say.

A planar prior that competes with matching where that says little, as Xu and Tao, "Planar prior assisted PatchMatch
multi-view stereo", AAAI 2020, with planes of the whole scene in place of a triangulation, and semi-global matching over
the planes in place of propagation.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from .plane_kernels import evidence
from .planes import Planes
from .sweep import SweepImage, cost_volume
from .sweep_kernels import aggregate

Array = NDArray[Any]
OFF_RATIO = 0.02  # relative difference from sure depth at which a plane is fully refuted
NONE_COST = 0.5  # of a sure pixel that lies on no plane
BARE_COST = 0.25  # of any pixel on no plane
PHOTO_COST = 0.5  # of a plane on which nothing matches, where there is contrast
FAR_CELLS = 14.0  # from support, beyond which a plane is not looked for
FAR_COST = 0.2  # there
JUMP, LEAST_JUMP, EDGE_LEVELS = 0.6, 0.15, 8.0  # cost of a change of plane, at least, and halved by such a grey step
LEAST_VISIBLE = 0.002  # of the pixels, on which a plane may be
WORST = 1.0  # own cost above which a plane is not believed


@dataclass(frozen=True)
class Swept:
    """What was swept of all views, at the size of the images."""

    images: list[SweepImage]
    merged: Array  # (V, h, w) float32 inverse depth
    weight: Array  # (V, h, w) 0..1: how sure it is
    clear: Array  # (V, h, w) 0..1: contrast
    sure: Array  # (V, h, w) float32 inverse depth where it refutes planes, 0 elsewhere


def plane_labels(
    swept: Swept, at: int, others: Array, planes: Planes, rays: Array, k: Array, from_ref: Array, tolerance: float
) -> Array:
    """(h, w) uint8 number of the plane at every pixel of view ``at``, from 1; 0 where there is none.

    rays: (h, w, 3) with z = 1. others, k, from_ref and tolerance: as of ``evidence``.
    """
    ref = swept.images[at]
    h, w = ref.gray.shape
    nothing = np.zeros((h, w), np.uint8)
    slopes = planes.slopes(ref.world_from_cam)
    if not len(slopes) or not len(others):
        return nothing
    found = np.empty((h, w, len(slopes)), np.float32)
    axes = planes.axes @ ref.world_from_cam
    evidence(slopes, rays, axes, planes.grids, swept.sure, others, k, from_ref, tolerance, FAR_CELLS, found)
    usable = np.flatnonzero((found < 1).mean((0, 1)) > LEAST_VISIBLE)
    if not len(usable):
        return nothing
    found, slopes = found[..., usable], slopes[usable]
    rho = (rays @ slopes.T).astype(np.float32)
    photo = cost_volume(ref, [swept.images[j] for j in others], slopes)
    weight, clear = swept.weight[at][..., None], swept.clear[at][..., None]
    off = np.minimum(np.abs(rho / np.maximum(swept.merged[at], 1e-9)[..., None] - 1) / OFF_RATIO, 1)
    own = np.empty((h, w, len(slopes) + 1), np.float32)
    own[..., 1:] = (
        weight * off + PHOTO_COST * clear * photo + FAR_COST * np.minimum(found, 1) + np.maximum(found - 1, 0)
    )
    own[..., :1] = BARE_COST + NONE_COST * weight
    total = np.zeros_like(own)
    for backward in (False, True):
        aggregate(own, ref.gray, np.inf, JUMP, LEAST_JUMP, EDGE_LEVELS, backward, total)
    label = total.argmin(-1)
    believed = np.take_along_axis(own, label[..., None], 2)[..., 0] < WORST
    return np.where(believed, np.append(0, usable + 1)[label], 0).astype(np.uint8)


def plane_inv_depth(labels: Array, slopes: Array, rays: Array) -> Array:
    """(h, w) float32 inverse depth at rays (h, w, 3) with z = 1 of the planes that ``labels`` (h / n, w / n) name.

    0 where there is none, and where labels change, so that the picture says where one surface ends. slopes: (P, 3).
    """
    inside = cv2.erode(labels, np.ones((3, 3), np.uint8)) == cv2.dilate(labels, np.ones((3, 3), np.uint8))
    large = cv2.resize(np.where(inside, labels, 0), rays.shape[1::-1], interpolation=cv2.INTER_NEAREST)
    known = np.concatenate([np.zeros((1, 3)), slopes])[large]
    return np.maximum((known * rays).sum(-1), 0).astype(np.float32)
