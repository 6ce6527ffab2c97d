"""Sparse features that need no weights: corners whose binary descriptors agree on a homography."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Sequence
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from ..types import FeatureMatches
from .verification import is_static

Array = NDArray[Any]
KEPT = 64  # images whose features are remembered


class OrbFeatures:
    """ORB features, mutual matches, RANSAC homography."""

    def __init__(self, features: int = 1500, min_inliers: int = 18) -> None:
        self._orb = cv2.ORB.create(nfeatures=features, fastThreshold=8)
        self._matcher = cv2.BFMatcher(cv2.NORM_HAMMING, crossCheck=True)
        self.min_inliers = min_inliers
        self._seen: OrderedDict[int, tuple[Array, Array, Any]] = (
            OrderedDict()
        )  # id of an image: it, pixels, descriptors

    def _described(self, image: Array) -> tuple[Array, Any]:
        """Pixels and descriptors of an image; those asked for last are kept, as keyframes come again and again."""
        key = id(image)
        if key not in self._seen:
            points, described = self._orb.detectAndCompute(image, None)
            self._seen[key] = (image, np.array([p.pt for p in points], np.float32).reshape(-1, 2), described)
            if len(self._seen) > KEPT:
                self._seen.popitem(last=False)
        self._seen.move_to_end(key)
        return self._seen[key][1:]

    def matches(
        self, ref: Array, new: Array, ref_moving: Array | None, new_moving: Array | None
    ) -> FeatureMatches | None:
        """See ``protocols.FeatureMatcher``; the one geometry is a homography."""
        (px_ref, d_ref), (px_new, d_new) = self._described(ref), self._described(new)
        still_ref, still_new = (np.flatnonzero(is_static(*g)) for g in ((px_ref, ref_moving), (px_new, new_moving)))
        if min(len(still_ref), len(still_new)) < self.min_inliers:
            return None
        found = self._matcher.match(d_ref[still_ref], d_new[still_new])
        if len(found) < self.min_inliers:
            return None
        a = px_ref[still_ref[[m.queryIdx for m in found]]]
        b = px_new[still_new[[m.trainIdx for m in found]]]
        homography, inlier = cv2.findHomography(a, b, cv2.RANSAC, 6.0)
        if homography is None or inlier is None or int(inlier.sum()) < self.min_inliers:
            return None
        agree = inlier.ravel() > 0
        return FeatureMatches(a[agree].astype(float), b[agree].astype(float), np.ones(int(agree.sum())))

    def alike(self, image: Array, others: Sequence[Array]) -> Array:
        """No opinion: too many places share some corners."""
        return np.full(len(others), np.nan)


def build() -> OrbFeatures:
    """The matcher with its defaults."""
    return OrbFeatures()
