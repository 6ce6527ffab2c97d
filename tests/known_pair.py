"""What a perfect two-view network would say of two views of the made room, from its exact depths and poses."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from mastd3r.camera.pinhole import Camera
from mastd3r.geometry.se3 import inverse, transform
from mastd3r.sources import synthetic
from mastd3r.sources.room import RayGrid, Room, camera_pose
from mastd3r.sources.synthetic import room_camera

Array = NDArray[Any]
WAVE_M = 0.15  # length scale of the descriptors: 1 px of the room is about 1 cm


@dataclass(frozen=True)
class Maps:
    """One view of a decoded pair."""

    points: Array  # (h, w, 3) float32 in the first view's camera
    confidence: Array  # (h, w) float32
    descriptors: Array  # (h, w, 24) float32
    descriptor_confidence: Array  # (h, w) float32


@dataclass(frozen=True)
class RoomView:
    """One look into the room, exact."""

    camera: Camera
    world_from_cam: Array
    points_cam: Array  # (h, w, 3) float64
    points_world: Array  # (h, w, 3) float64


def room() -> Room:
    return synthetic.Room(0)  # made once: see conftest.py


def look(time_s: float, camera: Camera | None = None) -> RoomView:
    """The room from where the camera is at ``time_s``; the ball rests where it was at 0 s."""
    camera = camera or room_camera(192, 144)
    pose = camera_pose(time_s)
    depth = room().cast(RayGrid(camera), pose, 0.0).depth.reshape(camera.height, camera.width)
    return view_of(camera, pose, depth)


def view_of(camera: Camera, world_from_cam: Array, depth: Array) -> RoomView:
    """A view from its exact depth (h, w)."""
    points = camera.rays(camera.pixel_grid()) * depth[..., None].astype(float)
    return RoomView(camera, world_from_cam, points, moved(world_from_cam, points))


def moved(a_from_b: Array, points: Array) -> Array:
    """(h, w, 3) points of b in a."""
    return transform(a_from_b, points.reshape(-1, 3)).reshape(points.shape)


def described(points_world: Array, noise: float = 0.0, seed: int = 0) -> Array:
    """(h, w, 24) float32 unit descriptors that change smoothly with the place, plus noise a component."""
    waves = np.random.default_rng(7).normal(0, 1 / WAVE_M, (12, 3))
    phase = points_world @ waves.T
    out = np.concatenate([np.sin(phase), np.cos(phase)], -1) / np.sqrt(12)
    out += noise / np.sqrt(12) * np.random.default_rng(seed).normal(size=out.shape)
    return (out / np.linalg.norm(out, axis=-1, keepdims=True)).astype(np.float32)


def decoded(first: RoomView, second: RoomView, noise: float = 0.0) -> tuple[Maps, Maps]:
    """Both views' maps in the first one's camera."""
    first_from_second = inverse(first.world_from_cam) @ second.world_from_cam
    sure = np.full(first.points_cam.shape[:2], 5.0, np.float32)
    sure_too = np.full(second.points_cam.shape[:2], 5.0, np.float32)
    points = moved(first_from_second, second.points_cam).astype(np.float32)
    return (
        Maps(first.points_cam.astype(np.float32), sure, described(first.points_world, noise, 1), sure),
        Maps(points, sure_too, described(second.points_world, noise, 2), sure_too),
    )


@dataclass(frozen=True)
class Truth:
    """Where pixels of the second view are in the first."""

    px: Array  # (n, 2)
    in_view: Array  # (n,) bool, 2 px off the border
    gap: Array  # (n,) depth of what the first view sees there over that of the pixel's point; < 1: hidden
    smooth: Array  # (n,) bool: no edge of a surface within 3 px, in either view

    @property
    def seen(self) -> Array:
        return self.in_view & (np.abs(self.gap - 1) < 0.03)

    @property
    def hidden(self) -> Array:
        """Well behind another surface, and no neighbour of its edge."""
        return self.in_view & (self.gap < 0.8)


def truth_of(first: RoomView, second: RoomView, px: Array) -> Truth:
    """Exact places of the second view's whole pixels in the first view."""
    x, y = px.astype(int).T
    points = transform(inverse(first.world_from_cam) @ second.world_from_cam, second.points_cam[y, x])
    at = first.camera.project(points)
    h, w = first.points_cam.shape[:2]
    inside = ((at >= 2) & (at <= [w - 3, h - 3])).all(1) & (points[:, 2] > 0.1)
    near = np.round(np.where(inside[:, None], at, 2)).astype(int)
    around = np.stack([first.points_cam[near[:, 1] + j, near[:, 0] + i, 2] for i in (-2, 0, 2) for j in (-2, 0, 2)])
    gap = around / points[:, 2]
    gap = gap[np.abs(np.log(np.where(inside, gap, 1))).argmin(0), np.arange(len(px))]  # hidden: all are in front
    smooth = _smooth(first)[near[:, 1], near[:, 0]] & _smooth(second)[y, x]
    return Truth(at, inside, gap, smooth)


def _smooth(view: RoomView) -> Array:
    """(h, w) bool: the direction in which the surface faces does not change within 3 px."""
    along = np.stack([np.gradient(1 / view.points_cam[..., 2], axis=n) for n in (0, 1)], -1) * view.points_cam[..., 2:]
    spread = cv2.dilate(along, np.ones((7, 7))) - cv2.erode(along, np.ones((7, 7)))
    return np.asarray((spread < 1e-3).all(-1))


def with_noise(maps: Maps, ray_sigma: float, seed: int = 0) -> Maps:
    """Points with smooth errors across their rays of about ``ray_sigma`` of the distance, as a network's are."""
    rng = np.random.default_rng(seed)
    h, w = maps.points.shape[:2]
    coarse = rng.normal(0, 1, (h // 8 + 2, w // 8 + 2, 3)).astype(np.float32)
    error = cv2.resize(coarse, (w, h), interpolation=cv2.INTER_CUBIC)
    error *= ray_sigma / float(error.std())
    length = np.linalg.norm(maps.points, axis=-1, keepdims=True)
    return replace(maps, points=(maps.points + error * length).astype(np.float32))
