"""COLMAP's sparse models read back, text and binary, written from COLMAP's description of its files alone."""

from __future__ import annotations

import struct
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

Array = NDArray[Any]
MODELS = {0: ("SIMPLE_PINHOLE", 3), 1: ("PINHOLE", 4), 2: ("SIMPLE_RADIAL", 4), 3: ("RADIAL", 5), 4: ("OPENCV", 8),
          6: ("FULL_OPENCV", 12)}  # fmt: skip


@dataclass
class Image:
    cam_from_world: Array  # (4, 4)
    camera_id: int
    name: str
    px: Array  # (k, 2)
    point_ids: list[int]


@dataclass
class Point:
    xyz: Array
    rgb: tuple[int, ...]
    error: float
    track: list[tuple[int, int]]  # (image id, place in the image)


@dataclass
class Model:
    camera: tuple[str, int, int, Array]  # name, width, height, parameters
    images: dict[int, Image]
    points: dict[int, Point]

    def errors_px(self) -> Array:
        """Distance of every observation of every track from where its point is seen."""
        found = []
        for number, point in self.points.items():
            for image_id, place in point.track:
                image = self.images[image_id]
                assert image.point_ids[place] == number
                x, y, z = image.cam_from_world[:3, :3] @ point.xyz + image.cam_from_world[:3, 3]
                seen = projected(self.camera[0], self.camera[3], np.array([[x / z, y / z]]))[0]
                found.append(np.linalg.norm(seen - image.px[place]))
        return np.array(found)


def projected(model: str, parameters: Array, xy: Array) -> Array:
    """(n, 2) on the unit plane to (n, 2) pixels, the first pixel's centre at (0.5, 0.5)."""
    p = [float(v) for v in parameters]
    if model in ("SIMPLE_PINHOLE", "SIMPLE_RADIAL", "RADIAL"):
        p = [p[0], *p]
    fx, fy, cx, cy, *terms = p
    if model == "FULL_OPENCV":
        k1, k2, p1, p2, k3, k4, k5, k6 = terms
    else:
        k1, k2, p1, p2 = (*terms, 0.0, 0.0, 0.0, 0.0)[:4]
        k3 = k4 = k5 = k6 = 0.0
    x, y = xy[:, 0], xy[:, 1]
    r = x**2 + y**2
    bend = (1 + k1 * r + k2 * r**2 + k3 * r**3) / (1 + k4 * r + k5 * r**2 + k6 * r**3)
    u = x * bend + 2 * p1 * x * y + p2 * (r + 2 * x**2)
    v = y * bend + 2 * p2 * x * y + p1 * (r + 2 * y**2)
    return np.stack([fx * u + cx, fy * v + cy], -1)


def read_text(folder: Path) -> Model:
    """cameras.txt, images.txt and points3D.txt."""
    ((_, name, width, height, *parameters),) = [line.split() for line in _lines(folder / "cameras.txt")]
    images, lines = {}, _lines(folder / "images.txt")
    for head, seen in zip(lines[::2], lines[1::2], strict=True):
        words, numbers = head.split(maxsplit=9), np.array(seen.split(), float).reshape(-1, 3)
        pose = _pose([float(w) for w in words[1:8]])
        images[int(words[0])] = Image(pose, int(words[8]), words[9], numbers[:, :2], numbers[:, 2].astype(int).tolist())
    points = {}
    for line in _lines(folder / "points3D.txt"):
        w = line.split()
        track = np.array(w[8:], int).reshape(-1, 2).tolist()
        points[int(w[0])] = Point(
            np.array(w[1:4], float), tuple(map(int, w[4:7])), float(w[7]), list(map(tuple, track))
        )
    return Model((name, int(width), int(height), np.array(parameters, float)), images, points)


def read_binary(folder: Path) -> Model:
    """cameras.bin, images.bin and points3D.bin, each read to its very end."""
    with _Bytes(folder / "cameras.bin") as b:
        assert b.take("Q") == (1,)
        _, model, width, height = b.take("IiQQ")
        name, count = MODELS[model]
        camera = (name, width, height, np.array(b.take(f"{count}d")))
    images, points = {}, {}
    with _Bytes(folder / "images.bin") as b:
        for _ in range(b.take("Q")[0]):
            (number, *pose, camera_id), name = b.take("I7dI"), b.word()
            seen = [b.take("ddQ") for _ in range(b.take("Q")[0])]
            px = np.array([s[:2] for s in seen]).reshape(-1, 2)
            images[number] = Image(_pose(pose), camera_id, name, px, [s[2] for s in seen])
    with _Bytes(folder / "points3D.bin") as b:
        for _ in range(b.take("Q")[0]):
            number, x, y, z, red, green, blue, error, length = b.take("QdddBBBdQ")
            track = [b.take("II") for _ in range(length)]
            points[number] = Point(np.array([x, y, z]), (red, green, blue), error, track)
    return Model(camera, images, points)


class _Bytes:
    def __init__(self, path: Path) -> None:
        self._data, self._at = path.read_bytes(), 0

    def __enter__(self) -> _Bytes:
        return self

    def __exit__(self, *_: object) -> None:
        assert self._at == len(self._data)

    def take(self, layout: str) -> tuple[Any, ...]:
        values = struct.unpack_from("<" + layout, self._data, self._at)
        self._at += struct.calcsize("<" + layout)
        return values

    def word(self) -> str:
        end = self._data.index(b"\0", self._at)
        text, self._at = self._data[self._at : end].decode(), end + 1
        return text


def _pose(values: list[float]) -> Array:
    w, x, y, z, *t = values
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = Rotation.from_quat([x, y, z, w]).as_matrix(), t
    return pose


def _lines(path: Path) -> list[str]:
    lines = path.read_text().split("\n")
    assert lines[-1] == ""
    return [line for line in lines[:-1] if not line.startswith("#")]
