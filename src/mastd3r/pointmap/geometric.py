"""Pointmaps from images alone: dense flow, the lens found by the graph, and triangulation (the embedded default)."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from ..camera.pinhole import Camera
from ..types import Frame, Guess, Matches, PairPrediction, Pointmap, WorkFrame
from .base import Observing
from .flow import FlowMatcher, corner_grid

Array = NDArray[Any]
# Strength of a corner (``corner_grid``) in squared gradients of an image in 0..1: below FLAT its gradient is less than
# a grey level, which is noise that flow follows wherever the smooth field leads it; from SURE on twice that.
FLAT, SURE = 1e-5, 4e-5


def working_size(width: int, height: int, area_px: int) -> tuple[int, int]:
    """Size with about ``area_px`` pixels and the same shape; never larger than the image."""
    scale = min(1.0, float(np.sqrt(area_px / (width * height))))
    return max(16, round(width * scale)), max(16, round(height * scale))


class GeometricPointmaps(Observing):
    """Provider that needs no weights and no depth sensor."""

    name = "geometric"
    depth_sigma_ratio: float | None = None
    finds_far = False
    side_by_side = True

    def __init__(self, width: int, height: int, cell_px: int) -> None:
        self.width, self.height, self.cell_px = width, height, cell_px
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

    def beside(self, work: WorkFrame, near: WorkFrame | None) -> WorkFrame:
        """The frame as it is: all that is known of it is known alone."""
        return work

    def expect(self, pairs: Sequence[tuple[WorkFrame, WorkFrame]]) -> None:
        """Nothing to prepare."""

    def predict(self, ref: WorkFrame, new: WorkFrame, guess: Guess) -> PairPrediction:
        """Match ref's pixels in new; points by ref's depth where it is known, by triangulation otherwise."""
        found = self.flow.match(ref.gray, new.gray, ref.px, guess.flow, near=guess.flow_is_near)
        matches = Matches(ref.px, found.target, found.weight * ref.texture)
        rays = guess.camera.rays(ref.px)
        ref_map = _known_points(ref.px, rays, guess)
        new_map = ref_map
        if guess.new_from_ref is not None:
            inv_depth, confidence = triangulate(matches, guess.new_from_ref, guess.camera)
            points = rays / np.maximum(inv_depth, 1e-6)[:, None]
            new_map = Pointmap(found.target, points, confidence)
            if guess.ref_inv_depth is None:
                ref_map = Pointmap(ref.px, points, confidence)
        return PairPrediction(matches, ref_map, new_map, self._own_points(new, matches, guess.camera), found.dense)

    def _own_points(self, new: WorkFrame, matches: Matches, camera: Camera) -> Pointmap | None:
        return None


def _known_points(px: Array, rays: Array, guess: Guess) -> Pointmap:
    if guess.ref_inv_depth is None:
        return Pointmap(px, rays, np.zeros(len(px)))
    depth = 1 / np.maximum(guess.ref_inv_depth, 1e-6)
    info = np.zeros(len(px)) if guess.ref_depth_info is None else guess.ref_depth_info
    sigma_ratio = 1 / np.sqrt(np.maximum(info, 1e-12)) * depth
    return Pointmap(px, rays * depth[:, None], 1 / (1 + (sigma_ratio / 0.1) ** 2))


def triangulate(matches: Matches, new_from_ref: Array, camera: Camera) -> tuple[Array, Array]:
    """Inverse depth (p,) in ref of each match under a known pose, and an honest confidence (p,) in 0..1.

    Linear in the inverse depth: cross(ray_new, R ray_ref + t d) = 0. The confidence is the match's weight, times
    how surely the parallax fixes the depth (1 px of noise), times how well the match keeps the epipolar line.
    """
    rotated = camera.rays(matches.ref_px) @ new_from_ref[:3, :3].T
    rays_new = camera.rays(matches.new_px)
    t = new_from_ref[:3, 3]
    # pixel rows: x' (rz + tz d) = rx + tx d
    a = t[:2] - rays_new[:, :2] * t[2]
    b = rays_new[:, :2] * rotated[:, 2:] - rotated[:, :2]
    norm = (a**2).sum(1)
    inv_depth = (a * b).sum(1) / np.maximum(norm, 1e-12)
    epipolar_px = np.abs(a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]) / np.sqrt(np.maximum(norm, 1e-12)) * camera.fx_px
    sigma = 1 / (np.sqrt(np.maximum(norm, 1e-12)) * camera.fx_px)
    sure = 1 / (1 + (sigma / np.maximum(inv_depth, 1e-6) / 0.1) ** 2)
    confidence = matches.weight * sure * np.exp(-0.5 * epipolar_px**2) * (inv_depth > 0)
    return np.maximum(inv_depth, 1e-6), confidence


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
    rays = camera.rays(px)
    points = rays / np.maximum(inv_depth, 1e-6)[:, None]
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
