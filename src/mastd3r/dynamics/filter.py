"""P(moving) of every pixel, carried through the video: priors before a pose is known, posteriors after (III-A)."""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..concurrency import Worker
from .appearance import AppearanceClassifier
from .config import DynamicsConfig
from .data import DynamicMask, DynamicsInput, check_image, check_input
from .depth import depth_log_ratio
from .flow import HalfFlow
from .fusion import accumulated, alike, carried_along, kept_share, resized, shown_mask, with_depth
from .motion import Information, texture_information
from .motion_test import MotionTest, Past
from .people import believed
from .photometric import photo_variance
from .refinement import EdgeRefinement, sigmoid

Array = NDArray[Any]


@dataclass(frozen=True)
class _Arrival:
    """A frame whose pose is not known yet, at half size."""

    gray: Array  # (h, w) uint8
    texture: Information
    carried: Array  # (h, w) float32 log-odds of the last frame, along the flow
    appearance: Array | None  # (h', w') float32 log-odds of the classifier


@dataclass(frozen=True)
class FilterMemory:
    """What the filter carries from frame to frame."""

    past: tuple[Past, ...]
    log_odds: Array | None
    arrival: _Arrival | None
    appearance: AppearanceClassifier


class LogOddsFilter:
    """The log-odds filter, the one owner of the mask's memory. Deterministic; frames come in order, of one size."""

    def __init__(self, config: DynamicsConfig, width: int, height: int) -> None:
        """``width``, ``height``: the working size of every image that comes later."""
        self.config = config = config.while_tracking()
        self.refinement = EdgeRefinement(config, width, height)
        self.appearance = AppearanceClassifier(config)
        w, h = self.refinement.w, self.refinement.h
        self._nothing = np.zeros((h, w), np.float32)
        self._flow = HalfFlow(w, h)
        self._test = MotionTest(config, self._flow, w, h)
        self._past: deque[Past] = deque(maxlen=max(config.temporal.filter_gaps, default=1))
        self._log_odds: Array | None = None  # of the evidence at half size, without the semantic prior
        self._arrival: _Arrival | None = None
        self._worker = Worker("depth")

    def prior(self, gray: Array, semantic: Array | None = None, features: Array | None = None) -> Array:
        """P(moving) (h, w) float32 before the pose is known, the prior of (2): the last posterior along the flow,
        semantics, appearance.

        ``features`` (h', w', c) are descriptors of any kind for the appearance classifier. Raises InputError for an
        image of another size.
        """
        refinement = self.refinement
        check_image(gray, "gray", refinement.width, refinement.height)
        arrival = self._arrive(gray, features)
        log_odds = arrival.carried
        if arrival.appearance is not None:
            log_odds = log_odds + self.config.appearance.share * resized(arrival.appearance, log_odds.shape)
        share = self.config.semantic.share_beside(semantic)
        semantic = believed(semantic, arrival.carried, self.config.semantic)
        return sigmoid(share * refinement.full(log_odds) + refinement.semantic_log_odds(semantic))

    def update(self, frame: DynamicsInput) -> DynamicMask:
        """P(moving) once the frame's pose is known, (2) in log-odds, which move on to this frame. Raises InputError."""
        check_input(frame, self.refinement.width, self.refinement.height)
        arrival = self._arrive(frame.gray, frame.features)
        fresh, carried, evidence = self._evidence(frame, arrival)
        log_odds = accumulated(carried, fresh, alike(arrival.appearance, fresh.shape), self.config)
        if self.config.appearance.enabled and frame.features is not None:
            self.appearance.learn(frame.features, log_odds)
        mask = shown_mask(self.refinement, log_odds, frame, arrival.appearance, evidence)
        self._past.append(Past(arrival.gray, frame.world_from_cam.copy(), self.refinement.shrink(mask.probability)))
        self._log_odds, self._arrival = log_odds, None
        return mask

    def memory(self) -> FilterMemory:
        """What is carried on to the next frame; nothing is copied."""
        return FilterMemory(tuple(self._past), self._log_odds, self._arrival, self.appearance)

    def remember(self, memory: FilterMemory) -> None:
        """Go on from what ``memory`` gave."""
        self._past.extend(memory.past)
        self._log_odds, self._arrival, self.appearance = memory.log_odds, memory.arrival, memory.appearance

    def _evidence(self, frame: DynamicsInput, arrival: _Arrival) -> tuple[Array, Array, dict[str, Array]]:
        """(log ratios of this frame alone, log-odds carried over, every term by name), half size."""
        fresh, carried = self._nothing, arrival.carried
        terms: dict[str, Array] = {}
        depth = None
        if self.config.depth.enabled and frame.own_inv_depth is not None:
            depth = self._worker.submit(lambda: self.refinement.shrink(depth_log_ratio(frame, self.config)))
        gaps = sorted({min(g, len(self._past)) for g in self.config.temporal.filter_gaps} - {0})
        if self.config.motion.enabled and gaps:
            static = 1 - sigmoid(carried)
            now = self._test.present(frame, arrival.gray, arrival.texture)
            found = self._test.compare([(now, static, self._past[-g]) for g in gaps])
            terms["motion"] = fresh = sum((c.log_ratio for c in found), fresh)
            if gaps[0] == 1:  # a better flow than the one prior() had
                carried = self._carry(arrival.gray, found[0].flow, arrival.texture)
        if depth is not None:
            terms["depth"] = depth.get()
            fresh = with_depth(fresh, terms["depth"])
        terms["time"] = carried
        return fresh, carried, terms

    def _arrive(self, gray: Array, features: Array | None) -> _Arrival:
        small = self.refinement.shrink(gray)
        if self._arrival is None or not np.array_equal(self._arrival.gray, small):
            carried = self._nothing
            if self._past and self.config.temporal.enabled:
                carried = self._carry(small, self._flow.quick(small, self._past[-1].gray), None)
            texture = texture_information(small, 7, self.config.motion.texture_noise)
            appearance = None
            if features is not None and self.config.appearance.enabled:
                appearance = self.appearance.log_odds(features)
            self._arrival = _Arrival(small, texture, carried, appearance)
        return self._arrival

    def _carry(self, small: Array, to_last: Array, texture: Information | None) -> Array:
        """Last log-odds along the flow, forgetting; with texture, also faded where grey values belie the flow."""
        if self._log_odds is None or not self.config.temporal.enabled:
            return self._nothing
        kept = None
        if texture is not None:
            kept = kept_share(self.config, small, self._past[-1].gray, to_last, photo_variance(texture, self.config))
        return carried_along(self._log_odds, to_last, kept, self.config.temporal.memory)
