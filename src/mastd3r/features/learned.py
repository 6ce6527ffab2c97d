"""Learned features, found, described and matched by networks that are handed in."""

from __future__ import annotations

import threading
from collections import OrderedDict
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from ..concurrency import one_torch_thread
from ..types import FeatureMatches, WorkFrame
from .verification import is_static, of_one_geometry

Array = NDArray[Any]
Rows = tuple[Array, Array, Array]  # (m,) rows of two images' features that belong together, and how surely
MOST_FEATURES = 1024  # of an image; those found best
MIN_MATCHES = 25  # that agree on one geometry
FEATURES_OF_A_PLACE, SAME_FEATURE = 200, 0.85  # that are compared, and the cosine above which two are the same
NEAR_COSINE = 0.82  # of descriptors that may show the same
ENOUGH_NEAREST, ENOUGH_SHARE = (
    120,
    0.5,
)  # nearest descriptors of one geometry: so many, and such a share, need no network
KEPT_IMAGES, KEPT_PAIRS = 256, 256  # that are remembered: a pair is asked both ways, and again as keyframes


class FeatureNetwork(Protocol):
    """Finds features."""

    def describe(self, image: Array, most: int) -> tuple[Array, Array]:
        """(n, 2) pixels, best first, and (n, c) float32 descriptors of an image (h, w) uint8."""
        ...


class MatchNetwork(Protocol):
    """Says which features belong together."""

    def match(
        self, px: tuple[Array, Array], described: tuple[Array, Array], size: tuple[int, int]
    ) -> tuple[Array, Array]:
        """(m, 2) rows and (m,) probability; of pixels, descriptors, and the size (width, height) of both images."""
        ...


@dataclass(frozen=True)
class FeatureMemory:
    """Whether the networks were read, and what is known of pairs of frames."""

    asked: bool
    pairs: tuple[tuple[WorkFrame, WorkFrame, tuple[Array, Array, Array]], ...]


class LearnedFeatures:
    """``load`` gives both networks when features are first wanted: a run that flows well never reads them."""

    def __init__(self, load: Callable[[], tuple[FeatureNetwork, MatchNetwork]]) -> None:
        self._load = load
        self._networks: tuple[FeatureNetwork, MatchNetwork] | None = None
        self._seen: OrderedDict[int, tuple[Array, Array, Array]] = OrderedDict()  # id of an image: it, its features
        self._kept: dict[int, tuple[Array, Array, Array]] = {}  # the same of a map's keyframes
        self._pairs: OrderedDict[tuple[int, int], tuple[Any, Rows]] = (
            OrderedDict()
        )  # of two images: what the network says
        self._neighbours: OrderedDict[tuple[int, int], tuple[Any, Rows]] = OrderedDict()  # the same by descriptors
        self._one_at_a_time = threading.Lock()  # edges are made beside tracking

    def matches(
        self, ref: Array, new: Array, ref_moving: Array | None, new_moving: Array | None
    ) -> FeatureMatches | None:
        """See ``protocols.FeatureMatcher``."""
        with self._one_at_a_time, one_torch_thread():
            found, share = self._agreeing(ref, new, ref_moving, new_moving, self._nearest(ref, new))
            if len(found.ref_px) < ENOUGH_NEAREST or share < ENOUGH_SHARE:
                found, _ = self._agreeing(ref, new, ref_moving, new_moving, self._matched(ref, new))
        return found if len(found.ref_px) >= MIN_MATCHES else None

    def alike(self, image: Array, others: Sequence[Array]) -> Array:
        """(n,) share of the best features of an image that each of the others has too; NaN where nobody asked before.

        A run whose flow was good everywhere does not read the networks for this.
        """
        if self._networks is None:
            return np.full(len(others), np.nan)
        with self._one_at_a_time, one_torch_thread():
            described = [self._described(a)[1][:FEATURES_OF_A_PLACE] for a in (image, *others)]
        return np.array([_common(described[0], d) for d in described[1:]])

    def descriptions(self, images: Sequence[Array]) -> list[tuple[Array, Array]]:
        """(n, 2) pixels and (n, c) descriptors of each image; reads the networks, so that ``alike`` is asked after."""
        with self._one_at_a_time, one_torch_thread():
            return [self._described(image) for image in images]

    def take_descriptions(self, images: Sequence[Array], described: Sequence[tuple[Array, Array]]) -> None:
        """Images (h, w) of a map, and what ``descriptions`` gave of them: kept to the end. Reads the networks."""
        self._networks_loaded()
        for image, (px, descriptors) in zip(images, described, strict=True):
            self._kept[id(image)] = (image, px.astype(np.float32), descriptors.astype(np.float32))

    def memory(self, frames: Sequence[WorkFrame]) -> FeatureMemory:
        """What later answers depend on; of pairs those of ``frames``, the only ones that can be asked for again."""
        by_image = {id(f.gray): f for f in frames}
        with self._one_at_a_time:
            pairs = [(by_image.get(a), by_image.get(b), found) for (a, b), (_, found) in self._pairs.items()]
        known = tuple((a, b, found) for a, b, found in pairs if a is not None and b is not None)
        return FeatureMemory(self._networks is not None, known)

    def remember(self, memory: FeatureMemory) -> None:
        """Answer as the one that gave ``memory`` would."""
        if memory.asked:
            self._networks_loaded()
        for a, b, found in memory.pairs:
            self._pairs[id(a.gray), id(b.gray)] = ((a.gray, b.gray), found)

    def forget(self) -> None:
        """Nothing is kept of images and pairs, but of a map's keyframes; the networks stay."""
        with self._one_at_a_time:
            self._seen.clear()
            self._pairs.clear()
            self._neighbours.clear()

    def _agreeing(
        self, ref: Array, new: Array, ref_moving: Array | None, new_moving: Array | None, rows: Rows
    ) -> tuple[FeatureMatches, float]:
        """The matches of static places that agree on one geometry, and their share."""
        rows_ref, rows_new, score = rows
        a, b = (self._described(i)[0][r].astype(float) for i, r in ((ref, rows_ref), (new, rows_new)))
        static = is_static(a, ref_moving) & is_static(b, new_moving)
        agree = np.flatnonzero(static)[of_one_geometry(a[static], b[static])]
        return FeatureMatches(a[agree], b[agree], score[agree]), len(agree) / max(int(static.sum()), 1)

    def _nearest(self, ref: Array, new: Array) -> Rows:
        """Rows of both whose descriptors are one another's nearest, and their cosine: little work."""
        key = (id(ref), id(new))
        if key not in self._neighbours:
            there, cosine = _mutual(self._described(ref)[1], self._described(new)[1], NEAR_COSINE)
            at = np.flatnonzero(there >= 0)
            self._neighbours[key] = ((ref, new), (at, there[at], cosine[at].astype(float)))
            if len(self._neighbours) > KEPT_PAIRS:
                self._neighbours.popitem(last=False)
        return self._neighbours[key][1]

    def _networks_loaded(self) -> tuple[FeatureNetwork, MatchNetwork]:
        if self._networks is None:
            self._networks = self._load()
        return self._networks

    def _described(self, image: Array) -> tuple[Array, Array]:
        key = id(image)
        if key in self._kept:
            return self._kept[key][1:]
        if key not in self._seen:
            found = self._networks_loaded()[0].describe(image, MOST_FEATURES)
            self._seen[key] = (image, *found)
            if len(self._seen) > KEPT_IMAGES:
                self._seen.popitem(last=False)
        self._seen.move_to_end(key)
        return self._seen[key][1:]

    def _matched(self, ref: Array, new: Array) -> Rows:
        """Rows of both that belong together, and their probability; a pair seen from the other side is the same."""
        here, back = (id(ref), id(new)), (id(new), id(ref))
        if back in self._pairs and here not in self._pairs:
            there, ours, score = self._pairs[back][1]
            return ours, there, score
        if here not in self._pairs:
            (px_ref, d_ref), (px_new, d_new) = self._described(ref), self._described(new)
            rows, score = self._networks_loaded()[1].match((px_ref, px_new), (d_ref, d_new), ref.shape[::-1])
            self._pairs[here] = ((ref, new), (rows[:, 0], rows[:, 1], score))
            if len(self._pairs) > KEPT_PAIRS:
                self._pairs.popitem(last=False)
        return self._pairs[here][1]


def _common(a: Array, b: Array) -> float:
    """Share of descriptors that are one another's nearest, and near."""
    if min(len(a), len(b)) == 0:
        return 0.0
    return float((_mutual(a, b, SAME_FEATURE)[0] >= 0).mean())


def _mutual(a: Array, b: Array, least: float) -> tuple[Array, Array]:
    """(n,) row of ``b`` nearest to each of ``a``, where that is mutual, else -1; (n,) cosine of the nearest."""
    if min(len(a), len(b)) == 0:
        return np.full(len(a), -1), np.zeros(len(a), np.float32)
    cosine = a @ b.T
    there, back = cosine.argmax(1), cosine.argmax(0)
    best = cosine[np.arange(len(a)), there]
    return np.where((back[there] == np.arange(len(a))) & (best > least), there, -1), best
