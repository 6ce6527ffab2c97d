"""From a belief at half the working size to P(moving) of whole objects at full size."""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from ..errors import InputError
from .config import DynamicsConfig
from .data import DynamicsInput
from .regions import guided_coefficients, region_mean

Array = NDArray[Any]


class EdgeRefinement:
    """Sizes, and what brings a belief to the image's edges. No memory."""

    def __init__(self, config: DynamicsConfig, width: int, height: int) -> None:
        self.config, self.width, self.height = config, width, height
        self.w, self.h = (width + 1) // 2, (height + 1) // 2

    def probability(self, belief: Array, given: DynamicsInput, looks: Array | None, sharp: Array | None) -> Array:
        """P(moving) (h, w) float32 of a belief (log-odds, half size), the looks of the moving and the semantics."""
        c, semantic = self.config, given.semantic
        if looks is not None:
            reach = cv2.resize(looks, (self.w, self.h), interpolation=cv2.INTER_LINEAR)
            belief = belief + c.head_share * reach
            belief = np.clip(belief, -c.max_log_odds, c.max_log_odds)
        shown = self.regions(belief, given, sharp)
        if semantic is not None and c.use_semantic:
            shown = c.semantic_share * shown + self.semantic_log_odds(semantic)
            return sigmoid(self._fine(shown, given, c.map_contrast) if c.use_regions else shown)
        return sigmoid(shown + self.semantic_log_odds(semantic))

    def regions(self, belief: Array, given: DynamicsInput, sharp: Array | None) -> Array:
        """Belief as whole objects, at full size: pooled inside edges, then brought to the full image's edges.

        Flow bleeds over outlines, a measured depth (log ratio ``sharp``) does not: where it speaks nothing is pooled.
        """
        if not self.config.use_regions:
            return self.full(belief)
        c, semantic = self.config, given.semantic
        guide = self.shrink(given.gray).astype(np.float32)
        layers = [guide, *_chroma(given.color, (self.w, self.h), c.chroma_gain)]
        if semantic is not None and c.use_semantic:
            layers.append((c.semantic_contrast * self.shrink(semantic)).astype(np.float32))
        edges = cv2.merge(layers) if len(layers) > 1 else guide
        weight = 0.05 + np.minimum(np.abs(belief), 3.0) / 3
        pooled = region_mean(edges, belief, weight, c.region_px, c.region_contrast)
        a, b = guided_coefficients(guide, pooled, np.ones_like(pooled), c.edge_px, c.edge_contrast)
        full = self.full(a) * given.gray + self.full(b)
        full = self._fine(full, given, c.fine_contrast)
        if sharp is not None:
            alone = self.full(np.minimum(np.abs(sharp) / 2, 1))
            full = alone * self.full(belief) + (1 - alone) * full
        return np.clip(full, -c.max_log_odds, c.max_log_odds).astype(np.float32)

    def _fine(self, full: Array, given: DynamicsInput, contrast: float) -> Array:
        """Log-odds (h, w) brought to the photograph's own edges of colour; as they are where there is no colour."""
        if given.color is None:
            return full
        c, size = self.config, (self.width, self.height)
        fine = cv2.merge([given.gray.astype(np.float32), *_chroma(given.color, size, c.chroma_gain)])
        return region_mean(fine, full, np.ones_like(full), c.fine_px, contrast)

    def semantic_log_odds(self, semantic: Array | None) -> Array:
        """Log-odds of P(D|S), (h, w) float32; the base rate's where there is no map."""
        if semantic is None or not self.config.use_semantic:
            base = np.log(self.config.base_rate) - np.log1p(-self.config.base_rate)
            return np.full((self.height, self.width), base, np.float32)
        self.check(semantic, "semantic")
        floor, missed = self.config.semantic_floor, self.config.semantic_missed
        least: Array | float = floor
        if missed > floor:
            seen = self._near(semantic)
            least = seen * np.float32(floor) + (1 - seen) * np.float32(missed)
        p = np.clip(semantic, least, 1 - floor).astype(np.float32)
        return (self.config.semantic_gain * np.log(p / (1 - p))).astype(np.float32)

    def _near(self, semantic: Array) -> Array:
        """(h, w) float32 the surest that the map is of anything within ``semantic_reach``, smoothly."""
        reach = max(1, round(self.config.semantic_reach * self.width / 4))
        small = cv2.resize(semantic, (self.w // 2, self.h // 2), interpolation=cv2.INTER_AREA).astype(np.float32)
        most = cv2.dilate(small, np.ones((2 * reach + 1, 2 * reach + 1), np.uint8))
        near: Array = cv2.resize(
            cv2.blur(most, (reach, reach)), (self.width, self.height), interpolation=cv2.INTER_LINEAR
        )
        return near

    def shrink(self, image: Array) -> Array:
        """A full-size image at half size."""
        return cv2.resize(image, (self.w, self.h), interpolation=cv2.INTER_AREA)

    def full(self, image: Array) -> Array:
        """A half-size image at full size."""
        return cv2.resize(image, (self.width, self.height), interpolation=cv2.INTER_LINEAR)

    def check(self, image: Array, name: str) -> None:
        """Raises InputError for an image of another size."""
        if image.shape != (self.height, self.width):
            raise InputError(f"dynamics: expected {name} of {self.width}x{self.height}, got shape {image.shape}")


def _chroma(color: Array | None, size: tuple[int, int], gain: float) -> list[Array]:
    """The two colour differences of CIE Lab, in grey levels' worth, each (h, w) float32; none without colour."""
    if color is None:
        return []
    small = color if (color.shape[1], color.shape[0]) == size else cv2.resize(color, size, interpolation=cv2.INTER_AREA)
    lab = cv2.cvtColor(small, cv2.COLOR_RGB2LAB)
    return [gain * lab[..., n].astype(np.float32) for n in (1, 2)]


def sigmoid(log_odds: Array) -> Array:
    """Probability of log-odds, float32."""
    return (1 / (1 + np.exp(-log_odds))).astype(np.float32)
