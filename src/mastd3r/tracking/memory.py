"""All that tracking remembers from frame to frame, as one value: a run that was killed goes on from it."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

from ..concurrency import Future
from ..graph.keyframe_graph import KeyframeGraph
from ..parts import Parts
from ..types import WorkFrame
from .keyframes import Keyframes
from .masking import MaskTracker
from .state import TrackedFrame, TrackingState


@dataclass(frozen=True)
class TrackingMemory:
    """Plain data. Frames that were tracked are the records of the graph."""

    graph: KeyframeGraph
    state: TrackingState  # without the mask of its last frame
    last_moving: Any  # (h, w) that mask
    keyframes: tuple[KeyframeGraph | None, int, dict[tuple[int, int], Any]]  # see Keyframes.memory
    mask: Any  # of the filter
    features: Any
    semantics: Any = None


def can_remember(masks: MaskTracker) -> bool:
    """False for a filter of the mask that cannot say what it remembers: one from outside."""
    return hasattr(masks.filter, "memory") and hasattr(masks.filter, "remember")


def memory_of(state: TrackingState, keyframes: Keyframes, masks: MaskTracker, parts: Parts) -> TrackingMemory:
    """What is remembered now; waits for what is in the making. Nothing is copied: it is to be written at once."""
    graph, moving = keyframes.graph, None
    if state.last is not None:
        moving = state.last.moving.get()
        state = replace(state, last=TrackedFrame(state.last.work, None))  # type: ignore[arg-type]
    frames = [kf.work for kf in graph.keyframes] + ([state.last.work] if state.last is not None else [])
    features = getattr(parts.features, "memory", lambda _: None)(frames)
    semantics = getattr(parts.semantics, "memory", lambda: None)()
    return TrackingMemory(graph, state, moving, keyframes.memory(), masks.memory(), features, semantics)


def remember(memory: TrackingMemory, keyframes: Keyframes, masks: MaskTracker, parts: Parts) -> TrackingState:
    """Make it what the parts remember; gives the state that the next frame is tracked from."""
    keyframes.graph.become(memory.graph)
    keyframes.remember(memory.keyframes)
    masks.remember(memory.mask)
    if memory.features is not None:
        parts.features.remember(memory.features)  # type: ignore[attr-defined]
    if memory.semantics is not None:
        parts.semantics.remember(memory.semantics)  # type: ignore[attr-defined]
    state = memory.state
    if state.last is None:
        return state
    work: WorkFrame = state.last.work
    return replace(state, last=TrackedFrame(work, Future.done(memory.last_moving)))
