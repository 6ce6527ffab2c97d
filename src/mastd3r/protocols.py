"""What each stage that can be replaced must offer; ``registry.py`` has the names of those that ship.

A builder, as the registry names it, is called with what stands under "built with".
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from typing import TYPE_CHECKING, Any, Protocol, TypeVar

from numpy.typing import NDArray

from .types import FeatureMatches, Frame, Guess, PairPrediction, WorkFrame

if TYPE_CHECKING:
    from .alignment.problem import AlignmentProblem
    from .alignment.result import Alignment
    from .dynamics.data import DynamicMask, DynamicsInput

Array = NDArray[Any]
T = TypeVar("T")


class PointmapProvider(Protocol):
    """III-A: looks at one frame, and at a pair. Built with (config, source).

    ``WorkFrame`` is what it says of a frame; all of one video are of one ``size``.
    """

    name: str
    size: tuple[int, int]  # (width, height) of the working image
    depth_sigma_ratio: float | None  # relative 1-sigma of the depth measured in one frame; None: measures none
    own_scale_known: bool  # False: the depth of every frame alone has a scale of its own
    finds_far: bool  # ``predict`` matches views of one place without a start, however far apart in the image
    side_by_side: bool  # ``predict`` may be asked in two threads at once
    prefetches_pairs: bool  # ``beside`` may be asked before a frame's turn, beside the anchor keyframe of that time
    notes: tuple[str, ...]  # what run.json is told of it

    def look(self, frame: Frame) -> WorkFrame:
        """What can be said of a frame alone: working image, pixels to match, own depth. May run in another thread."""
        ...

    def beside(self, work: WorkFrame, near: WorkFrame | None) -> WorkFrame:
        """The same with what a network that looks at pairs only can say of it. May run in another thread.

        ``near``: a frame that sees the same place; None: the frame itself.
        """
        ...

    def expect(self, pairs: Sequence[tuple[WorkFrame, WorkFrame]]) -> None:
        """These (ref, new) and their reverses are about to be predicted: a network may look at them together."""
        ...

    def predict(self, ref: WorkFrame, new: WorkFrame, guess: Guess) -> PairPrediction:
        """Pointmaps in ref's camera, confidences and matches of ref's chosen pixels, eq. (7)."""
        ...


class FeatureMatcher(Protocol):
    """Sparse features where dense flow ends: after a jump, across a loop. Built with ()."""

    def matches(
        self, ref: Array, new: Array, ref_moving: Array | None, new_moving: Array | None
    ) -> FeatureMatches | None:
        """Mutual matches of one geometry between two (h, w) uint8 images; None where too few agree.

        ``ref_moving``, ``new_moving`` (h, w): P(moving) in 0..1; what probably moves has no say. Asked by two threads.
        """
        ...

    def alike(self, image: Array, others: Sequence[Array]) -> Array:
        """(n,) 0..1, how much each of n images looks like this one, for loops; NaN where the part has no opinion."""
        ...


class Aligner(Protocol):
    """III-B: the pose of a new view against its anchor, in three stages. Built with (config.alignment)."""

    def coarse(self, problem: AlignmentProblem) -> Alignment:
        """Eq. (8)."""
        ...

    def scale(self, problem: AlignmentProblem, coarse: Alignment) -> Alignment:
        """Eq. (9)(10)."""
        ...

    def fine(self, problem: AlignmentProblem, scaled: Alignment) -> Alignment:
        """Eq. (11)(12), and how well the matches fit in the end."""
        ...


class DynamicsFilter(Protocol):
    """The mask while the video is read: it knows the frames before. Frames come in order.

    A run can be resumed where the filter also has ``memory()``, plain data that it carries to the next frame, and
    ``remember(memory)``; see ``dynamics.filter``.
    """

    appearance: Any  # what it learned of the appearance of moving things, for the smoother; None: nothing

    def prior(self, gray: Array, semantic: Array | None = None, features: Array | None = None) -> Array:
        """P(moving) (h, w) float32 before the pose is known: the prior of eq. (2)."""
        ...

    def update(self, frame: DynamicsInput) -> DynamicMask:
        """P(moving) once the pose is known, eq. (1)-(4)."""
        ...


class DynamicsSmoother(Protocol):
    """The mask after the last frame: it also knows the frames that follow."""

    def masks(self, inputs: Iterable[tuple[DynamicsInput, T]]) -> Iterator[tuple[DynamicMask, T]]:
        """One mask an input, in order, perhaps some inputs later; what came with the input is given back with it."""
        ...


class DynamicsModel(Protocol):
    """III-A: what moves. Built with (config.dynamics)."""

    needs_features: bool  # descriptors of frames are made for it

    def filter(self, width: int, height: int) -> DynamicsFilter:
        """The masks while tracking, of images of this size."""
        ...

    def smoother(self, width: int, height: int, appearance: Any = None) -> DynamicsSmoother:
        """The masks of the smoothing pass; ``appearance`` is what the filter learned."""
        ...


class SemanticPrior(Protocol):
    """P(movable) of a frame, from whatever knows it. Built with (config, source).

    It may have ``shows_all``, False where what it does not show may move all the same, and ``memory``, ``remember``
    and ``forget`` for what it carries from frame to frame.
    """

    notes: tuple[str, ...]

    def fill(self, frame: Frame) -> Frame:
        """The frame with ``semantic`` set, or as it is. May run in another thread."""
        ...

    def features(self, frame: Frame) -> Array | None:
        """(h', w', c) float32 descriptors for the appearance classifier; None: plain ones are made."""
        ...


class PlaceDescriptor(Protocol):
    """What a place looks like. Built with (provider)."""

    def __call__(self, work: WorkFrame) -> Array:
        """(c,) of unit norm; two views of one place have a scalar product near 1."""
        ...


class MapBackend(Protocol):
    """Draws Gaussians: III-C, Algorithm 1. Built with (). Tensors are torch's; see ``mapping.rasterise``."""

    device: str  # where the map's tensors live: "cpu" or an accelerator's name

    def rasterise(self, *given: Any) -> tuple[Any, Any, Any]:
        """Colour (h, w, 3), depth (h, w) and alpha (h, w) of the arguments of ``mapping.rasterise.rasterization``."""
        ...
