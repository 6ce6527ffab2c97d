"""COLMAP's sparse model, text and binary, as its documentation describes the files."""

from __future__ import annotations

import struct
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..geometry.quaternion import quaternion_from_rotation
from .files import write_bytes, write_text

Array = NDArray[Any]
CAMERA_ID = 1  # all images have one lens; images and points are numbered from 1 as well
MODEL_ID = {"SIMPLE_PINHOLE": 0, "PINHOLE": 1, "SIMPLE_RADIAL": 2, "RADIAL": 3, "OPENCV": 4, "FULL_OPENCV": 6}
NO_ERROR_KNOWN = -1.0  # COLMAP's own mark for a point whose reprojection error was never computed


@dataclass(frozen=True)
class ColmapModel:
    """One lens, f images, n points and m observations. Pixels have (0.5, 0.5) at the centre of the first."""

    camera_model: str
    parameters: list[float]
    size: tuple[int, int]  # (width, height)
    names: list[str]  # f names below images/
    cam_from_world: Array  # (f, 4, 4)
    points_world: Array  # (n, 3)
    colors: Array  # (n, 3) uint8
    error_px: Array  # (n,) mean over the point's observations
    point: Array  # (m,) row of the point, ascending
    image: Array  # (m,) row of the image
    px: Array  # (m, 2)

    def place_in_image(self) -> Array:
        """(m,) how many observations of the same image stand before this one."""
        order = np.argsort(self.image, kind="stable")
        begins = np.searchsorted(self.image[order], np.arange(len(self.names)))
        place = np.empty(len(order), np.int64)
        place[order] = np.arange(len(order)) - begins[self.image[order]]
        return place

    def of_images(self) -> Iterator[Array]:
        """Rows of the observations of each image, in the order of ``place_in_image``."""
        order = np.argsort(self.image, kind="stable")
        ends = np.searchsorted(self.image[order], np.arange(1, len(self.names)))
        yield from np.split(order, ends)

    def of_points(self) -> Iterator[Array]:
        """Rows of the observations of each point."""
        if len(self.points_world):
            ends = np.searchsorted(self.point, np.arange(1, len(self.points_world)))
            yield from np.split(np.arange(len(self.point)), ends)


def write_colmap(folder: Path, model: ColmapModel) -> None:
    """cameras, images and points3D in ``folder``, each as .txt and .bin. Raises OutputError."""
    write_text(folder / "cameras.txt", cameras_text(model))
    write_text(folder / "images.txt", images_text(model))
    write_text(folder / "points3D.txt", points_text(model))
    write_bytes(folder / "cameras.bin", _cameras_bytes(model))
    write_bytes(folder / "images.bin", _images_bytes(model))
    write_bytes(folder / "points3D.bin", _points_bytes(model))


def cameras_text(model: ColmapModel) -> str:
    """cameras.txt."""
    words = [str(CAMERA_ID), model.camera_model, *map(str, model.size), *_numbers(model.parameters)]
    return "# CAMERA_ID MODEL WIDTH HEIGHT PARAMS[]\n" + " ".join(words) + "\n"


def images_text(model: ColmapModel) -> str:
    """images.txt: two lines an image, its place and its observations."""
    lines = ["# IMAGE_ID QW QX QY QZ TX TY TZ CAMERA_ID NAME\n# POINTS2D[] as (X, Y, POINT3D_ID)\n"]
    images = zip(model.names, _wxyz(model), model.cam_from_world[:, :3, 3], model.of_images(), strict=True)
    for n, (name, q, t, rows) in enumerate(images, 1):
        seen = zip(model.px[rows].tolist(), (model.point[rows] + 1).tolist(), strict=True)
        lines.append(" ".join([str(n), *_numbers((*q, *t)), str(CAMERA_ID), name]) + "\n")
        lines.append(" ".join(f"{x:.9g} {y:.9g} {p}" for (x, y), p in seen) + "\n")
    return "".join(lines)


def points_text(model: ColmapModel) -> str:
    """points3D.txt."""
    lines = ["# POINT3D_ID X Y Z R G B ERROR TRACK[] as (IMAGE_ID, POINT2D_IDX)\n"]
    tracks, place = model.of_points(), model.place_in_image()
    points = zip(model.points_world.tolist(), model.colors.tolist(), model.error_px.tolist(), tracks, strict=True)
    for n, (point, color, error, rows) in enumerate(points, 1):
        track = np.stack([model.image[rows] + 1, place[rows]], -1).ravel().tolist()
        lines.append(" ".join([str(n), *_numbers(point), *map(str, color), f"{error:.9g}", *map(str, track)]) + "\n")
    return "".join(lines)


def _cameras_bytes(model: ColmapModel) -> bytes:
    head = struct.pack("<QIiQQ", 1, CAMERA_ID, MODEL_ID[model.camera_model], *model.size)
    return head + np.array(model.parameters, "<f8").tobytes()


def _images_bytes(model: ColmapModel) -> bytes:
    observed = np.dtype([("px", "<f8", 2), ("point", "<u8")])
    parts = [struct.pack("<Q", len(model.names))]
    images = zip(model.names, _wxyz(model), model.cam_from_world[:, :3, 3], model.of_images(), strict=True)
    for n, (name, q, t, rows) in enumerate(images, 1):
        seen = np.empty(len(rows), observed)
        seen["px"], seen["point"] = model.px[rows], model.point[rows] + 1
        head = struct.pack("<I7dI", n, *q, *t, CAMERA_ID)
        parts += [head, name.encode() + b"\0", struct.pack("<Q", len(rows)), seen.tobytes()]
    return b"".join(parts)


def _points_bytes(model: ColmapModel) -> bytes:
    place = model.place_in_image()
    parts = [struct.pack("<Q", len(model.points_world))]
    points = zip(model.points_world.tolist(), model.colors.tolist(), model.error_px.tolist(), strict=True)
    for n, ((point, color, error), rows) in enumerate(zip(points, model.of_points(), strict=True), 1):
        track = np.stack([model.image[rows] + 1, place[rows]], -1).astype("<u4")
        parts += [struct.pack("<Q3d3BdQ", n, *point, *color, error, len(rows)), track.tobytes()]
    return b"".join(parts)


def _wxyz(model: ColmapModel) -> Array:
    return quaternion_from_rotation(model.cam_from_world[:, :3, :3])


def _numbers(values: Iterable[float]) -> list[str]:
    return [f"{float(v) + 0.0:.12g}" for v in values]  # + 0.0: no "-0"
