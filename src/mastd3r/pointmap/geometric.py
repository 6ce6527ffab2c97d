"""Pointmaps from images alone: dense flow, and depths and lens as the graph finds them (the embedded default)."""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from ..camera.pinhole import Camera
from ..config import Config
from ..errors import InputError
from ..types import Frame, Guess, Matches, PairPrediction, Pointmap, Source, WorkFrame
from .base import Provider
from .flow import FlowMatcher, corner_grid

Array = NDArray[Any]
# Strength of a corner (``corner_grid``) in squared gradients of an image in 0..1: below FLAT its gradient is less than
# a grey level, which is noise that flow follows wherever the smooth field leads it; from SURE on twice that.
FLAT, SURE = 1e-5, 4e-5


def working_size(width: int, height: int, area_px: int) -> tuple[int, int]:
    """Size with about ``area_px`` pixels and the same shape; never larger than the image."""
    scale = min(1.0, float(np.sqrt(area_px / (width * height))))
    return max(16, round(width * scale)), max(16, round(height * scale))


class GeometricPointmaps(Provider):
    """Provider that needs no weights and no depth sensor."""

    name = "geometric"

    def __init__(self, width: int, height: int, cell_px: int) -> None:
        self.width, self.height, self.cell_px = width, height, cell_px
        self.size = (width, height)
        self.flow = FlowMatcher(width, height)

    def look(self, frame: Frame) -> WorkFrame:
        """Shrink to working size and choose the pixels that will be matched."""
        gray = cv2.cvtColor(frame.image, cv2.COLOR_RGB2GRAY)
        gray = cv2.resize(gray, (self.width, self.height), interpolation=cv2.INTER_AREA)
        px, strength = corner_grid(gray, self.cell_px)
        texture = np.clip(strength / max(0.5 * float(np.median(strength)), 1e-5), 0.0, 1.0)
        texture *= np.clip((strength - FLAT) / (SURE - FLAT), 0.0, 1.0)
        semantic = None
        if frame.semantic is not None:
            semantic = cv2.resize(frame.semantic.astype(np.float32), (self.width, self.height))
        grid = (self.height // self.cell_px, self.width // self.cell_px)
        return WorkFrame(frame.index, frame.timestamp_s, gray, px, grid, texture, semantic, self._own_inv_depth(frame))

    def _own_inv_depth(self, frame: Frame) -> Array | None:
        return None

    def predict(self, ref: WorkFrame, new: WorkFrame, guess: Guess) -> PairPrediction:
        """Match ref's pixels in new, eq. (7); ref's points stand at the depth that is known of them."""
        if guess.features is not None and guess.flow is not None:
            views = ref.gray, new.gray, ref.px, ref.texture
            found = self.flow.match_features(*views, guess.flow, guess.features)
            matches = Matches(ref.px, found.target, found.weight)
        else:
            found = self.flow.match(ref.gray, new.gray, ref.px, guess.flow, near=guess.flow_is_near)
            matches = Matches(ref.px, found.target, found.weight * ref.texture)
        ref_map = _known_points(ref.px, guess.camera.rays(ref.px), guess)
        return PairPrediction(matches, ref_map, self._own_points(new, matches, guess.camera), found.dense)

    def _own_points(self, new: WorkFrame, matches: Matches, camera: Camera) -> Pointmap | None:
        return None


def _known_points(px: Array, rays: Array, guess: Guess) -> Pointmap:
    if guess.ref_inv_depth is None:
        return Pointmap(px, rays, np.zeros(len(px)))
    depth = 1 / np.maximum(guess.ref_inv_depth, 1e-6)
    info = np.zeros(len(px)) if guess.ref_depth_info is None else guess.ref_depth_info
    sigma_ratio = 1 / np.sqrt(np.maximum(info, 1e-12)) * depth
    return Pointmap(px, rays * depth[:, None], 1 / (1 + (sigma_ratio / 0.1) ** 2))


class SensorDepthPointmaps(GeometricPointmaps):
    """Provider whose depth comes with the frames (a TUM-layout folder): real pointmaps of a network's kind."""

    name = "depth"
    depth_sigma_ratio: float | None = 0.02

    def _own_inv_depth(self, frame: Frame) -> Array | None:
        if frame.depth_m is None:
            return np.zeros((self.height, self.width), np.float32)
        depth = cv2.resize(frame.depth_m, (self.width, self.height), interpolation=cv2.INTER_NEAREST)
        return np.where(depth > 0, 1 / np.maximum(depth, 1e-6), 0).astype(np.float32)

    def _own_points(self, new: WorkFrame, matches: Matches, camera: Camera) -> Pointmap | None:
        return points_from_own_depth(new, matches.new_px, matches.weight, camera)


def points_from_own_depth(frame: WorkFrame, px: Array, weight: Array, camera: Camera) -> Pointmap:
    """A frame's own measured depth at ``px`` as points in its own camera; confidence 0 where it has none."""
    inv_depth = sample_own(frame, px)
    points = camera.unproject(px, np.maximum(inv_depth, 1e-6))
    return Pointmap(px, points, np.where(inv_depth > 0, weight, 0.0))


def sample_own(frame: WorkFrame, px: Array) -> Array:
    """Own inverse depth (p,) at the nearest pixel; 0 where none, at depth edges and outside."""
    own = frame.own_inv_depth
    if own is None:
        return np.zeros(len(px))
    low, high = cv2.erode(own, np.ones((3, 3))), cv2.dilate(own, np.ones((3, 3)))
    smooth = np.where((low > 0) & (high < 1.05 * low), own, 0)
    x = np.clip(np.round(px[:, 0]).astype(int), 0, own.shape[1] - 1)
    y = np.clip(np.round(px[:, 1]).astype(int), 0, own.shape[0] - 1)
    return smooth[y, x].astype(float)


def build_geometric(config: Config, source: Source) -> GeometricPointmaps:
    """The provider for a source, at the working size that the options give."""
    return GeometricPointmaps(*working_size(*source.size, config.tracking.area_px), config.tracking.cell_px)


def build_sensor_depth(config: Config, source: Source) -> SensorDepthPointmaps:
    """The same with the depth that the frames carry. Raises InputError for a source without depth."""
    if not source.has_depth:
        raise InputError(f"--pointmaps depth: expected a TUM-layout folder with depth.txt, {source.name} has no depth")
    return SensorDepthPointmaps(*working_size(*source.size, config.tracking.area_px), config.tracking.cell_px)
