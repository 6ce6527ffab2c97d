"""Every type that crosses from one stage to another, and nothing else.

Conventions (docs/conventions.md): ``a_from_b`` maps points of b to points of a; cameras are OpenCV
(+x right, +y down, +z forward); pixels are (x, y) with integers at pixel CENTRES; images are h w c;
monocular lengths are map units and carry no suffix.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from typing import Any, Literal, Protocol

import numpy as np
from numpy.typing import NDArray

from .camera.pinhole import Camera

Array = NDArray[Any]
State = Literal["started", "tracked", "interpolated", "lost"]
MEASURED: tuple[State, ...] = ("started", "tracked")  # states whose pose was seen, not guessed
USABLE_WEIGHT = 0.05  # a match, or a pixel that may be matched, that weighs less says nothing


@dataclass(frozen=True)
class Frame:
    """One image of the source, as the camera took it."""

    index: int  # position in the source, counted before --start/--stride
    timestamp_s: float
    image: Array  # (h, w, 3) uint8 RGB, full resolution
    depth_m: Array | None = None  # (h, w) float32 metres, 0 = none; only sources with a depth sensor
    semantic: Array | None = None  # (h', w') float32 P(movable thing) in 0..1, any resolution
    photograph: Frame | None = None  # what the camera took, where ``image`` is a pinhole image made of it

    @property
    def as_taken(self) -> Frame:
        """The photograph itself."""
        return self if self.photograph is None else self.photograph


@dataclass(frozen=True)
class Truth:
    """What a sequence knows about itself. Only ``evaluation`` may read it."""

    timestamps_s: Array  # (n,) float64
    world_from_cam: Array  # (n, 4, 4) float64; n may be 0
    moving_files: dict[float, str] = field(default_factory=dict)  # the frame's timestamp_s -> 8-bit image, >127 moves
    focal_px: float | None = None  # at full width


class Source(Protocol):
    """A re-iterable stream of frames: ``frames()`` may be called again and starts from the beginning.

    It may have ``focal_hint_px``, the focal length at full width where something speaks of it (EXIF), else None, and
    ``focal_source``, in words what does. The lens starts there, and is still found from the frames.
    It may have ``files``, the image file (Path) of every frame by the frame's index; a video has none.
    It may have ``image_at``, which gives the photograph of a time (h, w, 3) without reading those before it.
    """

    name: str
    kind: str  # "video", "images", or the kind of a dataset's layout: config.SourceKind
    size: tuple[int, int]  # (width, height) of the first frame, upright
    length: int | None  # number of frames that frames() will give, None where unknown
    notes: list[str]  # choices and warnings, for the log and run.json
    has_depth: bool  # frames() can carry depth_m
    has_semantic: bool  # frames() can carry semantic
    # what the dataset says of its lens, as --intrinsics; empty: nothing. Read by pipeline.py alone
    calibration: tuple[float, ...]

    def frames(self) -> Iterator[Frame]: ...
    def truth(self) -> Truth | None: ...


@dataclass(frozen=True)
class WorkFrame:
    """A frame at working size, with what can be said of it alone."""

    index: int
    timestamp_s: float
    gray: Array  # (h, w) uint8
    px: Array  # (p, 2) float64 the chosen pixel of every cell, row by row
    grid: tuple[int, int]  # (rows, cols) of cells, p = rows * cols
    texture: Array  # (p,) float64 0..1, how well the pixel can be matched
    semantic: Array | None  # (h, w) float32 P(movable)
    own_inv_depth: Array | None  # (h, w) float32 measured in this frame alone, 0 = none; None: no such measurement
    focal_px: float | None = None  # the lens that the frame's own points speak of, at working size


@dataclass(frozen=True)
class Pointmap:
    """3-D points of a view's pixels. The holder's field name says whose camera frame the points are in."""

    px: Array  # (p, 2) pixels at working size
    points: Array  # (p, 3) float64
    confidence: Array  # (p,) float64 0..1, 0 = unknown


@dataclass(frozen=True)
class Matches:
    """Pixel pairs of two views at working size; row n belongs to ``ref.px[n]``."""

    ref_px: Array  # (p, 2) float64
    new_px: Array  # (p, 2) float64
    weight: Array  # (p,) float64 in 0..1; 0 = no match


@dataclass(frozen=True)
class FeatureMatches:
    """Places that sparse features found in both views, verified; between them nothing is said."""

    ref_px: Array  # (n, 2) float64 pixels at working size
    new_px: Array  # (n, 2) float64
    confidence: Array  # (n,) float64 0..1


@dataclass(frozen=True)
class Guess:
    """What is known of a pair before it is looked at."""

    camera: Camera  # at working size
    ref_inv_depth: Array | None = None  # (p,) at ref.px
    ref_depth_info: Array | None = None  # (p,) 1/variance of it, unit pixel noise
    new_from_ref: Array | None = None  # (4, 4)
    flow: Array | None = None  # (h', w', 2) float32 ref -> new, in pixels of its own size
    flow_is_near: bool = False  # the flow comes from solved poses and depths: only the last pixels are searched
    features: FeatureMatches | None = None  # where ``flow`` comes from, if it comes from sparse features


@dataclass(frozen=True)
class PairPrediction:
    """Two views seen together: ref's pointmap, the matches between them, and new's points where they are measured."""

    matches: Matches
    ref: Pointmap  # in ref's camera, at matches.ref_px
    new_own: Pointmap | None  # new's points in NEW's camera, where the provider measures depth in a frame alone
    flow: Array  # (h', w', 2) float32 ref -> new, in pixels of its own size


@dataclass(frozen=True)
class View:
    """One photograph for the Gaussian map: pinhole (undistorted), with its soft static weight."""

    timestamp_s: float
    image: Array  # (h, w, 3) uint8 RGB
    static: Array  # (h, w) float16 or float32, 1 - P(moving); 0 where the undistorted image has no data
    world_from_cam: Array  # (4, 4) float64
    camera: Camera  # at (h, w), k1 == 0
    kf_id: int  # keyframe that this view hangs on
    uncertainty: Array | None = None  # (h, w) float16 or float32 u(p) of eq. (16), 0 outside R


@dataclass(frozen=True)
class StaticCloud:
    """The fused static points that the Gaussian map starts from."""

    points_world: Array  # (n, 3) float32
    colors: Array  # (n, 3) uint8 RGB
    confidence: Array  # (n,) float32
    spacing: Array  # (n,) float32, size in map units of the patch that a point stands for
    kf_id: Array  # (n,) int32

    def in_lengths(self, factor: float) -> StaticCloud:
        """The same with lengths times ``factor``."""
        points, spacing = self.points_world * np.float32(factor), self.spacing * np.float32(factor)
        return replace(self, points_world=points, spacing=spacing)


@dataclass(frozen=True)
class Trajectory:
    """A camera pose for every frame."""

    timestamps_s: Array  # (n,) float64
    world_from_cam: Array  # (n, 4, 4) float64
    states: tuple[State, ...]
    is_keyframe: Array  # (n,) bool

    def in_lengths(self, factor: float) -> Trajectory:
        """The same with lengths times ``factor``."""
        poses = self.world_from_cam.copy()
        poses[:, :3, 3] *= factor
        return replace(self, world_from_cam=poses)

    def keyframes(self) -> Trajectory:
        """The rows that are keyframes."""
        return self.rows(np.flatnonzero(self.is_keyframe))

    def tracked(self) -> Trajectory:
        """The rows whose pose was seen, not interpolated."""
        return self.rows(np.flatnonzero([s in MEASURED for s in self.states]))

    def rows(self, keep: Array) -> Trajectory:
        """The rows with these indices (m,)."""
        return Trajectory(
            self.timestamps_s[keep],
            self.world_from_cam[keep],
            tuple(self.states[i] for i in keep),
            self.is_keyframe[keep],
        )
