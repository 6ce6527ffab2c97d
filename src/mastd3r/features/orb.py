"""Sparse features for jumps that flow cannot follow: a homography as the start of the flow."""

from __future__ import annotations

from collections import OrderedDict
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

Array = NDArray[Any]
KEPT = 64  # images whose features are remembered


class OrbFeatures:
    """ORB features, mutual matches, RANSAC homography; answers with a dense start for the flow."""

    def __init__(self, features: int = 1500, min_inliers: int = 18) -> None:
        self._orb = cv2.ORB.create(nfeatures=features, fastThreshold=8)
        self._matcher = cv2.BFMatcher(cv2.NORM_HAMMING, crossCheck=True)
        self.min_inliers = min_inliers
        self._seen: OrderedDict[int, tuple[Array, Any, Any]] = OrderedDict()  # id of an image: it, points, descriptors

    def _described(self, image: Array) -> tuple[Any, Any]:
        """Points and descriptors of an image; those asked for last are kept, as keyframes come again and again."""
        key = id(image)
        if key not in self._seen:
            self._seen[key] = (image, *self._orb.detectAndCompute(image, None))
            if len(self._seen) > KEPT:
                self._seen.popitem(last=False)
        self._seen.move_to_end(key)
        return self._seen[key][1:]

    def flow(self, ref: Array, new: Array, ref_moving: Array | None, new_moving: Array | None) -> Array | None:
        """(h, w, 2) float32 flow of the homography ref -> new; None where too few features agree.

        ``ref_moving``, ``new_moving`` (h, w): P(moving) in 0..1; what probably moves has no say.
        """
        points_ref, described_ref = _static(*self._described(ref), ref_moving)
        points_new, described_new = _static(*self._described(new), new_moving)
        if described_ref is None or described_new is None:
            return None
        matches = self._matcher.match(described_ref, described_new)
        if len(matches) < self.min_inliers:
            return None
        a = np.array([points_ref[m.queryIdx].pt for m in matches], np.float32)
        b = np.array([points_new[m.trainIdx].pt for m in matches], np.float32)
        homography, inlier = cv2.findHomography(a, b, cv2.RANSAC, 6.0)
        if homography is None or inlier is None or int(inlier.sum()) < self.min_inliers:
            return None
        h, w = ref.shape
        x, y = np.meshgrid(np.arange(w, dtype=np.float32), np.arange(h, dtype=np.float32))
        grid = np.stack([x, y], -1)
        moved = cv2.perspectiveTransform(grid.reshape(-1, 1, 2), homography).reshape(h, w, 2)
        return np.clip(moved - grid, -2.0 * w, 2.0 * w).astype(np.float32)


def _static(points: Any, described: Any, moving: Array | None) -> tuple[Any, Any]:
    """The features that probably belong to the static scene; without descriptors where there are none."""
    if described is None or moving is None:
        return points, described
    at = np.array([p.pt for p in points]).round().astype(int)
    still = np.flatnonzero(moving[at[:, 1], at[:, 0]] < 0.5)
    return [points[n] for n in still], described[still] if len(still) else None


def build() -> OrbFeatures:
    """The matcher with its defaults."""
    return OrbFeatures()
