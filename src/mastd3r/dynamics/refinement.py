"""Edge-aware refinement: from log-odds at half the working size to P(moving) of whole objects at full size."""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from .colours import by_colours
from .config import DynamicsConfig
from .data import DynamicsInput, check_image
from .regions import Layer, guided_coefficients, region_mean

Array = NDArray[Any]
USUAL_SIZE = 512 * 384  # working pixels that the guided filter's radius is said for


class EdgeRefinement:
    """Sizes, and what brings log-odds to the image's edges. No memory."""

    def __init__(self, config: DynamicsConfig, width: int, height: int) -> None:
        self.config, self.width, self.height = config, width, height
        self.w, self.h = (width + 1) // 2, (height + 1) // 2
        self._edge_px = max(1, round(float(config.refinement.edge_px * np.sqrt(width * height / USUAL_SIZE))))

    def probability(
        self, log_odds: Array, frame: DynamicsInput, appearance: Array | None, sharp: Array | None
    ) -> Array:
        """P(moving) (h, w) float32 of log-odds (half size), those of the appearance classifier, and the semantics.

        ``sharp``: see ``regions``.
        """
        c, semantic = self.config, frame.semantic
        if appearance is not None:
            alike = cv2.resize(appearance, (self.w, self.h), interpolation=cv2.INTER_LINEAR)
            log_odds = log_odds + c.appearance.share * alike
            log_odds = np.clip(log_odds, -c.max_log_odds, c.max_log_odds)
        shown = self.regions(log_odds, frame, sharp)
        joined = c.semantic.outlines(semantic)
        shown = c.semantic.share_beside(semantic) * shown + self.semantic_log_odds(semantic)
        if joined and c.refinement.enabled:
            shown = self._fine(shown, frame, c.refinement.fine_contrast_semantic)
        if c.refinement.enabled and c.colours.enabled and frame.color is not None:
            shown = by_colours(shown, frame.color, c.colours, self._inside_edges, joined)
        return sigmoid(shown)

    def regions(self, log_odds: Array, frame: DynamicsInput, sharp: Array | None) -> Array:
        """Log-odds as whole objects, at full size: pooled inside edges, then brought to the full image's edges.

        Flow bleeds over edges, a measured depth (log ratio ``sharp``) does not: where it speaks nothing is pooled.
        """
        if not self.config.refinement.enabled:
            return self.full(log_odds)
        c, semantic, limit = self.config.refinement, frame.semantic, self.config.max_log_odds
        guide = self.shrink(frame.gray).astype(np.float32)
        edges: list[Layer] = [(guide, 1.0), *_chroma(frame.color, (self.w, self.h), c.chroma_gain)]
        if semantic is not None and self.config.semantic.enabled:
            edges.append((self.shrink(semantic).astype(np.float32), c.semantic_contrast))
        weight = 0.05 + np.minimum(np.abs(log_odds), 3.0) / 3
        pooled = region_mean(edges, log_odds, weight, c.region_px, c.region_contrast)
        a, b = guided_coefficients(guide, pooled, self._edge_px, c.edge_contrast)
        full = self.full(a) * frame.gray + self.full(b)
        full = self._fine(full, frame, c.fine_contrast)
        if sharp is not None:
            alone = self.full(np.minimum(np.abs(sharp) / 2, 1))
            full = alone * self.full(log_odds) + (1 - alone) * full
        return np.clip(full, -limit, limit).astype(np.float32)

    def _fine(self, full: Array, frame: DynamicsInput, contrast: float) -> Array:
        """Log-odds (h, w) brought to the photograph's own edges of colour; as they are where there is no colour.

        And where the colours themselves are asked at the end, which pools them as well.
        """
        if frame.color is None or self.config.colours.enabled:
            return full
        c, size = self.config.refinement, (self.width, self.height)
        fine = [(frame.gray, 1.0), *_chroma(frame.color, size, c.chroma_gain)]
        return region_mean(fine, full, None, c.fine_px, contrast)

    def _inside_edges(self, log_odds: Array, lab: Array, scale: float) -> Array:
        """Log-odds (h, w) at ``scale`` times full size, pooled inside the edges of their colours (h, w, 3) in Lab."""
        c = self.config.refinement
        layers = [(cv2.extractChannel(lab, n), gain) for n, gain in enumerate((1.0, c.chroma_gain, c.chroma_gain))]
        return region_mean(layers, log_odds.astype(np.float32), None, scale * c.fine_px, c.fine_contrast)

    def semantic_log_odds(self, semantic: Array | None) -> Array:
        """Log-odds of P(D|S), (h, w) float32; the base rate's where there is no map."""
        if semantic is None or not self.config.semantic.enabled:
            base = np.log(self.config.base_rate) - np.log1p(-self.config.base_rate)
            return np.full((self.height, self.width), base, np.float32)
        check_image(semantic, "semantic", self.width, self.height)
        if not self.config.semantic.shows_all:
            p = np.clip(semantic, self.config.base_rate, self.config.semantic.most_partial).astype(np.float32)
            return np.log(p / (1 - p)).astype(np.float32)
        floor, missed = self.config.semantic.floor, self.config.semantic.missed
        least: Array | float = floor
        if missed > floor:
            near = self._near(semantic)
            least = near * np.float32(floor) + (1 - near) * np.float32(missed)
        p = np.clip(semantic, least, 1 - floor).astype(np.float32)
        return (self.config.semantic.gain * np.log(p / (1 - p))).astype(np.float32)

    def _near(self, semantic: Array) -> Array:
        """(h, w) float32 the surest that the map is of anything within ``semantic.reach_ratio``, smoothly."""
        reach = max(1, round(self.config.semantic.reach_ratio * self.width / 4))
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


def _chroma(color: Array | None, size: tuple[int, int], gain: float) -> list[Layer]:
    """The two colour differences of CIE Lab, (h, w) uint8, and what they count; none without colour."""
    if color is None:
        return []
    small = color if (color.shape[1], color.shape[0]) == size else cv2.resize(color, size, interpolation=cv2.INTER_AREA)
    lab = cv2.cvtColor(small, cv2.COLOR_RGB2LAB)
    return [(cv2.extractChannel(lab, n), gain) for n in (1, 2)]


def sigmoid(log_odds: Array) -> Array:
    """Probability of log-odds, float32."""
    return (1 / (1 + np.exp(-log_odds))).astype(np.float32)
