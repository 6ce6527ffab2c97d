"""The keyframes of a saved map as another camera would have taken them."""

from __future__ import annotations

import hashlib
from dataclasses import replace
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from ..camera.pinhole import Camera
from ..export.map_folder import MapKeyframe, MapRecord
from ..pointmap.geometric import GeometricPointmaps
from ..types import Frame
from .working_eye import grid_of, one_a_cell

Array = NDArray[Any]
SAME_PX = 0.05  # at the corners of a working image: lenses that differ by less are one


def digest_of(record: MapRecord) -> str:
    """What tells a map from another one: of its keyframes' times, poses, images and points."""
    found = hashlib.sha256()
    for kf in record.keyframes:
        found.update(np.float64(kf.timestamp_s).tobytes() + kf.world_from_cam.tobytes())
        for array in (kf.gray, kf.px, kf.inv_depth, kf.depth_info):
            found.update(np.ascontiguousarray(array).tobytes())
    return found.hexdigest()


def drawn(record: MapRecord, own: Camera, camera: Camera, provider: GeometricPointmaps) -> MapRecord:
    """The keyframes of a map as ``camera`` would have taken them from the same places; ``own`` took them.

    Both are those of working images; ``provider`` chooses the pixels. They are as they were where the two are one.
    What ``camera`` shows beyond them moves for certain: it has no say.
    """
    size, grid = (camera.width, camera.height), grid_of(provider)
    corners = np.array([[0, 0], [size[0] - 1, 0], [0, size[1] - 1], [size[0] - 1, size[1] - 1]], float)
    if (record.size, record.grid) == (size, grid):
        off_px = np.linalg.norm(camera.project(own.rays(corners)) - corners, axis=1)
        if off_px.max() < SAME_PX:
            return record
    at = own.project(camera.rays(camera.pixel_grid())).astype(np.float32)
    keyframes = tuple(_drawn(n, kf, own, camera, at, provider) for n, kf in enumerate(record.keyframes))
    return replace(record, size=size, grid=grid, keyframes=keyframes, features="")


def _drawn(
    n: int, kf: MapKeyframe, own: Camera, camera: Camera, at: Array, provider: GeometricPointmaps
) -> MapKeyframe:
    """``at`` (h, w, 2): where the pixels of ``camera`` are in the keyframe's image."""
    gray = cv2.remap(kf.gray, at, None, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    moving = cv2.remap(kf.moving, at, None, cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT, borderValue=255)
    work = provider.look(Frame(n, kf.timestamp_s, cv2.cvtColor(gray, cv2.COLOR_GRAY2RGB)))
    px = camera.project(own.rays(kf.px))
    known = np.flatnonzero((kf.depth_info > 0) & np.isfinite(px).all(1))
    cells, rows = one_a_cell(px[known], work, provider.cell_px)
    rows = known[rows]
    out_px, info = work.px.copy(), np.zeros(len(work.px))
    inv_depth = np.full(len(work.px), float(np.median(kf.inv_depth)))
    out_px[cells], inv_depth[cells] = px[rows], kf.inv_depth[rows]
    info[cells] = kf.depth_info[rows] * (camera.fx_px / own.fx_px) ** 2  # of a pixel's noise in this camera
    color = np.zeros((len(work.px) if len(kf.color) else 0, 3), np.uint8)
    if len(kf.color):
        color[cells] = kf.color[rows]
    texture, none = work.texture.astype(np.float32), np.zeros((0, 2), np.float32)
    points = (out_px, texture, inv_depth, info)
    return MapKeyframe(kf.timestamp_s, kf.world_from_cam, gray, moving, *points, none, none.astype(np.float16), color)


def color_of(kf: MapKeyframe) -> Array:
    """(p, 3) uint8 RGB of a keyframe's points; grey where the map has kept no colours."""
    if len(kf.color):
        return kf.color
    x, y = np.clip(np.rint(kf.px), 0, np.array(kf.gray.shape[::-1]) - 1).astype(int).T
    return np.repeat(kf.gray[y, x][:, None], 3, 1)
