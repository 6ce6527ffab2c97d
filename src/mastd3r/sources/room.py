"""A furnished room with a rolling ball, ray-cast in numpy: exact depth, exact mask, exact poses.

Room coordinates: metres, x right, y DOWN, z forward; the floor is y = 1.30. The camera moves about the
origin. Arrays over rays have the rays last, (3, n): numpy is several times faster that way.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from ..camera.pinhole import Camera
from . import room_textures as tex

Array = NDArray[Any]
ROOM_LOW = np.array([-2.6, -1.25, -1.6], np.float32)
ROOM_HIGH = np.array([2.6, 1.30, 3.9], np.float32)
LIGHT = np.array([-0.5, -1.1, 1.0], np.float32)
BALL_RADIUS_M = 0.34


@dataclass(frozen=True)
class Box:
    """A piece of furniture: a cuboid turned about the vertical axis."""

    centre: tuple[float, float, float]
    size: tuple[float, float, float]
    yaw_deg: float
    texture: int  # texture of the sides; the next one is that of the top


@dataclass(frozen=True)
class Hit:
    """What rays see. n rays."""

    depth: Array  # (n,) float32, along the ray whose direction has z_cam = 1
    texture: Array  # (n,) int32
    uv: Array  # (2, n) float32 in 0..1
    normal: Array  # (3, n) float32
    ball: Array  # (n,) bool


class RayGrid:
    """The rays of all pixels of a camera, row by row."""

    def __init__(self, camera: Camera) -> None:
        self.camera = camera
        self.rays_cam = np.ascontiguousarray(camera.rays(camera.pixel_grid()).reshape(-1, 3).T, np.float32)
        self.length = np.sqrt((self.rays_cam**2).sum(0))

    def directions(self, world_from_cam: Array) -> Array:
        """Ray directions in the room, (3, n) float32, z_cam = 1."""
        out: Array = world_from_cam[:3, :3].astype(np.float32) @ self.rays_cam
        return out


class Room:
    """The room of one seed. Everything but the ball stands still."""

    def __init__(self, seed: int = 0) -> None:
        rng = np.random.default_rng(seed)
        textures = _walls(rng)
        self.boxes: list[Box] = []
        for centre, size, yaw, side, top in _furniture():
            self.boxes.append(Box(centre, size, yaw, len(textures)))
            textures.append(side(size[1], max(size[0], size[2]), rng))
            textures.append(top(size[2], size[0], rng))
        _darken_floor(textures[3], self.boxes)
        self.ball_texture = len(textures)
        textures.append(tex.ball(np.pi * BALL_RADIUS_M, 2 * np.pi * BALL_RADIUS_M, rng))
        self.atlas = tex.make_atlas(textures)

    def cast(self, grid: RayGrid, world_from_cam: Array, time_s: float) -> Hit:
        """First surfaces along the rays of a camera that stands at ``world_from_cam`` (4, 4)."""
        camera, rays = grid.camera, grid.directions(world_from_cam)
        origin = world_from_cam[:3, 3].astype(np.float32)
        hit = _cast_walls(rays, origin)
        number = np.arange(camera.height * camera.width).reshape(camera.height, camera.width)
        for box in self.boxes:
            part = _window(box, camera, world_from_cam)
            if part is not None:
                _cast_box(box, rays, origin, number[part].ravel(), hit)
        _cast_ball(rays, origin, time_s, self.ball_texture, hit)
        return hit

    def shade(self, hit: Hit, grid: RayGrid, world_from_cam: Array) -> Array:
        """Colours of hits, (n, 3) float32 0..255: texture times Lambert light, corners a little darker."""
        rays = grid.directions(world_from_cam)
        points = world_from_cam[:3, 3, None].astype(np.float32) + rays * hit.depth
        slant = np.abs(_dot(rays, hit.normal)) / grid.length
        texel_px = np.float32(1 / (grid.camera.fx_px * tex.TEXEL_M))
        colour = self.atlas.sample(hit.texture, hit.uv, hit.depth * texel_px / np.sqrt(np.maximum(slant, 0.05)))
        to_light = LIGHT[:, None] - points
        away2 = _dot(to_light, to_light)
        lambert = np.maximum(_dot(to_light, hit.normal), 0) / (np.sqrt(away2) * (1 + np.float32(0.06) * away2))
        x, y, z = np.minimum(points - ROOM_LOW[:, None], ROOM_HIGH[:, None] - points)
        second = np.maximum(np.minimum(x, y), np.minimum(np.maximum(x, y), z))  # of the three distances
        corner = 1 - np.float32(0.3) * np.exp(np.maximum(second, 0) * np.float32(-1 / 0.22))
        light = (np.float32(0.58) + np.float32(0.62) * lambert) * np.where(hit.ball, np.float32(1), corner)
        lit: Array = colour * light[:, None]
        return lit


def _dot(a: Array, b: Array) -> Array:
    out: Array = a[0] * b[0] + a[1] * b[1] + a[2] * b[2]
    return out


def ball_pose(time_s: float) -> tuple[Array, Array]:
    """Centre (3,) and rotation room_from_ball (3, 3) of the ball, which rolls to and fro on the floor."""
    phase = 2 * np.pi * time_s / 5.0
    x = 0.25 + 1.05 * np.cos(phase)
    z = 2.05 + 0.30 * np.sin(0.8 * phase)
    y = ROOM_HIGH[1] - BALL_RADIUS_M - 0.42 * abs(np.sin(2 * np.pi * time_s / 1.5))  # and bounces
    turn = Rotation.from_rotvec([0, 0, (x - 0.25) / BALL_RADIUS_M]) * Rotation.from_rotvec([0.4, 0, 0.2])
    return np.array([x, y, z], np.float32), turn.as_matrix().astype(np.float32)


def camera_pose(time_s: float) -> Array:
    """world_from_cam (4, 4) float64 of a hand-held camera that walks an arc, about 0.6 m/s.

    A smooth arc, with the sway of steps and a slight shake on top; it looks at a point that wanders.
    """
    phase = 2 * np.pi * time_s / 7.0
    position = np.array([-0.85 * np.cos(phase), -0.05, -0.55 + 0.45 * np.sin(phase)])
    position += [0.012 * np.sin(5.1 * time_s), 0.016 * np.sin(11.3 * time_s), 0.01 * np.sin(6.7 * time_s + 1)]
    target = np.array([0.05 - 0.25 * np.cos(1.3 * phase), 0.32 + 0.08 * np.sin(2.1 * phase), 2.6])
    forward = (target - position) / np.linalg.norm(target - position)
    right = np.cross([0, 1.0, 0], forward)
    right /= np.linalg.norm(right)
    pose = np.eye(4)
    pose[:3, :3] = np.stack([right, np.cross(forward, right), forward], 1)
    shake = [0.004 * np.sin(9.1 * time_s), 0.005 * np.sin(7.3 * time_s + 2), 0.012 * np.sin(5.3 * time_s)]
    pose[:3, :3] = pose[:3, :3] @ Rotation.from_rotvec(shake).as_matrix()
    pose[:3, 3] = position
    return pose


def _walls(rng: tex.Rng) -> list[Array]:
    """Textures of x low, x high, y low (ceiling), y high (floor), z low, z high."""
    wide, high, deep = (float(v) for v in ROOM_HIGH - ROOM_LOW)
    left = tex.plaster((176, 168, 150))(high, deep, rng)
    right = tex.plaster((150, 168, 176))(high, deep, rng)
    ceiling = tex.checker((212, 212, 206), (198, 198, 194), 0.6)(deep, wide, rng)
    floor = tex.planks((150, 112, 76))(deep, wide, rng)
    back = tex.plaster((165, 165, 165))(high, wide, rng)
    front = tex.plaster((188, 164, 142))(high, wide, rng)
    for wall, left_m, top_m, high_m, wide_m in (
        (front, 0.55, 0.35, 0.62, 0.86),
        (front, 1.72, 0.22, 0.75, 0.55),
        (front, 2.6, 0.45, 0.45, 0.62),
        (front, 4.15, 0.3, 0.6, 0.7),
        (left, 1.1, 0.4, 0.7, 0.9),
        (left, 2.6, 0.3, 0.8, 0.6),
        (left, 3.7, 0.5, 0.5, 0.7),
        (right, 1.0, 0.35, 0.6, 0.8),
        (right, 2.2, 0.45, 0.7, 0.5),
        (right, 3.3, 0.3, 0.75, 1.0),
        (back, 1.0, 0.4, 0.8, 1.0),
        (back, 2.9, 0.4, 0.6, 0.8),
    ):
        tex.put_on(wall, tex.painting(high_m, wide_m, rng), left_m, top_m)
    tex.put_on(floor, tex.checker((150, 52, 44), (206, 186, 150), 0.16)(1.6, 2.2, rng), 1.5, 2.6)
    return [left, right, ceiling, floor, back, front]


def _furniture() -> list[tuple[Any, Any, float, tex.Texture, tex.Texture]]:
    """Centre, size, yaw, texture of the sides, texture of the top. Nothing stands in the ball's way."""
    wood, dark = tex.planks((160, 118, 72), 0.09), tex.planks((104, 72, 48), 0.07)
    top_y = 0.58  # of the table
    legs = [((-1.45 + x, 0.95, 2.62 + z), (0.07, 0.70, 0.07), 8.0, dark, dark) for x, z in
            ((-0.5, -0.28), (0.5, -0.28), (-0.5, 0.28), (0.5, 0.28))]  # fmt: skip
    return [
        ((-1.45, top_y, 2.62), (1.25, 0.06, 0.75), 8.0, wood, wood),
        *legs,
        ((-1.62, top_y - 0.16, 2.6), (0.3, 0.26, 0.24), 31.0, tex.shelf(1), tex.painting),
        ((-1.12, top_y - 0.10, 2.72), (0.2, 0.14, 0.2), -12.0,
         tex.checker((36, 90, 140), (230, 220, 190), 0.05), tex.painting),
        ((1.75, 0.35, 3.55), (1.1, 1.9, 0.5), 0.0, tex.shelf(5), wood),
        ((0.15, 0.82, 3.55), (1.3, 0.96, 0.5), 0.0, tex.drawers((134, 106, 84), 3, 2), wood),
        ((-0.1, 0.17, 3.55), (0.34, 0.34, 0.3), 22.0, tex.checker((200, 60, 50), (240, 220, 120), 0.06),
         tex.painting),
        ((1.55, 1.02, 1.75), (0.55, 0.56, 0.5), -24.0, tex.painting, tex.drawers((172, 142, 96), 1, 1)),
        ((1.58, 0.60, 1.78), (0.36, 0.28, 0.34), 12.0, tex.checker((60, 130, 80), (220, 214, 200), 0.07),
         tex.painting),
        ((-1.75, 1.05, 1.1), (0.6, 0.5, 0.6), 18.0, tex.drawers((96, 120, 140), 2, 2), tex.painting),
    ]  # fmt: skip


def _darken_floor(floor: Array, boxes: list[Box]) -> None:
    """Soft contact shadows on the floor texture under furniture, in place."""
    h, w = floor.shape[:2]
    shadow = np.zeros((h, w), np.float32)
    for box in boxes:
        lift = float(ROOM_HIGH[1]) - (box.centre[1] + box.size[1] / 2)
        corners = np.array([(-1, -1), (1, -1), (1, 1), (-1, 1)]) * np.array([box.size[0], box.size[2]]) / 2
        turn = _turn(box)[[0, 2]][:, [0, 2]]
        at = corners @ turn.T + np.array([box.centre[0], box.centre[2]]) - ROOM_LOW[[0, 2]]
        one = np.zeros((h, w), np.float32)
        cv2.fillPoly(one, [np.rint(at / tex.TEXEL_M).astype(np.int32)], 1.0)
        shadow = np.maximum(shadow, cv2.GaussianBlur(one, (0, 0), 8 + 30 * max(lift, 0)) / (1 + 0.8 * max(lift, 0)))
    floor *= (1 - 0.55 * shadow)[..., None]


def _cast_walls(rays: Array, origin: Array) -> Hit:
    """The inside of the room's cuboid: every ray hits one wall."""
    safe = np.where(np.abs(rays) < 1e-9, np.float32(1e-9), rays)
    positive = safe > 0
    fx, fy, fz = (np.where(positive, ROOM_HIGH[:, None], ROOM_LOW[:, None]) - origin[:, None]) / safe
    depth = np.minimum(np.minimum(fx, fy), fz)
    on_x, on_y = fx == depth, (fy == depth) & (fx != depth)
    on_z = ~(on_x | on_y)
    x, y, z = (origin[:, None] + rays * depth - ROOM_LOW[:, None]) / (ROOM_HIGH - ROOM_LOW)[:, None]
    sign = np.where(positive, np.float32(-1), np.float32(1))
    texture = np.where(on_x, positive[0], np.where(on_y, 2 + positive[1], 4 + positive[2])).astype(np.int32)
    uv = np.stack([np.where(on_x, z, x), np.where(on_y, z, y)])
    normal = sign * np.stack([on_x, on_y, on_z])
    return Hit(depth, texture, uv, normal, np.zeros(len(depth), bool))


def _window(box: Box, camera: Camera, world_from_cam: Array) -> tuple[slice, slice] | None:
    """Rows and columns of the image that can see the box; None where it is out of view."""
    signs = np.array(np.meshgrid([-0.5, 0.5], [-0.5, 0.5], [-0.5, 0.5])).reshape(3, -1).T
    corners = signs * box.size @ _turn(box).T + box.centre
    in_cam = (corners - world_from_cam[:3, 3]) @ world_from_cam[:3, :3]
    if (in_cam[:, 2] < 0.05).all():
        return None
    if (in_cam[:, 2] < 0.05).any():
        return slice(None), slice(None)
    px = camera.project(in_cam)
    limit = np.array([camera.width, camera.height])
    low = np.floor(px.min(0)).clip(0, limit).astype(int)
    high = np.ceil(px.max(0) + 1).clip(0, limit).astype(int)
    if (low >= high).any():
        return None
    return slice(low[1], high[1]), slice(low[0], high[0])


def _turn(box: Box) -> Array:
    """room_from_box (3, 3) float32."""
    turn: Array = Rotation.from_euler("y", box.yaw_deg, degrees=True).as_matrix().astype(np.float32)
    return turn


def _cast_box(box: Box, rays: Array, origin: Array, rows: Array, hit: Hit) -> None:
    """Slab test of some rays with one box; nearer hits replace those of ``hit``, in place."""
    turn = _turn(box)
    half = np.array(box.size, np.float32)[:, None] / 2
    d = turn.T @ rays[:, rows]
    o = (turn.T @ (origin - np.array(box.centre, np.float32)))[:, None]
    d = np.where(np.abs(d) < 1e-9, np.float32(1e-9), d)
    side = np.where(d > 0, half, -half)
    ex, ey, ez = (-side - o) / d
    lx, ly, lz = (side - o) / d
    near = np.maximum(np.maximum(ex, ey), ez)
    far = np.minimum(np.minimum(lx, ly), lz)
    seen = np.flatnonzero((near > 0.02) & (near < far) & (near < hit.depth[rows]))
    if len(seen) == 0:
        return
    rows, d, near = rows[seen], d[:, seen], near[seen]
    on_x, on_y = ex[seen] == near, ey[seen] == near
    x, y, z = (o + d * near) / (2 * half) + np.float32(0.5)
    longest = max(box.size[0], box.size[2])  # a texture of the sides is as wide as the longest of them
    across = np.where(on_x, z * np.float32(box.size[2] / longest), x * np.float32(box.size[0] / longest))
    hit.depth[rows] = near
    hit.texture[rows] = np.where(on_y, box.texture + 1, box.texture)
    hit.uv[:, rows] = np.where(on_y, x, across), np.where(on_y, z, y)
    hit.normal[:, rows] = turn @ (-np.sign(d) * np.stack([on_x & ~on_y, on_y, ~(on_x | on_y)])).astype(np.float32)


def _cast_ball(rays: Array, origin: Array, time_s: float, texture: int, hit: Hit) -> None:
    """The nearer meeting of rays and the ball; replaces what lies behind, in place."""
    centre, turn = ball_pose(time_s)
    to = origin - centre
    a, b = _dot(rays, rays), to @ rays
    root = b * b - a * np.float32(to @ to - BALL_RADIUS_M**2)
    near = (-b - np.sqrt(np.maximum(root, 0))) / a
    rows = np.flatnonzero((root > 0) & (near > 0.02) & (near < hit.depth))
    if len(rows) == 0:
        return
    normal = (to[:, None] + rays[:, rows] * near[rows]) / np.float32(BALL_RADIUS_M)
    own = turn.T @ normal
    hit.depth[rows] = near[rows]
    hit.texture[rows] = texture
    hit.uv[0, rows] = np.arctan2(own[2], own[0]) / (2 * np.pi) + 0.5
    hit.uv[1, rows] = np.arccos(own[1].clip(-1, 1)) / np.pi
    hit.normal[:, rows] = normal
    hit.ball[rows] = True
