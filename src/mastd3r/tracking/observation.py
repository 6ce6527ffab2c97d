"""A frame as the stages see it; made while the frame before is tracked, where the caller reads ahead."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any

from numpy.typing import NDArray

from ..concurrency import Future, prefetch
from ..dynamics.appearance import plain_descriptors
from ..parts import Parts
from ..sources.checks import frame_is_blank
from ..types import Frame, WorkFrame

Array = NDArray[Any]
Near = Callable[[Frame], WorkFrame | None]  # what a frame is probably seen beside
DESCRIBED_PX = 4  # working pixels a plain descriptor


@dataclass(frozen=True)
class Observation:
    """One frame, looked at."""

    frame: Frame
    work: WorkFrame
    features: Future[Array | None]  # (h', w', c) descriptors for the appearance classifier, made when asked for
    blank: bool  # of one colour: nothing can be matched


@dataclass
class _Foreseen:
    """A frame that was looked at before its turn."""

    frame: Frame
    work: WorkFrame
    near: WorkFrame | None = None  # the frame that it was looked at beside; None: alone so far


class Observer:
    """Looks at frames. What it sees does not depend on whether it looked before a frame's turn."""

    def __init__(self, parts: Parts) -> None:
        self.parts = parts
        self._foreseen: dict[int, _Foreseen] = {}

    def observe(self, frame: Frame, near: WorkFrame | None = None) -> Observation:
        """The frame with its semantic prior, as the provider sees it; ``near`` sees the same place."""
        seen, provider = self._foreseen.pop(frame.index, None), self.parts.provider
        if seen is None or seen.frame is not frame:
            work = provider.beside(self._look(frame), near)
        elif seen.near is near and near is not None:
            work = seen.work
        else:
            work = provider.beside(seen.work, near)
        return Observation(frame, work, Future.lazy(lambda: self.describe(frame)), frame_is_blank(frame.image))

    def describe(self, frame: Frame) -> Array | None:
        """(h', w', c) float32 descriptors of a frame, where the mask learns what moving things look like."""
        if not self.parts.dynamics.needs_features:
            return None
        found = self.parts.semantics.features(frame)
        if found is not None:
            return found
        width, height = self.parts.provider.size
        return plain_descriptors(frame.image, width // DESCRIBED_PX, height // DESCRIBED_PX)

    def prefetched(self, frames: Iterator[Frame], near: Callable[[], Near]) -> Iterator[Frame]:
        """The frames, each read, and looked at for ``observe``, while the caller works on the one before.

        ``near`` is asked in the caller's thread, a frame ahead: the frame that ``observe`` will probably be given.
        """
        looked = prefetch(frames, lambda frame, _: self._foresee(frame), lambda: None)
        return prefetch(looked, self._foresee_beside, near) if self.parts.provider.prefetches_pairs else looked

    def _look(self, frame: Frame) -> WorkFrame:
        return self.parts.provider.look(self.parts.semantics.fill(frame))

    def _foresee(self, frame: Frame) -> None:
        self._foreseen[frame.index] = _Foreseen(frame, self._look(frame))

    def _foresee_beside(self, frame: Frame, near: Near) -> None:
        seen, other = self._foreseen[frame.index], near(frame)
        if other is not None:
            seen.work, seen.near = self.parts.provider.beside(seen.work, other), other
