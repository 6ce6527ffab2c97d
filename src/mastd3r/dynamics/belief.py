"""P(moving) of every pixel, carried through the video: priors before a pose is known, posteriors after (III-A)."""

from __future__ import annotations

from collections import deque
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from ..errors import InputError
from . import paper
from .compare import MotionTest, Past
from .config import DynamicsConfig
from .data import DynamicMask, DynamicsInput
from .depth import depth_log_ratio
from .flow import HalfFlow
from .motion import Information, texture_information
from .photo import mismatch, photo_variance
from .regions import guided_coefficients, region_mean

Array = NDArray[Any]


@dataclass(frozen=True)
class _Arrival:
    """A frame whose pose is not known yet, at half size."""

    gray: Array  # (h, w) uint8
    texture: Information
    carried: Array  # (h, w) float32 log-odds of the last belief, along the flow


class DynamicBelief:
    """The one owner of the mask's memory. Deterministic; frames come in order and are of one size."""

    def __init__(self, config: DynamicsConfig, width: int, height: int) -> None:
        """``width``, ``height``: the working size of every image given later."""
        self.config, self.width, self.height = config, width, height
        self._w, self._h = (width + 1) // 2, (height + 1) // 2
        self._flow = HalfFlow(self._w, self._h)
        self._test = MotionTest(config, self._flow, self._w, self._h)
        self._past: deque[Past] = deque(maxlen=max(config.gaps, default=1))
        self._belief: Array | None = None  # log-odds of the evidence at half size, without the semantic prior
        self._arrival: _Arrival | None = None
        self._beside = ThreadPoolExecutor(1, "depth")

    def prior(self, gray: Array, semantic: Array | None = None) -> Array:
        """P(moving) (h, w) float32 before the pose is known: the last posterior along the flow, and the semantics.

        Raises InputError for an image of another size.
        """
        self._check(gray, "gray")
        if self.config.variant == "none":
            return np.zeros((self.height, self.width), np.float32)
        if self.config.variant == "paper":
            return _sigmoid(self._semantic_log_odds(semantic))
        carried = self._arrive(gray).carried
        share = 1.0 if semantic is None else self.config.semantic_share
        return _sigmoid(share * self._full(carried) + self._semantic_log_odds(semantic))

    def update(self, given: DynamicsInput) -> DynamicMask:
        """P(moving) once the frame's pose is known; the belief moves on to this frame. Raises InputError."""
        for name in ("gray", "inv_depth", "inv_depth_sigma", "own_inv_depth"):
            if getattr(given, name) is not None:
                self._check(getattr(given, name), name)
        if self.config.variant == "none":
            nothing = np.zeros((self.height, self.width), np.float32)
            return DynamicMask(nothing, nothing > 0.5, {})
        if self.config.variant == "paper":
            return self._paper(given)
        arrival = self._arrive(given.gray)
        fresh, carried, evidence = self._evidence(given, arrival)
        limit = self.config.max_log_odds
        belief = np.clip(carried + self.config.evidence_gain * fresh, -limit, limit).astype(np.float32)
        semantic = self._semantic_log_odds(given.semantic)
        shown = self._regions(belief, arrival.gray, given, evidence.get("depth"))
        if given.semantic is not None and self.config.use_semantic:
            evidence["semantic"] = semantic
            shown = self.config.semantic_share * shown
        probability = _sigmoid(shown + semantic)
        self._past.append(Past(arrival.gray, given.world_from_cam.copy(), self._shrink(probability)))
        self._belief, self._arrival = belief, None
        return DynamicMask(probability, probability > 0.5, evidence)

    def _evidence(self, given: DynamicsInput, arrival: _Arrival) -> tuple[Array, Array, dict[str, Array]]:
        """(log ratios of this frame alone, log-odds carried over, every term by name), half size."""
        fresh = np.zeros((self._h, self._w), np.float32)
        carried = arrival.carried
        terms: dict[str, Array] = {}
        depth = None
        if self.config.use_depth and given.own_inv_depth is not None:
            depth = self._beside.submit(lambda: self._shrink(depth_log_ratio(given, self.config)))
        gaps = sorted({min(g, len(self._past)) for g in self.config.gaps} - {0})
        if self.config.use_motion and gaps:
            static = 1 - _sigmoid(carried)
            found = self._test.compare(given, arrival.gray, arrival.texture, static, [self._past[-g] for g in gaps])
            terms["motion"] = fresh = sum((c.log_ratio for c in found), fresh)
            if gaps[0] == 1:
                carried = self._carry(
                    arrival.gray, found[0].flow, arrival.texture
                )  # a better flow than the one prior() had
        if depth is not None:
            terms["depth"] = depth.result()
            # a thing where the map has nothing is no part of the map, also while it stands still
            doubt = np.clip(1 - terms["depth"], 0, 1)
            fresh = np.maximum(fresh, 0) + doubt * np.minimum(fresh, 0) + terms["depth"]
        terms["time"] = carried
        return fresh, carried, terms

    def _arrive(self, gray: Array) -> _Arrival:
        small = self._shrink(gray)
        if self._arrival is None or not np.array_equal(self._arrival.gray, small):
            carried = np.zeros((self._h, self._w), np.float32)
            if self._past and self.config.use_time:
                carried = self._carry(small, self._flow.quick(small, self._past[-1].gray), None)
            texture = texture_information(small, 7, self.config.texture_noise)
            self._arrival = _Arrival(small, texture, carried)
        return self._arrival

    def _carry(self, small: Array, to_last: Array, texture: Information | None) -> Array:
        """Last belief along the flow, forgetting; with texture, also faded where grey values belie the flow."""
        if self._belief is None or not self.config.use_time:
            return np.zeros((self._h, self._w), np.float32)
        carried = self.config.memory * self._flow.pull(self._belief, to_last)
        if texture is None:
            return carried
        seen = self._flow.pull(self._past[-1].gray.astype(np.float32), to_last, -100.0)
        noise = photo_variance(texture, self.config)
        beyond = mismatch(small.astype(np.float32), seen, noise) - self.config.carry_mismatch
        return carried * np.exp(-0.5 * np.maximum(beyond, 0))

    def _regions(self, belief: Array, small: Array, given: DynamicsInput, sharp: Array | None) -> Array:
        """Belief as whole objects, at full size: pooled inside edges, then brought to the full image's edges.

        Flow bleeds over outlines, a measured depth (log ratio ``sharp``) does not: where it speaks nothing is pooled.
        """
        if not self.config.use_regions:
            return self._full(belief)
        c = self.config
        guide = small.astype(np.float32)
        edges = guide
        if given.semantic is not None and c.use_semantic:
            edges = cv2.merge([guide, (c.semantic_contrast * self._shrink(given.semantic)).astype(np.float32)])
        weight = 0.05 + np.minimum(np.abs(belief), 3.0) / 3
        pooled = region_mean(edges, belief, weight, c.region_px, c.region_contrast)
        a, b = guided_coefficients(guide, pooled, np.ones_like(pooled), c.edge_px, c.edge_contrast)
        full = self._full(a) * given.gray + self._full(b)
        if sharp is not None:
            alone = self._full(np.minimum(np.abs(sharp) / 2, 1))
            full = alone * self._full(belief) + (1 - alone) * full
        return np.clip(full, -c.max_log_odds, c.max_log_odds).astype(np.float32)

    def _semantic_log_odds(self, semantic: Array | None) -> Array:
        """Log-odds of P(D|S), (h, w) float32; the base rate's where there is no map."""
        if semantic is None or not self.config.use_semantic:
            base = np.log(self.config.base_rate) - np.log1p(-self.config.base_rate)
            return np.full((self.height, self.width), base, np.float32)
        self._check(semantic, "semantic")
        floor = self.config.semantic_floor
        p = np.clip(semantic, floor, 1 - floor).astype(np.float32)
        return (self.config.semantic_gain * np.log(p / (1 - p))).astype(np.float32)

    def _paper(self, given: DynamicsInput) -> DynamicMask:
        """Eq. (1)-(4). Z is the frame's own depth, or the background's where the provider has no own depth."""
        inv = given.inv_depth if given.own_inv_depth is None else given.own_inv_depth
        depth = np.where(inv > 0, 1 / np.maximum(inv, 1e-9), 0.0)
        c = self.config
        anomaly = paper.depth_anomaly(depth, c.window_px, c.tau_variance, c.tau_sigma)
        moving, static = paper.depth_likelihoods(depth)
        prior = _sigmoid(self._semantic_log_odds(given.semantic)).astype(np.float64)
        log_odds = paper.posterior_log_odds(prior, moving, static)
        mask = paper.coarse_mask(paper.moving_mask(log_odds, c.tau_bayes), anomaly)
        posterior = _sigmoid(log_odds)
        probability = np.where(anomaly, posterior, np.minimum(posterior, c.base_rate)).astype(np.float32)
        ratio = np.log(moving / static).astype(np.float32)
        return DynamicMask(probability, mask, {"depth": ratio, "anomaly": anomaly.astype(np.float32)})

    def _shrink(self, image: Array) -> Array:
        return cv2.resize(image, (self._w, self._h), interpolation=cv2.INTER_AREA)

    def _full(self, image: Array) -> Array:
        return cv2.resize(image, (self.width, self.height), interpolation=cv2.INTER_LINEAR)

    def _check(self, image: Array, name: str) -> None:
        if image.shape != (self.height, self.width):
            raise InputError(f"dynamics: expected {name} of {self.width}x{self.height}, got shape {image.shape}")


def _sigmoid(log_odds: Array) -> Array:
    return (1 / (1 + np.exp(-log_odds))).astype(np.float32)
