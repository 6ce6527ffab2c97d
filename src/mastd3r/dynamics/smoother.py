"""P(moving) with all poses known: every frame is compared with frames before and after, and beliefs flow both ways."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from .appearance import AppearanceClassifier
from .config import DynamicsConfig
from .data import DynamicMask, DynamicsInput
from .depth import depth_log_ratio
from .depth_support import floating_log_ratio
from .filter import check_input, held, kept_share, shown_mask, with_depth, without_motion
from .flow import HalfFlow
from .motion import Information, texture_information
from .motion_test import MotionTest, Past, Present
from .refinement import EdgeRefinement, sigmoid

Array = NDArray[Any]


@dataclass
class _Seen:
    """A frame in the window, at half size."""

    given: DynamicsInput
    past: Past  # with the belief of what came before it
    present: Present | None  # None without the motion term
    texture: Information
    motion: Array  # (h, w) log ratios so far
    depth: Array | None  # (h, w) log ratio of its own depth
    looks: Array | None  # (h', w') log-odds of the head
    floating: Array | None = None  # (h, w) log ratio of a depth that nothing holds
    flow: dict[int, Array] = field(default_factory=dict)  # -1: to the frame before, 1: to the frame after
    kept: dict[int, Array] = field(default_factory=dict)  # share of a belief that survives that way

    def fresh(self) -> Array:
        """Log ratios of this frame's own comparisons."""
        fresh = self.motion if self.floating is None else with_depth(self.motion, self.floating)
        return fresh if self.depth is None else with_depth(fresh, self.depth)


class ForwardBackwardSmoother:
    """A window over the video, as long as the longest gap. Deterministic; frames come in order."""

    def __init__(
        self, config: DynamicsConfig, width: int, height: int, head: AppearanceClassifier | None = None
    ) -> None:
        """``head``: what the first pass learned of the video's moving things, if it did."""
        self.config, self.outline, self.head = config, EdgeRefinement(config, width, height), head
        w, h = self.outline.w, self.outline.h
        self._nothing = np.zeros((h, w), np.float32)
        self._flow = HalfFlow(w, h)
        self._test = MotionTest(config, self._flow, w, h)
        self._causal: Array = self._nothing  # belief of the newest frame, from those before it
        self._forward: Array | None = None  # belief of the frame given out last, from those before it
        self._window: deque[_Seen] = deque()

    def masks(self, inputs: Iterable[DynamicsInput]) -> Iterator[DynamicMask]:
        """One mask an input, in order, ``max(second_gaps)`` inputs later. Raises InputError."""
        if self.config.variant != "ours":
            for given in inputs:
                check_input(self.outline, given)
                yield without_motion(self.config, self.outline, given)
            return
        reach = max(self.config.second_gaps, default=1)
        for given in inputs:
            check_input(self.outline, given)
            self._add(given)
            if len(self._window) > reach:
                yield self._give_out()
        while self._window:
            yield self._give_out()

    def _add(self, given: DynamicsInput) -> None:
        """The newest frame against those before it, and those against the newest."""
        small = self.outline.shrink(given.gray)
        texture = texture_information(small, 7, self.config.texture_noise)
        depth = None
        if self.config.use_depth and given.own_inv_depth is not None:
            depth = self.outline.shrink(depth_log_ratio(given, self.config))
        looks = None
        if self.config.use_head and given.features is not None and self.head is not None:
            looks = self.head.log_odds(given.features)
        present = self._test.present(given, small, texture) if self.config.use_motion else None
        past = Past(small, given.world_from_cam, self._nothing)
        new = _Seen(given, past, present, texture, self._nothing, depth, looks)
        if self.config.use_support:
            new.floating = self.outline.shrink(floating_log_ratio(given, self.config))
        before = list(self._window)
        gaps = sorted({min(g, len(before)) for g in self.config.second_gaps} - {0})
        if before:
            new.flow[-1] = self._flow.quick(small, before[-1].past.gray)
            new.kept[-1] = self._kept(new, before[-1], new.flow[-1])
            carried = self._carried(self._causal, new, -1)
            static = 1 - sigmoid(carried)
            self._compare([(new, before[-gap], static, -gap) for gap in gaps])
        else:
            carried = self._nothing
        self._causal = self._added(carried, new)
        new.past = Past(small, given.world_from_cam, self._moving(new, self._causal))
        self._window.append(new)
        if self.config.use_future:
            earlier = [(before[-g], g) for g in gaps if g in self.config.second_gaps]
            self._compare([(one, new, 1 - one.past.moving, gap) for one, gap in earlier])

    def _compare(self, pairs: list[tuple[_Seen, _Seen, Array, int]]) -> None:
        """The motion term of each (frame, other frame, P(static) of the frame, frames between them)."""
        told = [(one.present, static, other.past) for one, other, static, _ in pairs if one.present is not None]
        for (one, other, _, gap), found in zip(pairs, self._test.compare(told), strict=False):
            one.motion = one.motion + found.log_ratio
            if abs(gap) == 1:
                one.flow[gap], one.kept[gap] = found.flow, self._kept(one, other, found.flow)

    def _give_out(self) -> DynamicMask:
        """The mask of the oldest frame, which has seen all it will see."""
        seen, config = self._window[0], self.config
        before = self._nothing if self._forward is None else self._carried(self._forward, seen, -1)
        self._forward = self._added(before, seen)
        after = self._after()
        belief = self._added(before + after, seen)
        terms = {"motion": seen.motion, "time": (before + after).astype(np.float32)}
        if seen.depth is not None:
            terms["depth"] = seen.depth
        if seen.floating is not None:
            terms["support"] = seen.floating
        features, looks = seen.given.features, seen.looks
        if config.use_head and features is not None and self.head is not None:
            self.head.learn(features, belief)
            looks = self.head.log_odds(features)
        self._window.popleft()
        return shown_mask(self.outline, belief, seen.given, looks, terms)

    def _after(self) -> Array:
        """What the frames after the oldest one say of it, carried back along the flow."""
        back = self._nothing
        if not self.config.use_future:
            return back
        for n in range(len(self._window) - 1, 0, -1):
            back = self._carried(self._added(back, self._window[n]), self._window[n - 1], 1)
        return back

    def _carried(self, belief: Array, to: _Seen, way: int) -> Array:
        """A neighbour's belief in ``to``, forgetting; the neighbour before (way -1) or after (1)."""
        if not self.config.use_time or way not in to.flow:
            return self._nothing
        return self.config.memory * self._flow.pull(belief, to.flow[way]) * to.kept[way]

    def _kept(self, one: _Seen, other: _Seen, flow: Array) -> Array:
        return kept_share(self.config, self._flow, one.past.gray, other.past.gray, flow, one.texture)

    def _added(self, carried: Array, seen: _Seen) -> Array:
        carried, fresh = held(carried, seen.fresh(), seen.looks, self.config)
        limit = self.config.max_log_odds
        return np.clip(carried + self.config.evidence_gain * fresh, -limit, limit).astype(np.float32)

    def _moving(self, seen: _Seen, belief: Array) -> Array:
        """P(moving) at half size, of the belief and the semantics, without outlines."""
        semantic, c = seen.given.semantic, self.config
        if semantic is None or not c.use_semantic:
            return sigmoid(belief + np.float32(np.log(c.base_rate / (1 - c.base_rate))))
        prior = self.outline.shrink(self.outline.semantic_log_odds(semantic))
        return sigmoid(c.semantic_share * belief + prior)
