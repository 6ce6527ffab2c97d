"""Every frame's pose once more, read off the finished map: what ships with the splat agrees with it."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from ..camera.map_view import MapView
from ..camera.opencv_lens import OpenCvLens
from ..camera.pinhole import Camera
from ..errors import InputError
from ..evaluation.mask_error import read_mask
from ..export.run_folder import stamp
from ..mapping.placing import placed
from ..mapping.splat import Splat
from ..types import MEASURED, Frame
from .final_solve import FinalFrame
from .smoothing import view_static

Array = NDArray[Any]
WIDTH_PX = 400  # of the pictures that are aligned
SURELY_STATIC = 0.5  # pixels with less do not count
LEAST_ACCEPTED = 0.5  # of the frames; with fewer the map is not what the frames show, and every pose stays
START_ROUNDS_PX = 1.0  # a photograph that moved by more is drawn and aligned once more


@dataclass(frozen=True)
class Placement:
    """The frames, and how far they went."""

    final: list[FinalFrame]
    facts: dict[str, Any]  # for run.json


def place_frames(
    frames: Iterator[Frame],
    final: list[FinalFrame],
    splat: Splat,
    lens: Camera | OpenCvLens,
    start: Callable[[FinalFrame], Array],
    masks: Path,
    advance: Callable[[], None],
) -> Placement:
    """Align every tracked photograph with the splat; ``start`` gives the pose (4, 4) to begin from.

    Holdout photographs too: the map has never seen them and does not now, they are localised in it. ``masks``: the
    run's folder of P(moving). A frame that cannot be aligned keeps its pose.
    """
    view = MapView(lens, WIDTH_PX, 1.0)
    place = {f.record.index: n for n, f in enumerate(final)}
    out, moved, tried = list(final), [], 0
    for frame in frames:
        n = place.get(frame.index)
        if n is None:
            continue
        if final[n].state in MEASURED and np.isfinite(final[n].world_from_cam).all():
            tried += 1
            found = _placed(frame, view, splat, start(final[n]), masks)
            if found is not None:
                moved.append(found[1])
                out[n] = replace(final[n], world_from_cam=found[0])
        advance()
    enough = len(moved) >= LEAST_ACCEPTED * max(tried, 1)
    facts = {
        "frames": tried,
        "placed": len(moved) if enough else 0,
        "moved_px_median": float(np.median(moved)) if moved else None,
        "width_px": view.camera.width,
    }
    return Placement(out if enough else final, facts)


def _placed(frame: Frame, view: MapView, splat: Splat, pose: Array, masks: Path) -> tuple[Array, float] | None:
    """World from camera of one photograph, and how far it went (px); None where it could not be aligned."""
    image, inside = view.pinhole_image(frame.as_taken.image)
    grey = cv2.cvtColor(image, cv2.COLOR_RGB2GRAY).astype(np.float32) / 255
    weight = _static(masks / f"{stamp(frame.timestamp_s)}.png", inside, view)
    total = 0.0
    for _ in range(2):
        color, depth, alpha = splat.render(pose, view.pinhole)
        drawn = cv2.cvtColor(color, cv2.COLOR_RGB2GRAY), depth, alpha
        found = placed(drawn, view.pinhole, grey, weight, pose)
        if not found.accepted:
            return (pose, total) if total else None
        pose, total = found.world_from_cam, total + found.moved_px
        if found.moved_px < START_ROUNDS_PX:
            break
    return pose, total


def _static(mask: Path, inside: Array, view: MapView) -> Array:
    """(h, w) P(static) where it is above one half, else 0, as where ``inside`` (h, w) is 0."""
    try:
        moving = read_mask(mask).astype(np.float32) / 255
    except InputError:  # a frame without a mask
        return inside
    static = view_static(moving, inside, view)
    return np.asarray(static * (static > SURELY_STATIC), np.float32)
