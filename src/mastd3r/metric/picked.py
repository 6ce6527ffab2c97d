"""Metres from two points of one frame whose distance is known."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..errors import InputError
from .estimate import Scale, scale_of, tukey
from .material import Material
from .spec import Asked

Array = NDArray[Any]
WHERE = "--scale points"
NEIGHBOURS, LEAST = 16, 6  # static points around a picked one that its depth is taken from
REACH_RATIO = 0.1  # of the image's longer side: farther static points say nothing of a picked one
PICKED_PX = 1.0  # 1 sigma of where a person points
ROUNDS = 10


def scale_from_points(asked: Asked, map_: Material) -> Scale:
    """The distance of two pixels of a frame, at the map's depth there, against the metres that it has.

    The sigma holds the fit of the depths, a pixel of the picking, and what the focal length leaves open.
    Raises InputError for a frame or pixels without static points around them.
    """
    assert asked.px is not None and asked.number is not None
    lens = map_.lens
    if lens is None:
        raise InputError(f"{WHERE}: expected the lens of the run (camera.json), got none")
    time_s = map_.time_of(asked.frame, WHERE)
    seen_px, z = map_.observed(time_s)
    px = np.array(asked.px)
    outside = ((px < -0.5) | (px > np.array([lens.width, lens.height]) - 0.5)).any(1)
    if outside.any():
        x, y = px[np.argmax(outside)]
        raise InputError(f"{WHERE}: expected pixels of a {lens.width}x{lens.height} photograph, got {x:g},{y:g}")
    reach = REACH_RATIO * max(lens.width, lens.height)
    fits = [_fit(seen_px, 1 / z, at, reach, f"{WHERE}: frame {asked.frame}") for at in px]
    sigma = [float(np.sqrt(covariance[0, 0])) for _, covariance, _ in fits]

    def distance(shift_px: Array, shift_inv: Array) -> float:
        inv = [f[0][0] + f[0][1:] @ d + i for f, d, i in zip(fits, shift_px, shift_inv, strict=True)]
        ends = lens.rays(px + shift_px) / np.maximum(inv, 1e-12)[:, None]
        return float(np.linalg.norm(ends[1] - ends[0]))

    none_px, none = np.zeros((2, 2)), np.zeros(2)
    found = distance(none_px, none)
    if not found > 0:
        raise InputError(f"{WHERE}: expected two points apart from one another, got one place")
    variance = map_.focal_sigma_ratio**2
    for n in range(2):
        variance += (np.log(distance(none_px, np.eye(2)[n] * sigma[n]) / found)) ** 2
        for axis in range(2):
            step = np.zeros((2, 2))
            step[n, axis] = PICKED_PX
            variance += (np.log(distance(step, none) / found)) ** 2
    supports = sum(f[2] for f in fits)
    of = "static points around the two that were picked"
    return scale_of(float(np.log(asked.number / found)), float(np.sqrt(variance)), supports, of, WHERE)


def _fit(px: Array, inv_depth: Array, at: Array, reach_px: float, where: str) -> tuple[Array, Array, int]:
    """Inverse depth around a pixel, affine as on a plane: (3,) value and slopes there, covariance, points used.

    Robust: what lies on another surface than most neighbours is left out. Raises InputError for too few neighbours.
    """
    apart = np.linalg.norm(px - at, axis=1)
    near = np.argsort(apart)[:NEIGHBOURS]
    near = near[apart[near] < reach_px]
    if len(near) < LEAST:
        raise InputError(
            f"{where}: expected {LEAST} or more static points within {reach_px:.0f} px of {at[0]:g},{at[1]:g}, "
            f"got {len(near)}; pick a place with texture, in a frame that others see too"
        )
    offset, value = px[near] - at, inv_depth[near]
    design = np.concatenate([np.ones((len(near), 1)), offset], 1)
    base = 1 / (1 + (apart[near] / apart[near].max()) ** 2)
    weight = base * (np.abs(value - np.median(value)) <= 3 * 1.4826 * np.median(np.abs(value - np.median(value))))
    for _ in range(ROUNDS):
        normal = design.T @ (weight[:, None] * design) + np.diag([0.0, 1e-9, 1e-9]) * weight.sum()
        x = np.linalg.solve(normal, design.T @ (weight * value))
        residual = value - design @ x
        sigma = 1.4826 * float(np.median(np.abs(residual[weight > 0]))) + 1e-6 * float(np.median(value))
        weight = base * tukey(residual / sigma)
    used = int((weight > 0).sum())
    if x[0] <= 0 or used < LEAST:
        raise InputError(f"{where}: expected one surface around {at[0]:g},{at[1]:g}, got an edge; pick beside it")
    inverse = np.linalg.inv(normal)
    variance = float((weight * residual**2).sum() / weight.sum()) * used / max(1, used - 3)
    return x, variance * inverse @ (design.T @ (weight[:, None] ** 2 * design)) @ inverse, used
