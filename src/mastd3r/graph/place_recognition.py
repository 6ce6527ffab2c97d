"""Which keyframes may show one place, by what they look like."""

from __future__ import annotations

from collections.abc import Callable, Collection
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from ..errors import ConfigError
from ..types import WorkFrame
from .keyframe_graph import Keyframe, KeyframeGraph

Array = NDArray[Any]


def thumbnail(gray: Array) -> Array:
    """A place descriptor without weights: 24 x 18 blurred picture, zero mean, unit norm, (432,) float32."""
    small = cv2.GaussianBlur(cv2.resize(gray, (24, 18), interpolation=cv2.INTER_AREA).astype(np.float32), (0, 0), 1.0)
    small -= small.mean()
    return (small / max(float(np.linalg.norm(small)), 1e-6)).reshape(-1)


class PlaceRecognition:
    """Place recognition: keyframes whose descriptors are most alike. Nothing is believed before it is verified.

    ``describe`` gives a frame's descriptor, (c,) of unit norm: a thumbnail, or what a network has of it.
    """

    def __init__(self, describe: Callable[[WorkFrame], Array]) -> None:
        self._describe = describe
        self._known: dict[int, tuple[int, Array]] = {}  # keyframe: (frame, descriptor)

    def best(
        self,
        graph: KeyframeGraph,
        seen: WorkFrame,
        among: Collection[int],
        count: int = 3,
        min_similarity: float = -1.0,
    ) -> list[Keyframe]:
        """Up to ``count`` keyframes of ``among`` that look most like ``seen``, best first."""
        if not among:
            return []
        for k in among:
            work = graph.keyframes[k].work
            if k not in self._known or self._known[k][0] != work.index:
                self._known[k] = (work.index, self._describe(work))
        ids = sorted(among)
        similarity = np.stack([self._known[k][1] for k in ids]) @ self._describe(seen)
        first = np.argsort(-similarity, kind="stable")[:count]
        return [graph.keyframes[ids[n]] for n in first if similarity[n] >= min_similarity]


def build_thumbnail(provider: Any) -> Callable[[WorkFrame], Array]:
    """Descriptors that need nothing but the grey image."""
    return lambda work: thumbnail(work.gray)


def build_of_provider(provider: Any) -> Callable[[WorkFrame], Array]:
    """The descriptor that the pointmap network has of a frame. Raises ConfigError for a provider without one."""
    describe: Callable[[WorkFrame], Array] | None = getattr(provider, "place_descriptor", None)
    if describe is None:
        raise ConfigError(f"places: expected pointmaps that describe places, got {provider.name}; use thumbnail")
    return describe
