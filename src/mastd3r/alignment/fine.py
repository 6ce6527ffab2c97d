"""Fine stage, eq. (11)(12): re-mapping residual, point-to-point residual and bidirectional Chamfer, by LM on Sim(3)."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from ..geometry.least_squares import Damping, levenberg_marquardt
from ..geometry.point_kernels import point_system
from ..geometry.se3 import se3_exp, transform
from ..types import USABLE_WEIGHT
from .reproject import PoseReport, StaticMatches

Array = NDArray[Any]
STALE_SIGMA = 0.1  # a nearest neighbour is believed to stay the nearest until points moved by this share of a sigma


@dataclass(frozen=True)
class OwnPoints:
    """Both clouds at the matched pixels; new's are in new's camera, before the scale."""

    ref: Array  # (p, 3) in ref's camera
    new: Array  # (p, 3) in new's camera
    weight: Array  # (p,)
    sigma_ratio: float  # 1-sigma of a point relative to its depth


def point_terms(moved: Array, own: Array, weight: Array, sigma: Array) -> tuple[Array, Array, float]:
    """(7, 7), (7,) and cost of |own - moved|²/sigma² with a Cauchy kernel of 2 sigma.

    Tangent: left perturbation of new_from_ref (translation, rotation), log-scale of ``own``. ``own`` holds the
    scaled points, so d own / d log s = own. Residual r = own - moved, J = d(moved - own).
    """
    found: tuple[Array, Array, float] = point_system(
        *(np.ascontiguousarray(v, float) for v in (moved, own, weight, sigma))
    )
    return found


def chamfer_pairs(moved: Array, own: Array) -> tuple[Array, Array]:
    """Indices (rows of moved, rows of own) of both directions' nearest neighbours: the bidirectional E_cham."""
    forward = cKDTree(own).query(moved)[1]
    backward = cKDTree(moved).query(own)[1]
    return np.r_[np.arange(len(moved)), backward], np.r_[forward, np.arange(len(own))]


class _Neighbours:
    """The pairs of E_cham, searched again where a point has moved by ``STALE_SIGMA`` of its own sigma since."""

    def __init__(self) -> None:
        self._moved: Array | None = None
        self._own = np.zeros(0)
        self._pairs = (np.zeros(0, int), np.zeros(0, int))

    def of(self, moved: Array, own: Array, sigma: Array) -> tuple[Array, Array]:
        """Pairs of two clouds (n, 3), row by row those of the last call, but a little moved."""
        if self._moved is not None:
            away = np.abs(moved - self._moved).max(1) + np.abs(own - self._own).max(1)
            if (away < STALE_SIGMA * sigma).all():
                return self._pairs
        self._moved, self._own, self._pairs = moved, own, chamfer_pairs(moved, own)
        return self._pairs


@dataclass(frozen=True)
class _Terms:
    """What eq. (12) is a sum of."""

    matches: StaticMatches
    own: OwnPoints | None
    chamfer_weight: float
    kernel_px: float
    as_printed: bool
    near: _Neighbours

    def system(self, pose: Array, log_scale: float) -> tuple[Array, Array, float]:
        """Normal equations (7, 7), (7,) and cost."""
        hess, rhs, cost = np.zeros((7, 7)), np.zeros(7), 0.0
        if self.own is None or not self.as_printed:
            hess[:6, :6], rhs[:6], cost = self.matches.system(pose, self.kernel_px)
        if self.own is None:
            return hess, rhs, cost
        for h, b, c in self._points(self.own, pose, log_scale):
            hess, rhs, cost = hess + h, rhs + b, cost + c
        if self.as_printed:
            hess[6], hess[:, 6], rhs[6] = 0.0, 0.0, 0.0
            hess[6, 6] = 1.0
        return hess, rhs, cost

    def _points(self, own: OwnPoints, pose: Array, log_scale: float) -> list[tuple[Array, Array, float]]:
        """Point to point, and Chamfer."""
        used = own.weight > USABLE_WEIGHT
        moved, scaled, w = transform(pose, own.ref[used]), np.exp(log_scale) * own.new[used], own.weight[used]
        sigma = own.sigma_ratio * np.maximum(scaled[:, 2], 1e-6)
        parts = [point_terms(moved, scaled, w, sigma)]
        if self.chamfer_weight > 0 and used.sum() > 10:
            i, j = self.near.of(moved, scaled, sigma)
            parts.append(point_terms(moved[i], scaled[j], self.chamfer_weight * np.minimum(w[i], w[j]), sigma[j]))
        return parts


@dataclass(frozen=True)
class _PoseAndScale:
    """The solver's estimate; the kernels give the cost with the system."""

    terms: _Terms
    new_from_ref: Array
    log_scale: float

    @cached_property
    def _system(self) -> tuple[Array, Array, float]:
        return self.terms.system(self.new_from_ref, self.log_scale)

    def linearised(self) -> tuple[Array, Array, float]:
        return self._system

    def cost(self) -> float:
        return self._system[2]

    def moved(self, step: Array) -> _PoseAndScale:
        return _PoseAndScale(self.terms, se3_exp(step[:6]) @ self.new_from_ref, self.log_scale + float(step[6]))


def align_fine(
    matches: StaticMatches,
    own: OwnPoints | None,
    new_from_ref: Array,
    scale: float,
    *,
    chamfer_weight: float,
    kernel_px: float = 1.5,
    iterations: int = 20,
    as_printed: bool = False,
) -> tuple[PoseReport, float]:
    """Minimise eq. (12), with the plus sign that print lost; returns the pose and new's scale.

    Without own points the sum is the re-mapping term alone, on SE(3). ``as_printed``: where there are own points,
    the sum is theirs alone, and the scale stays as the stage before left it: T of eq. (11) is in SE(3).
    """
    terms = _Terms(matches, own, chamfer_weight, kernel_px, as_printed, _Neighbours())
    start = _PoseAndScale(terms, new_from_ref, float(np.log(scale)))
    found = levenberg_marquardt(start, Damping(), iterations=iterations, tolerance=1e-5)
    end = found.estimate
    return PoseReport(end.new_from_ref, found.converged), float(np.exp(end.log_scale))
