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
from .fusion import accumulated, alike, carried_along, kept_share, shown_mask, with_depth
from .motion import texture_information
from .motion_test import Aligned, MotionTest, Past, Present
from .people import believed
from .photometric import photo_variance
from .refinement import EdgeRefinement, sigmoid

Array = NDArray[Any]
T = TypeVar("T")


@dataclass
class _WindowFrame:
    """A frame in the window, at half size."""

    input: DynamicsInput
    past: Past  # with the P(moving) that the frames before it give
    present: Present | None  # None without the motion term
    variance: Array  # (h, w) of its grey values
    motion: Array  # (h, w) log ratios so far
    depth: Array | None  # (h, w) log ratio of its own depth
    appearance: Array | None  # (h', w') log-odds of the classifier
    alike: Array | None  # (h, w) of them: how much each pixel looks like what moves
    floating: Array | None = None  # (h, w) log ratio of a depth that nothing holds
    flow: dict[int, Array] = field(default_factory=dict)  # -1: to the frame before, 1: to the frame after
    kept: dict[int, Array] = field(default_factory=dict)  # share of the log-odds that survives that way

    _fresh: Array | None = None

    def fresh(self) -> Array:
        """Log ratios of this frame's own comparisons."""
        if self._fresh is None:
            fresh = self.motion if self.floating is None else with_depth(self.motion, self.floating)
            self._fresh = fresh if self.depth is None else with_depth(fresh, self.depth)
        return self._fresh

    def add_motion(self, log_ratio: Array) -> None:
        """One more comparison."""
        self.motion, self._fresh = self.motion + log_ratio, None


_Pair = tuple[_WindowFrame, int, Aligned, Aligned]  # an earlier frame, frames from it to the newest; that to it, back


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
        found = self._aligned(new, [(before[-gap], gap) for gap in gaps])
        carried = self._nothing
        if before:
            nearest = next((there.flow for _, gap, there, _ in found if gap == 1), None)
            new.flow[-1] = self._flow.quick(small, before[-1].past.gray) if nearest is None else nearest
            new.kept[-1] = self._kept(new, before[-1], new.flow[-1])
            carried = self._carried(self._causal, new, -1)
        static = 1 - sigmoid(carried)
        views = [(new.present, static, other.past, there, back) for other, _, there, back in found if new.present]
        for ratio in self._test.evidence(views):
            new.add_motion(ratio)
        self._causal = self._added(carried, new)
        new.past = Past(small, frame.world_from_cam, self._moving(new, self._causal))
        self._window.append(new)
        if not self.config.temporal.backward:
            return
        found = [pair for pair in found if pair[1] in wanted]
        views = [(o.present, 1 - o.past.moving, new.past, back, there) for o, _, there, back in found if o.present]
        for (other, gap, _, back), ratio in zip(found, self._test.evidence(views), strict=True):
            other.add_motion(ratio)
            if gap == 1:
                other.flow[1], other.kept[1] = back.flow, self._kept(other, new, back.flow)

    def _aligned(self, new: _WindowFrame, others: list[tuple[_WindowFrame, int]]) -> list[_Pair]:
        """The newest frame and each (other, frames between them), both ways, where both poses are known."""
        if new.present is None or not new.input.pose_known:
            return []
        pairs = [(o, gap) for o, gap in others if o.present is not None and o.input.pose_known]
        ways = self._test.aligned([(new.present, new.past, o.present, o.past) for o, _ in pairs if o.present])
        return [(o, gap, *way) for (o, gap), way in zip(pairs, ways, strict=True)]

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
        variance, looks = photo_variance(texture, config), alike(appearance, small.shape)
        new = _WindowFrame(frame, past, present, variance, self._nothing, depth, appearance, looks)
        if config.support.enabled and frame.pose_known:
            new.floating = self.refinement.shrink(floating_log_ratio(frame, config))
        return new

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
        return carried_along(log_odds, to.flow[way], to.kept[way], self.config.temporal.memory)

    def _kept(self, one: _WindowFrame, other: _WindowFrame, flow: Array) -> Array:
        return kept_share(self.config, one.past.gray, other.past.gray, flow, one.variance)

    def _added(self, carried: Array, frame: _WindowFrame) -> Array:
        return accumulated(carried, frame.fresh(), frame.alike, self.config)

    def _moving(self, frame: _WindowFrame, log_odds: Array) -> Array:
        """P(moving) at half size, of the log-odds and the semantics, without refinement."""
        semantic, c = frame.input.semantic, self.config
        if semantic is None or not c.semantic.enabled:
            return sigmoid(log_odds + np.float32(np.log(c.base_rate / (1 - c.base_rate))))
        prior = self.refinement.semantic_log_odds(believed(semantic, log_odds, c.semantic))
        return sigmoid(c.semantic.share_beside(semantic) * log_odds + self.refinement.shrink(prior))
