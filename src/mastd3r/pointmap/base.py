"""What most pointmap providers have in common; the protocol stands in ``protocols.py``."""

from __future__ import annotations

from collections.abc import Sequence

from ..types import Frame, WorkFrame


class Provider:
    """Defaults of a provider that measures no depth and looks at every frame alone; it adds ``look``, ``predict``.

    See ``protocols.PointmapProvider`` for what the fields say.
    """

    name = "unnamed"
    width: int
    height: int
    size: tuple[int, int]
    depth_sigma_ratio: float | None = None
    own_scale_known = True
    finds_far = False
    side_by_side = True
    prefetches_pairs = False
    notes: tuple[str, ...] = ()

    def look(self, frame: Frame) -> WorkFrame:
        """What can be said of a frame alone."""
        raise NotImplementedError

    def beside(self, work: WorkFrame, near: WorkFrame | None) -> WorkFrame:
        """The frame as it is: all that is known of it is known alone."""
        return work

    def expect(self, pairs: Sequence[tuple[WorkFrame, WorkFrame]]) -> None:
        """Nothing to prepare."""

    def observe(self, frame: Frame, near: WorkFrame | None = None) -> WorkFrame:
        """What can be said of a frame, alone and beside one that sees the same place."""
        return self.beside(self.look(frame), near)
