"""P(moving) with all poses known: a forward-backward smoother over frames before and after (III-A)."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from .appearance import AppearanceClassifier
from .config import DynamicsConfig
from .data import DynamicMask, DynamicsInput, check_input
from .depth import depth_log_ratio
from .depth_support import floating_log_ratio
from .flow import HalfFlow
from .fusion import accumulated, held, kept_share, shown_mask, with_depth
from .motion import Information, texture_information
from .motion_test import MotionTest, Past, Present
from .refinement import EdgeRefinement, sigmoid

Array = NDArray[Any]
T = TypeVar("T")


@dataclass
class _WindowFrame:
    """A frame in the window, at half size."""

    input: DynamicsInput
    past: Past  # with the P(moving) that the frames before it give
    present: Present | None  # None without the motion term
    texture: Information
    motion: Array  # (h, w) log ratios so far
    depth: Array | None  # (h, w) log ratio of its own depth
    appearance: Array | None  # (h', w') log-odds of the classifier
    floating: Array | None = None  # (h, w) log ratio of a depth that nothing holds
    flow: dict[int, Array] = field(default_factory=dict)  # -1: to the frame before, 1: to the frame after
    kept: dict[int, Array] = field(default_factory=dict)  # share of the log-odds that survives that way

    def fresh(self) -> Array:
        """Log ratios of this frame's own comparisons."""
        fresh = self.motion if self.floating is None else with_depth(self.motion, self.floating)
        return fresh if self.depth is None else with_depth(fresh, self.depth)


class ForwardBackwardSmoother:
    """A window over the video, as long as the longest gap. Deterministic; frames come in order."""

    def __init__(
        self, config: DynamicsConfig, width: int, height: int, appearance: AppearanceClassifier | None = None
    ) -> None:
        """``appearance``: what tracking learned of the video's moving things; None: appearance has no say."""
        self.config, self.appearance = config, appearance
        self.refinement = EdgeRefinement(config, width, height)
        w, h = self.refinement.w, self.refinement.h
        self._nothing = np.zeros((h, w), np.float32)
        self._flow = HalfFlow(w, h)
        self._test = MotionTest(config, self._flow, w, h)
        self._causal: Array = self._nothing  # log-odds of the newest frame, from those before it
        self._forward: Array | None = None  # log-odds of the frame whose mask came last, from those before it
        self._window: deque[_WindowFrame] = deque()

    def masks(self, inputs: Iterable[tuple[DynamicsInput, T]]) -> Iterator[tuple[DynamicMask, T]]:
        """One mask an input, in order, ``max(smoother_gaps)`` inputs later, with what came beside the input.

        Raises InputError for images of another size.
        """
        reach = max(self.config.temporal.smoother_gaps, default=1)
        beside: deque[T] = deque()
        for frame, one in inputs:
            check_input(frame, self.refinement.width, self.refinement.height)
            self._add(frame)
            beside.append(one)
            if len(self._window) > reach:
                yield self._oldest_mask(), beside.popleft()
        while self._window:
            yield self._oldest_mask(), beside.popleft()

    def _add(self, frame: DynamicsInput) -> None:
        """The newest frame against those before it, and those against the newest."""
        new = self._described(frame)
        small, before = new.past.gray, list(self._window)
        wanted = self.config.temporal.smoother_gaps
        gaps = sorted({min(g, len(before)) for g in wanted} - {0})
        if before:
            new.flow[-1] = self._flow.quick(small, before[-1].past.gray)
            new.kept[-1] = self._kept(new, before[-1], new.flow[-1])
            carried = self._carried(self._causal, new, -1)
            static = 1 - sigmoid(carried)
            self._compare([(new, before[-gap], static, -gap) for gap in gaps])
        else:
            carried = self._nothing
        self._causal = self._added(carried, new)
        new.past = Past(small, frame.world_from_cam, self._moving(new, self._causal))
        self._window.append(new)
        if self.config.temporal.backward:
            earlier = [(before[-g], g) for g in gaps if g in wanted]
            self._compare([(one, new, 1 - one.past.moving, gap) for one, gap in earlier])

    def _described(self, frame: DynamicsInput) -> _WindowFrame:
        """A frame with every term that needs no other frame."""
        config = self.config
        small = self.refinement.shrink(frame.gray)
        texture = texture_information(small, 7, config.motion.texture_noise)
        depth = None
        if config.depth.enabled and frame.own_inv_depth is not None:
            depth = self.refinement.shrink(depth_log_ratio(frame, config))
        appearance = None
        if config.appearance.enabled and frame.features is not None and self.appearance is not None:
            appearance = self.appearance.log_odds(frame.features)
        present = self._test.present(frame, small, texture) if config.motion.enabled else None
        past = Past(small, frame.world_from_cam, self._nothing)
        new = _WindowFrame(frame, past, present, texture, self._nothing, depth, appearance)
        if config.support.enabled and frame.pose_known:
            new.floating = self.refinement.shrink(floating_log_ratio(frame, config))
        return new

    def _compare(self, pairs: list[tuple[_WindowFrame, _WindowFrame, Array, int]]) -> None:
        """The motion term of each (frame, other frame, P(static) of the frame, frames between them), of known poses."""
        pairs = [p for p in pairs if p[0].input.pose_known and p[1].input.pose_known]
        comparable = [(one.present, static, other.past) for one, other, static, _ in pairs if one.present is not None]
        for (one, other, _, gap), found in zip(pairs, self._test.compare(comparable), strict=False):
            one.motion = one.motion + found.log_ratio
            if abs(gap) == 1:
                one.flow[gap], one.kept[gap] = found.flow, self._kept(one, other, found.flow)

    def _oldest_mask(self) -> DynamicMask:
        """The mask of the oldest frame, against which all has been compared that will be; it leaves the window."""
        oldest, config = self._window[0], self.config
        before = self._nothing if self._forward is None else self._carried(self._forward, oldest, -1)
        self._forward = self._added(before, oldest)
        after = self._after()
        log_odds = self._added(before + after, oldest)
        terms = {"motion": oldest.motion, "time": (before + after).astype(np.float32)}
        if oldest.depth is not None:
            terms["depth"] = oldest.depth
        if oldest.floating is not None:
            terms["support"] = oldest.floating
        features, appearance = oldest.input.features, oldest.appearance
        if config.appearance.enabled and features is not None and self.appearance is not None:
            self.appearance.learn(features, log_odds)
            appearance = self.appearance.log_odds(features)
        self._window.popleft()
        return shown_mask(self.refinement, log_odds, oldest.input, appearance, terms)

    def _after(self) -> Array:
        """What the frames after the oldest one say of it, carried back along the flow."""
        back = self._nothing
        if not self.config.temporal.backward:
            return back
        for n in range(len(self._window) - 1, 0, -1):
            back = self._carried(self._added(back, self._window[n]), self._window[n - 1], 1)
        return back

    def _carried(self, log_odds: Array, to: _WindowFrame, way: int) -> Array:
        """A neighbour's log-odds in ``to``, forgetting; the neighbour before (way -1) or after (1)."""
        if not self.config.temporal.enabled or way not in to.flow:
            return self._nothing
        return self.config.temporal.memory * self._flow.pull(log_odds, to.flow[way]) * to.kept[way]

    def _kept(self, one: _WindowFrame, other: _WindowFrame, flow: Array) -> Array:
        return kept_share(self.config, self._flow, one.past.gray, other.past.gray, flow, one.texture)

    def _added(self, carried: Array, frame: _WindowFrame) -> Array:
        return accumulated(*held(carried, frame.fresh(), frame.appearance, self.config), self.config)

    def _moving(self, frame: _WindowFrame, log_odds: Array) -> Array:
        """P(moving) at half size, of the log-odds and the semantics, without refinement."""
        semantic, c = frame.input.semantic, self.config
        if semantic is None or not c.semantic.enabled:
            return sigmoid(log_odds + np.float32(np.log(c.base_rate / (1 - c.base_rate))))
        prior = self.refinement.shrink(self.refinement.semantic_log_odds(semantic))
        return sigmoid(c.semantic.evidence_share * log_odds + prior)
