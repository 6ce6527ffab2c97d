"""Matches of chosen pixels around sparse features, where dense flow is led astray: wide baselines, little texture."""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from ..types import FeatureMatches
from .flow_maps import pixel_grid

Array = NDArray[Any]
NEIGHBOURS = 12  # features that the motion of a pixel is taken from
REACH_PX = 25.0  # 1-sigma of what a feature says of its surroundings, where others are as near
STIFFNESS_PX2 = 200.0  # of the local affine motion: without features on all sides it is a translation
FEATURE_PX = 6.0  # a pixel so near to a feature is found where the feature is, if no patch is
FEATURE_WEIGHT = 0.2  # of such a match: 1 / variance, of about 2 px, its own noise and that of the way to the pixel
BELIEVED_PX = 30.0  # so near to a feature dense flow may not differ from it by more than ASTRAY_PX
ASTRAY_PX = 6.0
HOMOGRAPHY_PX = 8.0  # so far from the homography of most a feature may be
FIELD_PX = 16  # cells of what features add to it
LEAST_FEATURES = 8  # of which something can be said
LEAST_CONFIRMED = 0.1  # share of the pixels at features that patches must find, for the others to be believed
SAME_PX = 1.5  # two searches of a pixel that end so near to one another found the same


def around(features: FeatureMatches, px: Array) -> tuple[Array, Array, Array]:
    """Where pixels (p, 2) of ref go by the features around them.

    Returns: (p, 2) pixels of new, (p, 2, 2) local d new / d ref, (p,) distance to the nearest feature in pixels.
    Weighted least squares of an affine motion over the nearest features, held stiffly to a translation.
    """
    ref, moved = features.ref_px, features.new_px - features.ref_px
    count = min(NEIGHBOURS, len(ref))
    nearest = cKDTree(ref).query(px, k=count)
    distance = np.asarray(nearest[0], float).reshape(len(px), count)
    at = np.asarray(nearest[1], int).reshape(len(px), count)
    reach = np.maximum(REACH_PX, distance[:, min(3, count - 1), None])
    weight = np.exp(-0.5 * (distance / reach) ** 2) * np.maximum(features.confidence[at], 1e-3)
    one = np.concatenate([np.ones((*at.shape, 1)), ref[at] - px[:, None]], -1)
    weighted = one * weight[..., None]
    normal = np.einsum("pki,pkj->pij", weighted, one) + np.diag([1e-9, STIFFNESS_PX2, STIFFNESS_PX2])
    found = np.linalg.solve(normal, np.einsum("pki,pkj->pij", weighted, moved[at]))
    return px + found[:, 0], np.eye(2) + found[:, 1:].transpose(0, 2, 1), distance[:, 0]


def merged(
    by_flow: tuple[Array, Array], by_feature: tuple[Array, Array], start: Array, distance: Array, inside: Array
) -> tuple[Array, Array]:
    """(p, 2) targets and (p,) weights from two searches of the same pixels, and from the features alone.

    Args: by_flow, by_feature: (p, 2) targets and (p,) weights from dense flow's start and from ``start`` (p, 2), where
    the features put the pixel; distance (p,) to the nearest feature; inside (p,) bool, ``start`` may be believed.
    Flow that is far from what features nearby say is led astray. Where both were found and differ, the features' are
    right. What no patch finds, right at a feature, is where the feature is, with that one's noise: as long as patches
    confirm enough of the features elsewhere.
    """
    (flow_px, flow_weight), (patch_px, patch_weight) = by_flow, by_feature
    flow, patch = flow_weight > 0, patch_weight > 0
    flow &= (distance > BELIEVED_PX) | (np.linalg.norm(flow_px - start, axis=1) <= ASTRAY_PX)
    flow &= ~patch | (np.linalg.norm(flow_px - patch_px, axis=1) <= SAME_PX)
    near = (distance <= FEATURE_PX) & inside
    believed = (near & (flow | patch)).sum() >= LEAST_CONFIRMED * near.sum()
    alone = near & ~flow & ~patch & believed
    target = np.where(flow[:, None], flow_px, np.where(patch[:, None], patch_px, start))
    weight = np.where(flow, flow_weight, np.where(patch, patch_weight, np.where(alone, FEATURE_WEIGHT, 0.0)))
    return target, weight


def dense_flow(features: FeatureMatches, width: int, height: int) -> Array:
    """(h, w, 2) float32 flow ref -> new to start from: a homography, and near features what they add to it."""
    ref, new = (np.ascontiguousarray(p, np.float32) for p in (features.ref_px, features.new_px))
    found = cv2.findHomography(ref, new, cv2.RANSAC, HOMOGRAPHY_PX)[0]
    homography = np.eye(3) if found is None else found
    grid = pixel_grid(width, height)
    limit = 2.0 * max(width, height)
    moved = cv2.perspectiveTransform(grid.reshape(-1, 1, 2), homography).reshape(height, width, 2)
    base = np.clip(np.nan_to_num(moved - grid), -limit, limit)
    at = ref.reshape(-1, 1, 2)
    there = ref + cv2.remap(base, at, None, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)[:, 0]
    rest = FeatureMatches(features.ref_px, features.ref_px + new - there, features.confidence)
    columns, rows = -(-width // FIELD_PX), -(-height // FIELD_PX)
    cx, cy = np.meshgrid((np.arange(columns) + 0.5) * FIELD_PX - 0.5, (np.arange(rows) + 0.5) * FIELD_PX - 0.5)
    centres = np.stack([cx, cy], -1).reshape(-1, 2)
    target, _, distance = around(rest, centres)
    added = (target - centres) * np.exp(-0.5 * (distance / BELIEVED_PX) ** 2)[:, None]
    field = added.reshape(rows, columns, 2).astype(np.float32)
    whole = cv2.resize(field, (columns * FIELD_PX, rows * FIELD_PX), interpolation=cv2.INTER_LINEAR)
    flow: Array = (base + whole[:height, :width]).astype(np.float32)
    return flow


def usable(features: FeatureMatches, width: int, height: int) -> FeatureMatches | None:
    """The matches that are numbers inside both images, of a part that may come from anywhere; None of fewer than 8."""
    ref, new, confidence = (np.asarray(a, float) for a in (features.ref_px, features.new_px, features.confidence))
    if ref.shape != new.shape or ref.shape != (len(confidence), 2):
        return None
    ends = np.concatenate([ref, new], 1)
    with np.errstate(invalid="ignore"):
        inside = ((ends >= -0.5) & (ends <= [width - 0.5, height - 0.5] * 2)).all(1) & (confidence >= 0)
    if inside.sum() < LEAST_FEATURES:
        return None
    return FeatureMatches(ref[inside], new[inside], np.minimum(confidence[inside], 1.0))
