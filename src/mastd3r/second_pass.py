"""The second look at every frame, with final poses: masks, training views for the map, colours of the cloud."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, replace
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from .config import HOLDOUT_EVERY, Config
from .dynamics.belief import DynamicBelief
from .dynamics.data import DynamicsInput
from .dynamics.flow import HalfFlow
from .finish import FinalFrame
from .geometry.se3 import inverse, transform
from .graph.keyframe_graph import KeyframeGraph
from .lens_view import LensView
from .parts import Parts
from .rectify import Rectifier
from .types import Frame, View
from .view_depth import dynamics_input, reprojection_residual_px, static_at

Array = NDArray[Any]
BLEEDING_PX = 5  # at half the working size: flow of a moving thing spills over its outline; u is taken back by that
COMPARED = (-4, -2, -1, 1, 2, 4)  # keyframes that u(p) is found against, from the frame's own
RESIDUAL_MAX_PX = 8.0  # as uncertain as can be: one wild match must not make all others small in u = e / max e


@dataclass
class SecondPass:
    """What one more pass over the frames gave."""

    views: list[View] = field(default_factory=list)  # for the map; no holdout frame among them
    colors: dict[int, Array] = field(default_factory=dict)  # kf id -> (p, 3) uint8 at its px; no holdout frame
    moving: dict[int, Array] = field(default_factory=dict)  # kf id -> (p,) P(moving) at its px
    holdout: list[FinalFrame] = field(default_factory=list)


def is_holdout(position: int) -> bool:
    """Frames 0, 8, 16 … of those read are never shown to the map."""
    return position % HOLDOUT_EVERY == 0


def second_pass(
    frames: Iterator[Frame],
    final: list[FinalFrame],
    graph: KeyframeGraph,
    parts: Parts,
    config: Config,
    lens_view: LensView,
    on_mask: Callable[[float, Array], None],
    rectifier: Rectifier | None = None,
) -> SecondPass:
    """Masks of every frame with the final poses and depths; views thinned evenly to ``mapping.max_views``.

    ``frames`` are photographs, and ``lens_view`` is of their lens. Where that was calibrated, ``rectifier`` makes
    them what tracking saw. ``on_mask`` is given P(moving), (h, w) float32 over the photograph at working scale.
    """
    out, flow = SecondPass(), HalfFlow(parts.size[0] // 2, parts.size[1] // 2)
    belief = DynamicBelief(config.dynamics, *parts.size)
    chosen = _view_positions(final, config)
    by_index = {f.record.index: f for f in final}
    waiting: list[int] = []  # keyframes without colours yet
    for position, frame in enumerate(frames):
        place = by_index.get(frame.index)
        if place is None:
            break
        seen = frame if rectifier is None else rectifier.frame(frame)
        work = parts.observe(seen, graph.keyframes[place.record.kf_id].work)
        belief.prior(work.gray, work.semantic)
        given = dynamics_input(graph, place.record.kf_id, place.world_from_cam, work, 1.0)
        mask = belief.update(given if parts.own_scale_known else _at_expected_scale(given))
        moving = _over_photograph(mask.probability, rectifier)
        on_mask(frame.timestamp_s, moving)
        if place.record.is_keyframe:
            waiting.append(place.record.kf_id)
        if is_holdout(position):
            out.holdout.append(place)
            continue
        for kf_id in waiting:  # a holdout keyframe takes its colours from the frame after it
            out.colors[kf_id], out.moving[kf_id] = _seen_by(seen.image, mask.probability, graph, kf_id, place)
        waiting.clear()
        if position in chosen:
            uncertainty = _uncertainty(place, graph, given, flow, lens_view.tau_px)
            if uncertainty is not None:
                uncertainty = lens_view.pinhole_map(_over_photograph(uncertainty, rectifier))
            out.views.append(_view(frame, place, moving, uncertainty, lens_view))
    return out


def _at_expected_scale(given: DynamicsInput) -> DynamicsInput:
    """The frame's own depth, whose scale is its own, brought to that of the depth expected, by their median ratio."""
    own = given.own_inv_depth
    both = None if own is None else (own > 0) & (given.inv_depth > 0)
    if own is None or both is None or not both.any():
        return given
    scale = np.float32(np.median(own[both] / given.inv_depth[both]))
    return replace(given, own_inv_depth=own / scale)


def _view_positions(final: list[FinalFrame], config: Config) -> set[int]:
    """Positions of the training views: keyframes first, then evenly; never holdout, never a guessed pose."""
    usable = [n for n, f in enumerate(final) if not is_holdout(n) and f.state in ("tracked", "started")]
    most = config.mapping.max_views if config.mapping.enabled else 0
    if len(usable) <= most:
        return set(usable)
    return {usable[int(i)] for i in np.linspace(0, len(usable) - 1, most).round()} if most else set()


def _seen_by(image: Array, moving: Array, graph: KeyframeGraph, kf_id: int, place: FinalFrame) -> tuple[Array, Array]:
    """Colours (p, 3) uint8 and P(moving) (p,) of a keyframe's points in a frame's image; outside counts as moving."""
    block, camera = graph.blocks[kf_id], graph.camera()
    if place.record.is_keyframe and place.record.kf_id == kf_id:
        px = block.px
    else:
        cam_from_kf = inverse(place.world_from_cam) @ graph.world_from_cam(kf_id)
        points = transform(cam_from_kf, camera.rays(block.px) / np.maximum(block.inv_depth, 1e-9)[:, None])
        in_front = points[:, 2] > 0
        px = np.where(in_front[:, None], camera.project(np.where(in_front[:, None], points, 1.0)), -1e3)
    inside = (px > -0.5).all(1) & (px[:, 0] < camera.width - 0.5) & (px[:, 1] < camera.height - 0.5)
    at = np.clip(np.round(px), 0, [camera.width - 1, camera.height - 1]).astype(int)
    small = cv2.resize(image, (camera.width, camera.height), interpolation=cv2.INTER_AREA)
    return small[at[:, 1], at[:, 0]], np.where(inside, 1 - static_at(moving, px), 1.0)


def _over_photograph(values: Array, rectifier: Rectifier | None) -> Array:
    """A map over the image that was tracked, as a map over the photograph."""
    return values if rectifier is None else rectifier.as_photograph(values)


def _view(frame: Frame, place: FinalFrame, moving: Array, uncertainty: Array | None, lens_view: LensView) -> View:
    image, inside = lens_view.pinhole_image(frame.image)
    p = cv2.dilate(moving.astype(np.float32), np.ones((5, 5)))  # the edge of a moving thing is not static
    static = np.clip(1 - lens_view.pinhole_map(p), 0.01, 1) * inside  # exactly 0 means: no data
    return View(
        frame.timestamp_s,
        image,
        static.astype(np.float32),
        place.world_from_cam,
        lens_view.pinhole,
        place.record.kf_id,
        uncertainty,
    )


def _uncertainty(
    place: FinalFrame, graph: KeyframeGraph, given: DynamicsInput, flow: HalfFlow, tau_px: float
) -> Array | None:
    """(h, w) u(p) of eq. (16) over the working image; None where no residual is above tau_unc.

    Against keyframes before and after the frame's own: a frame compared with itself shows nothing.
    """
    kf = place.record.kf_id
    near = [kf + n for n in COMPARED if 0 <= kf + n < len(graph.keyframes)]
    others = [n for n in near if graph.submap_of[n] == graph.submap_of[kf]]
    residual_px = reprojection_residual_px(
        graph, others, place.world_from_cam, given.gray, given.inv_depth, flow, RESIDUAL_MAX_PX
    )
    u = uncertainty_weight(np.minimum(residual_px, RESIDUAL_MAX_PX).ravel() ** 2, tau_px).reshape(residual_px.shape)
    if not (u > 0).any():
        return None
    inner = cv2.erode(u.astype(np.float32), np.ones((BLEEDING_PX, BLEEDING_PX)))
    return cv2.resize(inner, graph.size, interpolation=cv2.INTER_NEAREST)


def uncertainty_weight(squared_error: Array, tau_px: float) -> Array:
    """Eq. (16): u = e / max e over R = {e > tau²}, 0 elsewhere; e is a squared norm, tau is in pixels."""
    in_r = squared_error > tau_px**2
    return np.where(in_r, squared_error / squared_error[in_r].max(), 0.0) if in_r.any() else np.zeros(len(in_r))
