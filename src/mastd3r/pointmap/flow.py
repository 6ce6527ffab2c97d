"""Dense optical flow with a start, and sub-pixel refinement of chosen pixels."""

from __future__ import annotations

from dataclasses import dataclass
from threading import local
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from ..types import FeatureMatches
from .feature_matches import around, merged
from .flow_maps import pulled, resized_flow
from .patches import align_patches, wide, window

Array = NDArray[Any]


LEAST_ALIKE = 0.7  # correlation of two patches, below which they show different things
SMOOTH_PX = 5.0  # blur of the dense flow before its slope is taken as the local warp
LARGE_PX = 100_000  # pixels of an image from which on half its size is enough for near flow
SMOOTH_AT = 4  # which is done on a picture so many times smaller
STEP_PX = 3.0  # of those differences
MOST_BENT = 0.45  # largest entry of the local warp's difference from the identity; keeps it invertible
ITERATIONS = 12


@dataclass(frozen=True)
class FlowResult:
    """Flow at the chosen pixels, and the dense field it came from."""

    target: Array  # (p, 2) float64 pixels in the new image
    weight: Array  # (p,) float64 in 0..1 from the forward-backward error; 0 = no match
    dense: Array  # (h', w', 2) float32 ref -> new, at half the size where a start was near


class FlowMatcher:
    """DIS flow from a predicted field, then patch alignment both ways at the chosen pixels."""

    def __init__(self, width: int, height: int, window_px: int = 13, tolerance_px: float = 1.0) -> None:
        self.width, self.height = width, height
        self.tolerance_px = tolerance_px
        self.border_px = window_px // 2 + 1
        self._of_thread = local()
        self._half_size = (width + 1) // 2, (height + 1) // 2
        self._smooth_size = max(width // SMOOTH_AT, 4), max(height // SMOOTH_AT, 4)
        self._window = window(window_px, 0.27 * window_px)

    def _engine(self, name: str) -> Any:
        """``whole``, ``rest`` or ``near``; the calling thread's own: an engine has memory and serves one at a time."""
        if not hasattr(self._of_thread, "engines"):
            whole = cv2.DISOpticalFlow.create(cv2.DISOPTICAL_FLOW_PRESET_MEDIUM)
            rest, near = (cv2.DISOpticalFlow.create(cv2.DISOPTICAL_FLOW_PRESET_FAST) for _ in range(2))
            for engine in (rest, near):
                engine.setFinestScale(1)
            rest.setGradientDescentIterations(12)
            rest.setVariationalRefinementIterations(2)
            self._of_thread.engines = {"whole": whole, "rest": rest, "near": near}
        return self._of_thread.engines[name]

    def dense(self, ref: Array, new: Array, start: Array | None = None, *, near: bool = False) -> Array:
        """(h, w, 2) flow ref -> new. With a start, ``new`` is first warped by it and only the rest is searched.

        ``near``: that is a few pixels, and half the size will do where the image is large; that of the flow is half
        then, too.
        """
        if start is None:
            flow: Array = self._engine("whole").calc(ref, new, None)
            return flow
        near = near and self.width * self.height >= LARGE_PX
        if near:
            ref, new = (cv2.resize(image, self._half_size, interpolation=cv2.INTER_AREA) for image in (ref, new))
        start = resized_flow(start, ref.shape[1], ref.shape[0])
        rest: Array = self._engine("near" if near else "rest").calc(ref, pulled(new, start), None)
        return pulled(start, rest) + rest

    def match(self, ref: Array, new: Array, px: Array, start: Array | None = None, *, near: bool = False) -> FlowResult:
        """Flow at pixels ``px`` (p, 2) of ref, refined to sub-pixel, checked forward and backward.

        ``near``: the start is within a few pixels already, so a quick dense search will do.
        """
        flow = self.dense(ref, new, start, near=near)
        target, weight = self.refine(ref, new, px, flow)
        return FlowResult(target, weight, flow)

    def _inside(self, px: Array) -> Array:
        """Far enough from the border that the window sees no repeated pixels, which would pull matches inwards."""
        edge = self.border_px
        x, y = px[:, 0], px[:, 1]
        return (x >= edge) & (y >= edge) & (x <= self.width - 1 - edge) & (y <= self.height - 1 - edge)

    def refine(self, ref: Array, new: Array, px: Array, flow: Array) -> tuple[Array, Array]:
        """Patches of ref at ``px`` found in new from a dense start, and back again: (p, 2) pixels, (p,) weight."""
        smooth = cv2.GaussianBlur(resized_flow(flow, *self._smooth_size), (0, 0), SMOOTH_PX / SMOOTH_AT)
        ratio = np.array([self.width, self.height]) / self._smooth_size
        return self._patches(ref, new, px, *_local(smooth, px, ratio))

    def match_features(
        self, ref: Array, new: Array, px: Array, texture: Array, start: Array, features: FeatureMatches
    ) -> FlowResult:
        """``match`` where sparse features say how far apart the views are; weights count ``texture`` (p,).

        Searched from dense flow that starts at ``start`` (h, w, 2), and once more from the features around each pixel.
        """
        flow = self.dense(ref, new, start)
        by_flow, flow_weight = self.refine(ref, new, px, flow)
        there, affine, distance = around(features, px)
        by_feature, feature_weight = self._patches(ref, new, px, there, affine)
        inside = self._inside(there) & self._inside(px)
        found = (by_flow, flow_weight * texture), (by_feature, feature_weight * texture)
        return FlowResult(*merged(*found, there, distance, inside), flow)

    def _patches(self, ref: Array, new: Array, px: Array, start: Array, affine: Array) -> tuple[Array, Array]:
        """``refine`` from a start (p, 2) and a local warp (p, 2, 2) of each pixel."""
        a, b = wide(ref), wide(new)
        target, alike = align_patches(a, b, px, start, affine, self._window, ITERATIONS)
        again = np.where(alike[:, None] > LEAST_ALIKE, target, -1.0)  # outside: not looked at
        back, alike_back = align_patches(b, a, again, px, np.linalg.inv(affine), self._window, ITERATIONS)
        error = np.linalg.norm(back - px, axis=1)
        ok = (
            self._inside(target)
            & self._inside(px)
            & (np.minimum(alike, alike_back) > LEAST_ALIKE)
            & (error < self.tolerance_px)
            & (np.linalg.norm(target - start, axis=1) < 6.0)
        )
        return target, np.where(ok, np.exp(-((error / (0.5 * self.tolerance_px)) ** 2)), 0.0)


def _local(flow: Array, px: Array, ratio: Array) -> tuple[Array, Array]:
    """Where ``px`` (p, 2) go, and the warp around them (p, 2, 2) d new / d ref, by differences over a step.

    ``flow`` (h', w', 2) px of a picture that is smaller by ``ratio`` (2,).
    """
    at = ((px + 0.5) / ratio - 0.5).astype(np.float32)[:, None]

    def flow_at(dx: float, dy: float) -> Array:
        moved = at + np.array([dx, dy], np.float32)
        return cv2.remap(flow, moved, None, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)[:, 0] * ratio

    step = STEP_PX / ratio
    across, down = flow_at(step[0], 0) - flow_at(-step[0], 0), flow_at(0, step[1]) - flow_at(0, -step[1])
    slope = np.stack([across, down], -1) / (2 * STEP_PX)
    return px + flow_at(0, 0), np.clip(slope, -MOST_BENT, MOST_BENT) + np.eye(2)


def corner_grid(gray: Array, cell_px: int) -> tuple[Array, Array]:
    """The most corner-like pixel of every cell: (p, 2) float64 pixels and (p,) smaller eigenvalue, in grey² a px².

    The last partial row and column of cells is left out, so p depends on the image size only.
    """
    strength = cv2.cornerMinEigenVal(gray, 5, ksize=3)
    h, w = gray.shape[0] // cell_px * cell_px, gray.shape[1] // cell_px * cell_px
    rows, cols = h // cell_px, w // cell_px
    cells = strength[:h, :w].reshape(rows, cell_px, cols, cell_px).transpose(0, 2, 1, 3).reshape(rows * cols, -1)
    best = cells.argmax(1)
    cy, cx = np.divmod(np.arange(rows * cols), cols)
    px = np.stack([cx * cell_px + best % cell_px, cy * cell_px + best // cell_px], 1).astype(float)
    return px, cells[np.arange(len(best)), best]
