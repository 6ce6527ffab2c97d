"""Where a photograph was taken from, read off the finished map: direct alignment of one picture of it.

The map is drawn once, at the pose that tracking found; the photograph is then aligned with that picture by its
intensities, through the depth that was drawn (inverse compositional, Baker and Matthews 2004, on SE(3)). A gain and a
bias are fitted beside the pose, so that the exposure does not move it, and the residual is cut robustly.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from ..camera.pinhole import Camera
from ..geometry.se3 import inverse, se3_exp
from .gaussians import Array

ROUNDS = 12
BLUR_PX = 1.0  # both pictures are smoothed by this: a render is softer than a photograph
TUKEY = 4.685  # times the scale of the residuals
LEAST_PIXELS = 500
MOST_PIXELS = 10_000  # of a picture; more tell no more
STILL_PX = 0.01  # a step that moves the picture by less is the last
FARTHEST_PX = 4.0  # a photograph that would move by more (mean over its pixels) stays where tracking put it
GAIN = 1.02  # of the residual, at least, for a new pose to count


@dataclass(frozen=True)
class Placed:
    """A pose read off the map."""

    world_from_cam: Array  # (4, 4)
    moved_px: float  # mean distance over the pixels, from where it was before
    residual_before: float  # robust scale of the intensity residual, 0..1
    residual: float
    accepted: bool  # False: ``world_from_cam`` is the pose that came in


@dataclass(frozen=True)
class _Template:
    """The drawn picture's pixels that say something, and how they change with the pose."""

    points: Array  # (n, 3) camera frame
    px: Array  # (n, 2)
    value: Array  # (n,)
    jacobian: Array  # (n, 6)
    weight: Array  # (n,)


def placed(
    drawn: tuple[Array, Array, Array], camera: Camera, photograph: Array, weight: Array, world_from_cam: Array
) -> Placed:
    """The pose of ``photograph`` (h, w) float32 0..1 in grey, near ``world_from_cam`` from where ``drawn`` was drawn.

    ``drawn``: grey (h, w), depth (h, w; 0 where nothing is), alpha (h, w). ``weight`` (h, w): how surely a pixel shows
    the static world, 0 to leave it out. Never raises for what the pictures cannot give: then the pose comes back.
    """
    template = _template(drawn, camera, weight)
    if template is None:
        return Placed(world_from_cam, 0.0, np.nan, np.nan, False)
    smooth = cv2.GaussianBlur(np.ascontiguousarray(photograph, np.float32), (0, 0), BLUR_PX)
    photo_from_drawn = np.eye(4)
    before = found = np.nan
    for number in range(ROUNDS):
        residual, inside = _residual(template, camera, smooth, photo_from_drawn)
        if inside.sum() < LEAST_PIXELS:
            return Placed(world_from_cam, 0.0, np.nan, np.nan, False)
        scale = max(1.4826 * float(np.median(np.abs(residual[inside]))), 1e-4)
        before, found = (scale, scale) if number == 0 else (before, scale)
        u = residual / (TUKEY * scale)
        robust = template.weight * inside * np.where(np.abs(u) < 1, (1 - u * u) ** 2, 0)
        normal = (template.jacobian * robust[:, None]).T @ template.jacobian
        right = (template.jacobian * robust[:, None]).T @ residual
        damped = normal + 1e-6 * np.trace(normal) / 6 * np.diag([0.0, 0, 0, 1, 1, 1]) + 1e-12 * np.eye(6)
        step = se3_exp(np.linalg.solve(damped, right))
        photo_from_drawn = photo_from_drawn @ inverse(step)
        if _motion_px(template, camera, step) < STILL_PX:
            break
    residual, inside = _residual(template, camera, smooth, photo_from_drawn)
    found = max(1.4826 * float(np.median(np.abs(residual[inside]))), 1e-4) if inside.any() else np.inf
    moved = _motion_px(template, camera, photo_from_drawn)
    if not np.isfinite(moved) or moved > FARTHEST_PX or found * GAIN > before:
        return Placed(world_from_cam, 0.0, before, before, False)
    return Placed(world_from_cam @ inverse(photo_from_drawn), moved, before, found, True)


def _template(drawn: tuple[Array, Array, Array], camera: Camera, weight: Array) -> _Template | None:
    grey, depth, alpha = drawn
    smooth = cv2.GaussianBlur(np.ascontiguousarray(grey, np.float32), (0, 0), BLUR_PX)
    gx, gy = (cv2.Scharr(smooth, cv2.CV_32F, *way) / 32 for way in ((1, 0), (0, 1)))
    border = np.zeros(grey.shape, bool)
    border[4:-4, 4:-4] = True
    use = border & (depth > 0) & (alpha > 0.8) & (weight > 0) & (np.hypot(gx, gy) > 0.002)
    y, x = np.nonzero(use)
    if len(x) < LEAST_PIXELS:
        return None
    few = np.linspace(0, len(x) - 1, min(len(x), MOST_PIXELS)).astype(int)
    y, x = y[few], x[few]
    px = np.stack([x, y], 1).astype(float)
    points = camera.rays(px) * depth[y, x].astype(float)[:, None]
    px_by_pose = _pixel_by_pose(points, camera)
    jacobian = gx[y, x, None] * px_by_pose[:, 0] + gy[y, x, None] * px_by_pose[:, 1]
    return _Template(points, px, smooth[y, x].astype(float), jacobian, weight[y, x].astype(float))


def _pixel_by_pose(points: Array, camera: Camera) -> Array:
    """(n, 2, 6): d pixel / d (shift, turn) of the points, at no motion."""
    x, y, z = points.T
    zero, fx, fy = np.zeros_like(z), camera.fx_px, camera.fy_px
    u = np.stack([fx / z, zero, -fx * x / z**2, -fx * x * y / z**2, fx * (1 + (x / z) ** 2), -fx * y / z], 1)
    v = np.stack([zero, fy / z, -fy * y / z**2, -fy * (1 + (y / z) ** 2), fy * x * y / z**2, fy * x / z], 1)
    return np.stack([u, v], 1)


def _residual(template: _Template, camera: Camera, photograph: Array, photo_from_drawn: Array) -> tuple[Array, Array]:
    """Photograph (under the best gain and bias) minus picture at the template's pixels, and which are inside."""
    points = template.points @ photo_from_drawn[:3, :3].T + photo_from_drawn[:3, 3]
    in_front = points[:, 2] > 1e-6
    px = camera.project(np.where(in_front[:, None], points, 1.0)).astype(np.float32)
    inside = in_front & (px > 0).all(1) & (px[:, 0] < camera.width - 1) & (px[:, 1] < camera.height - 1)
    # cv2.remap takes at most 32767 pixels a row, so the samples are laid out in rows
    rows = -(-len(px) // 4096)
    at = np.zeros((rows * 4096, 2), np.float32)
    at[: len(px)] = px
    value = (
        cv2.remap(photograph, at.reshape(rows, 4096, 2), None, cv2.INTER_LINEAR).reshape(-1)[: len(px)].astype(float)
    )
    gain, bias = _exposure(value[inside], template.value[inside]) if inside.any() else (1.0, 0.0)
    return np.where(inside, gain * value + bias - template.value, 0.0), inside


def _exposure(value: Array, wanted: Array) -> tuple[float, float]:
    """Gain and bias that bring one to the other, by least squares over the middle nine tenths of the differences."""
    keep = np.ones(len(value), bool)
    gain, bias = 1.0, 0.0
    for _ in range(2):
        v, w = value[keep], wanted[keep]
        spread = float(v.var())
        gain = float(np.clip(((v - v.mean()) * (w - w.mean())).mean() / max(spread, 1e-9), 0.5, 2.0))
        bias = float(w.mean() - gain * v.mean())
        error = np.abs(gain * value + bias - wanted)
        keep = error <= np.quantile(error, 0.9)
    return gain, bias


def _motion_px(template: _Template, camera: Camera, motion: Array) -> float:
    """How far a motion moves the picture: mean over the pixels."""
    points = template.points @ motion[:3, :3].T + motion[:3, 3]
    if (points[:, 2] <= 0).any():
        return np.inf
    return float(np.linalg.norm(camera.project(points) - template.px, axis=1).mean())
