"""P(moving) of every pixel, carried through the video: priors before a pose is known, posteriors after (III-A)."""

from __future__ import annotations

from collections import deque
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from . import paper
from .appearance import AppearanceClassifier
from .config import DynamicsConfig
from .data import DynamicMask, DynamicsInput
from .depth import depth_log_ratio
from .flow import HalfFlow
from .motion import Information, texture_information
from .motion_test import MotionTest, Past
from .photometric import mismatch, photo_variance
from .refinement import EdgeRefinement, sigmoid

Array = NDArray[Any]
HELD_LOG_ODDS = 2.0  # of belief and of looks, from which a thing that stops is held to be the same


@dataclass(frozen=True)
class _Arrival:
    """A frame whose pose is not known yet, at half size."""

    gray: Array  # (h, w) uint8
    texture: Information
    carried: Array  # (h, w) float32 log-odds of the last belief, along the flow
    looks: Array | None  # (h', w') float32 log-odds of the head


class LogOddsFilter:
    """The one owner of the mask's memory. Deterministic; frames come in order and are of one size."""

    def __init__(self, config: DynamicsConfig, width: int, height: int) -> None:
        """``width``, ``height``: the working size of every image given later."""
        # a pose needs every static point that there is: here a map is believed where it shows nothing
        self.config = config = replace(config, semantic_missed=config.semantic_floor)
        self.outline = EdgeRefinement(config, width, height)
        self.head = AppearanceClassifier(config)
        w, h = self.outline.w, self.outline.h
        self._nothing = np.zeros((h, w), np.float32)
        self._flow = HalfFlow(w, h)
        self._test = MotionTest(config, self._flow, w, h)
        self._past: deque[Past] = deque(maxlen=max(config.gaps, default=1))
        self._belief: Array | None = None  # log-odds of the evidence at half size, without the semantic prior
        self._arrival: _Arrival | None = None
        self._beside = ThreadPoolExecutor(1, "depth")

    def prior(self, gray: Array, semantic: Array | None = None, features: Array | None = None) -> Array:
        """P(moving) (h, w) float32 before the pose is known: the last posterior along the flow, semantics, looks.

        ``features`` (h', w', c) are descriptors of any kind for the head. Raises InputError for an image of another
        size.
        """
        outline = self.outline
        outline.check(gray, "gray")
        if self.config.variant == "none":
            return np.zeros((outline.height, outline.width), np.float32)
        if self.config.variant == "paper":
            return sigmoid(outline.semantic_log_odds(semantic))
        arrival = self._arrive(gray, features)
        belief = arrival.carried
        if arrival.looks is not None:
            belief = belief + self.config.head_share * _resized(arrival.looks, belief)
        share = 1.0 if semantic is None else self.config.semantic_share
        return sigmoid(share * outline.full(belief) + outline.semantic_log_odds(semantic))

    def update(self, given: DynamicsInput) -> DynamicMask:
        """P(moving) once the frame's pose is known; the belief moves on to this frame. Raises InputError."""
        check_input(self.outline, given)
        if self.config.variant != "ours":
            return without_motion(self.config, self.outline, given)
        arrival = self._arrive(given.gray, given.features)
        fresh, carried, evidence = self._evidence(given, arrival)
        limit = self.config.max_log_odds
        carried, fresh = held(carried, fresh, arrival.looks, self.config)
        belief = np.clip(carried + self.config.evidence_gain * fresh, -limit, limit).astype(np.float32)
        if self.config.use_head and given.features is not None:
            self.head.learn(given.features, belief)
        mask = shown_mask(self.outline, belief, given, arrival.looks, evidence)
        self._past.append(Past(arrival.gray, given.world_from_cam.copy(), self.outline.shrink(mask.probability)))
        self._belief, self._arrival = belief, None
        return mask

    def _evidence(self, given: DynamicsInput, arrival: _Arrival) -> tuple[Array, Array, dict[str, Array]]:
        """(log ratios of this frame alone, log-odds carried over, every term by name), half size."""
        fresh, carried = self._nothing, arrival.carried
        terms: dict[str, Array] = {}
        depth = None
        if self.config.use_depth and given.own_inv_depth is not None:
            depth = self._beside.submit(lambda: self.outline.shrink(depth_log_ratio(given, self.config)))
        gaps = sorted({min(g, len(self._past)) for g in self.config.gaps} - {0})
        if self.config.use_motion and gaps:
            static = 1 - sigmoid(carried)
            now = self._test.present(given, arrival.gray, arrival.texture)
            found = self._test.compare([(now, static, self._past[-g]) for g in gaps])
            terms["motion"] = fresh = sum((c.log_ratio for c in found), fresh)
            if gaps[0] == 1:  # a better flow than the one prior() had
                carried = self._carry(arrival.gray, found[0].flow, arrival.texture)
        if depth is not None:
            terms["depth"] = depth.result()
            fresh = with_depth(fresh, terms["depth"])
        terms["time"] = carried
        return fresh, carried, terms

    def _arrive(self, gray: Array, features: Array | None) -> _Arrival:
        small = self.outline.shrink(gray)
        if self._arrival is None or not np.array_equal(self._arrival.gray, small):
            carried = self._nothing
            if self._past and self.config.use_time:
                carried = self._carry(small, self._flow.quick(small, self._past[-1].gray), None)
            texture = texture_information(small, 7, self.config.texture_noise)
            looks = self.head.log_odds(features) if features is not None and self.config.use_head else None
            self._arrival = _Arrival(small, texture, carried, looks)
        return self._arrival

    def _carry(self, small: Array, to_last: Array, texture: Information | None) -> Array:
        """Last belief along the flow, forgetting; with texture, also faded where grey values belie the flow."""
        if self._belief is None or not self.config.use_time:
            return self._nothing
        carried = self.config.memory * self._flow.pull(self._belief, to_last)
        if texture is None:
            return carried
        return carried * kept_share(self.config, self._flow, small, self._past[-1].gray, to_last, texture)


def kept_share(
    config: DynamicsConfig, flow: HalfFlow, small: Array, other: Array, to_other: Array, texture: Information
) -> Array:
    """(h, w) 1 where grey values agree with the flow small -> other, fading to 0 where they belie it."""
    seen = flow.pull(other.astype(np.float32), to_other, -100.0)
    beyond = mismatch(small.astype(np.float32), seen, photo_variance(texture, config)) - config.carry_mismatch
    share: Array = np.exp(-0.5 * np.maximum(beyond, 0))
    return share


def with_depth(fresh: Array, depth: Array) -> Array:
    """Motion and depth log ratios joined: a thing where the map has nothing is no part of it, also standing still."""
    doubt = np.clip(1 - depth, 0, 1)
    return np.maximum(fresh, 0) + doubt * np.minimum(fresh, 0) + depth


def held(carried: Array, fresh: Array, looks: Array | None, config: DynamicsConfig) -> tuple[Array, Array]:
    """(carried, fresh) where what was seen to move, and looks like what moves, is not refuted by standing still.

    Both must hold: a parked car of the same looks was never seen to move, and is judged by its own evidence.
    """
    if looks is None:
        return carried, fresh
    hold = np.clip(carried / HELD_LOG_ODDS, 0, 1) * np.clip(_resized(looks, carried) / HELD_LOG_ODDS - 0.5, 0, 1)
    unforgotten = carried * (1 + hold * np.float32(1 / config.memory - 1))
    return unforgotten, np.maximum(fresh, 0) + (1 - hold) * np.minimum(fresh, 0)


def check_input(outline: EdgeRefinement, given: DynamicsInput) -> None:
    """Raises InputError for images of another size."""
    for name in ("gray", "inv_depth", "inv_depth_sigma", "own_inv_depth"):
        if getattr(given, name) is not None:
            outline.check(getattr(given, name), name)


def shown_mask(
    outline: EdgeRefinement, belief: Array, given: DynamicsInput, looks: Array | None, terms: dict[str, Array]
) -> DynamicMask:
    """The mask of a belief (log-odds, half size), with the semantics and the looks that the frame has."""
    p = outline.probability(belief, given, looks, terms.get("depth"))
    if given.semantic is not None and outline.config.use_semantic:
        terms["semantic"] = outline.semantic_log_odds(given.semantic)
    if looks is not None:
        terms["looks"] = looks
    return DynamicMask(p, p > 0.5, terms)


def without_motion(config: DynamicsConfig, outline: EdgeRefinement, given: DynamicsInput) -> DynamicMask:
    """The variants ``none`` and ``paper``: eq. (1)-(4). Z is the frame's own depth, or the background's without one."""
    if config.variant == "none":
        nothing = np.zeros((outline.height, outline.width), np.float32)
        return DynamicMask(nothing, nothing > 0.5, {})
    inv = given.inv_depth if given.own_inv_depth is None else given.own_inv_depth
    depth = np.where(inv > 0, 1 / np.maximum(inv, 1e-9), 0.0)
    anomaly = paper.depth_anomaly(depth, config.window_px, config.tau_variance, config.tau_sigma)
    moving, static = paper.depth_likelihoods(depth)
    prior = sigmoid(outline.semantic_log_odds(given.semantic)).astype(np.float64)
    log_odds = paper.posterior_log_odds(prior, moving, static)
    mask = paper.coarse_mask(paper.moving_mask(log_odds, config.tau_bayes), anomaly)
    posterior = sigmoid(log_odds)
    probability = np.where(anomaly, posterior, np.minimum(posterior, config.base_rate)).astype(np.float32)
    ratio = np.log(moving / static).astype(np.float32)
    return DynamicMask(probability, mask, {"depth": ratio, "anomaly": anomaly.astype(np.float32)})


def _resized(values: Array, like: Array) -> Array:
    return cv2.resize(values, (like.shape[1], like.shape[0]), interpolation=cv2.INTER_LINEAR)
