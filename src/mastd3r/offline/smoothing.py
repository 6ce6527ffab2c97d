"""III-A once more with final poses, forwards and backwards: masks, training views for the map, colours of the cloud."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from ..camera.map_view import MapView
from ..camera.rectification import Rectifier
from ..concurrency import Future, Worker, prefetch
from ..config import HOLDOUT_EVERY, Config
from ..dynamics.causal import CausalMasks
from ..dynamics.data import DynamicMask, DynamicsInput
from ..dynamics.flow import HalfFlow
from ..dynamics.soft_mask import static_at
from ..dynamics.uncertainty import RESIDUAL_MAX_PX, SeenFrom, reprojection_residual_px, uncertainty_weight
from ..geometry.se3 import inverse, transform
from ..graph.keyframe_graph import KeyframeGraph
from ..parts import Parts
from ..protocols import DynamicsSmoother
from ..sources.rectified import rectified
from ..tracking.mask_input import dynamics_input
from ..tracking.observation import Observer
from ..types import MEASURED, Frame, View, WorkFrame
from .final_solve import FinalFrame
from .point_votes import PointVotes
from .reweighting import MaskReweighting

Array = NDArray[Any]
BLEEDING_PX = 5  # at half the working size: flow of a moving thing spills over its outline; u is taken back by that
COMPARED = (-4, -2, -1, 1, 2, 4)  # keyframes that u(p) is found against, from the frame's own
SHOWN_LATE = 4  # masks that may wait to be written


@dataclass
class SmoothedMasks:
    """What one more pass over the frames gave."""

    views: list[View] = field(default_factory=list)  # for the map; no holdout frame among them
    colors: dict[int, Array] = field(default_factory=dict)  # kf id -> (p, 3) uint8 at its px; no holdout frame
    moving: dict[int, Array] = field(default_factory=dict)  # kf id -> (p,) P(moving) at its px, by all frames
    holdout: list[FinalFrame] = field(default_factory=list)
    reweighting: MaskReweighting = field(
        default_factory=MaskReweighting
    )  # the masks, for the poses that they were made with

    def with_poses(self, final: list[FinalFrame]) -> SmoothedMasks:
        """The same seen from other poses."""
        place = {f.record.timestamp_s: f for f in final}
        views = [replace(v, world_from_cam=place[v.timestamp_s].world_from_cam) for v in self.views]
        return replace(self, views=views, holdout=[place[f.record.timestamp_s] for f in self.holdout])


def is_holdout(position: int) -> bool:
    """Frames 0, 8, 16 … of those read are never shown to the map."""
    return position % HOLDOUT_EVERY == 0


@dataclass(frozen=True)
class _Waiting:
    """A frame whose mask is not there yet, without its photograph."""

    position: int
    place: FinalFrame
    small: Array  # (h, w, 3) uint8 at working size, as tracking saw it
    photograph: tuple[Array, Array] | None  # pinhole image and where it has data; only of training views
    uncertainty: Array | None  # (h, w) u(p) over the image; only of training views


@dataclass(frozen=True)
class SmoothingContext:
    """What the smoothing pass needs beside the frames."""

    final: list[FinalFrame]
    graph: KeyframeGraph
    parts: Parts
    config: Config
    map_view: MapView
    rectifier: Rectifier | None = None
    appearance: Any = None  # what tracking learned of the appearance of moving things


@dataclass(frozen=True)
class FrameMask:
    """One frame's mask, as it comes."""

    timestamp_s: float
    image: Array  # (h, w, 3) uint8 RGB at working size, as tracking saw it
    mask: DynamicMask  # over the image
    over_photograph: Array  # (h, w) float32 P(moving) over the photograph at working scale


def smooth_masks(
    frames: Iterator[Frame], context: SmoothingContext, on_mask: Callable[[FrameMask], None]
) -> SmoothedMasks:
    """Masks of every frame with the final poses and depths; views thinned evenly to ``mapping.max_views``.

    ``frames`` are photographs, and ``map_view`` is of their lens. Where that was calibrated, ``rectifier`` makes
    them what tracking saw. A mask waits for frames after it, so a few frames are held, never the video.
    """
    out, votes = SmoothedMasks(), PointVotes()
    graph = context.graph
    chosen = view_positions(context.final, context.config)
    smoother = _smoother(context)
    uncoloured: list[int] = []  # keyframes without colours yet
    written = deque[Future[None]]()
    inputs = prefetch(_inputs(frames, context, chosen), lambda _, __: None, lambda: None)
    with Worker("masks") as writer:
        for mask, waiting in smoother.masks(inputs):
            place = waiting.place
            out.reweighting.see(graph, place.record, mask.probability)
            moving = _over_photograph(mask.probability, context.rectifier)
            shown = FrameMask(place.record.timestamp_s, waiting.small, mask, moving)
            written.append(writer.submit(partial(on_mask, shown)))
            if len(written) > SHOWN_LATE:
                written.popleft().get()
            if place.record.is_keyframe:
                uncoloured.append(place.record.kf_id)
            if is_holdout(waiting.position):
                out.holdout.append(place)
                continue
            for kf_id in uncoloured:  # a holdout keyframe takes its colours from the frame after it
                out.colors[kf_id], p, _ = _seen_by(waiting.small, mask.probability, graph, kf_id, place)
                votes.start(kf_id, p, out.colors[kf_id])
            uncoloured.clear()
            kf_id = place.record.kf_id
            if kf_id in out.colors and not place.record.is_keyframe:
                colors, p, inside = _seen_by(waiting.small, mask.probability, graph, kf_id, place)
                votes.add(kf_id, p, colors, inside)
            if waiting.photograph is not None:
                out.views.append(_view(waiting, moving, context))
        while written:
            written.popleft().get()
    out.moving = votes.moving()
    return out


def _smoother(context: SmoothingContext) -> DynamicsSmoother:
    dynamics, size = context.parts.dynamics, context.parts.provider.size
    if context.config.masks == "causal":
        return CausalMasks(dynamics.filter(*size), context.appearance)
    return dynamics.smoother(*size, context.appearance)


def _inputs(
    photographs: Iterator[Frame], context: SmoothingContext, chosen: set[int]
) -> Iterator[tuple[DynamicsInput, _Waiting]]:
    """The mask's input of each frame, and what is needed once the mask is there."""
    by_index = {f.record.index: f for f in context.final}
    graph, parts, map_view, rectifier = context.graph, context.parts, context.map_view, context.rectifier
    observer, size = Observer(parts), parts.provider.size
    flow = HalfFlow(size[0] // 2, size[1] // 2)
    frames = photographs if rectifier is None else (rectified(p, rectifier) for p in photographs)

    def near(frame: Frame) -> WorkFrame | None:
        place = by_index.get(frame.index)
        return None if place is None else graph.keyframes[place.record.kf_id].work

    for position, frame in enumerate(observer.prefetched(frames, lambda: near)):
        place = by_index.get(frame.index)
        if place is None:
            return
        seen = observer.observe(frame, near(frame))
        small = cv2.resize(frame.image, size, interpolation=cv2.INTER_AREA)
        features = seen.features.get()
        given = dynamics_input(graph, place.record.kf_id, place.world_from_cam, seen.work, 1.0, features)
        photograph = uncertainty = None
        if position in chosen:
            photograph = map_view.pinhole_image(frame.as_taken.image)
            uncertainty = _uncertainty(place, graph, given, flow, map_view.tau_px)
        given = replace(given, color=small, pose_known=place.state in MEASURED)
        given = given if parts.provider.own_scale_known else _at_expected_scale(given)
        yield given, _Waiting(position, place, small, photograph, uncertainty)


def _at_expected_scale(given: DynamicsInput) -> DynamicsInput:
    """The frame's own depth, whose scale is its own, brought to that of the depth expected, by their median ratio."""
    own = given.own_inv_depth
    both = None if own is None else (own > 0) & (given.inv_depth > 0)
    if own is None or both is None or not both.any():
        return given
    scale = np.float32(np.median(own[both] / given.inv_depth[both]))
    return replace(given, own_inv_depth=own / scale)


def view_positions(final: list[FinalFrame], config: Config) -> set[int]:
    """Positions of the training views: keyframes first, then evenly; never holdout, never a guessed pose."""
    usable = [n for n, f in enumerate(final) if not is_holdout(n) and f.state in MEASURED]
    most = config.mapping.max_views if config.mapping.enabled else 0
    if len(usable) <= most:
        return set(usable)
    return {usable[int(i)] for i in np.linspace(0, len(usable) - 1, most).round()} if most else set()


def _seen_by(
    small: Array, moving: Array, graph: KeyframeGraph, kf_id: int, place: FinalFrame
) -> tuple[Array, Array, Array]:
    """Colours (p, 3) uint8 and P(moving) (p,) of a keyframe's points in a frame's image, and (p,) bool: inside it.

    Outside counts as moving.
    """
    v, camera = graph.variables[kf_id], graph.camera()
    if place.record.is_keyframe and place.record.kf_id == kf_id:
        px = v.px
    else:
        cam_from_kf = inverse(place.world_from_cam) @ graph.world_from_cam(kf_id)
        points = transform(cam_from_kf, camera.unproject(v.px, np.maximum(v.inv_depth, 1e-9)))
        in_front = points[:, 2] > 0
        px = np.where(in_front[:, None], camera.project(np.where(in_front[:, None], points, 1.0)), -1e3)
    inside = (px > -0.5).all(1) & (px[:, 0] < camera.width - 0.5) & (px[:, 1] < camera.height - 0.5)
    at = np.clip(np.round(px), 0, [camera.width - 1, camera.height - 1]).astype(int)
    return small[at[:, 1], at[:, 0]], np.where(inside, 1 - static_at(moving, px), 1.0), inside


def _over_photograph(values: Array, rectifier: Rectifier | None) -> Array:
    """A map over the image that was tracked, as a map over the photograph."""
    return values if rectifier is None else rectifier.as_photograph(values)


def _view(waiting: _Waiting, moving: Array, context: SmoothingContext) -> View:
    """The training view of a frame whose mask is there, ``moving`` over its photograph."""
    assert waiting.photograph is not None
    (image, inside), place, map_view = waiting.photograph, waiting.place, context.map_view
    uncertainty = waiting.uncertainty
    if uncertainty is not None:
        uncertainty = map_view.pinhole_map(_over_photograph(uncertainty, context.rectifier)).astype(np.float16)
    return View(
        place.record.timestamp_s,
        image,
        view_static(moving, inside, map_view),
        place.world_from_cam,
        map_view.pinhole,
        place.record.kf_id,
        uncertainty,
    )


def view_static(moving: Array, inside: Array, map_view: MapView) -> Array:
    """(h, w) float16 P(static) over the pinhole image, of P(moving) over the photograph; exactly 0 means: no data."""
    p = cv2.dilate(moving.astype(np.float32), np.ones((5, 5)))  # the edge of a moving thing is not static
    return np.asarray(np.clip(1 - map_view.pinhole_map(p), 0.01, 1) * inside, np.float16)


def _uncertainty(
    place: FinalFrame, graph: KeyframeGraph, given: DynamicsInput, flow: HalfFlow, tau_px: float
) -> Array | None:
    """(h, w) u(p) of eq. (16) over the working image; None where no residual is above tau_unc.

    Against keyframes before and after the frame's own: a frame compared with itself shows nothing.
    """
    kf = place.record.kf_id
    near = [kf + n for n in COMPARED if 0 <= kf + n < len(graph.keyframes)]
    others = [n for n in near if graph.submap_of[n] == graph.submap_of[kf]]
    keyframes = [
        SeenFrom(graph.keyframes[k].work.gray, graph.keyframes[k].moving, graph.variables[k].cam_from_world)
        for k in others
    ]
    residual_px = reprojection_residual_px(
        keyframes, graph.camera(), place.world_from_cam, given.gray, given.inv_depth, flow, RESIDUAL_MAX_PX
    )
    u = uncertainty_weight(np.minimum(residual_px, RESIDUAL_MAX_PX).ravel() ** 2, tau_px).reshape(residual_px.shape)
    if not (u > 0).any():
        return None
    inner = cv2.erode(u.astype(np.float32), np.ones((BLEEDING_PX, BLEEDING_PX)))
    return cv2.resize(inner, graph.size, interpolation=cv2.INTER_NEAREST)
