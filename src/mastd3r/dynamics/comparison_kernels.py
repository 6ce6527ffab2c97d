"""The maps of ``motion_test.py``, a pass each: what two aligned images say of every pixel."""

from __future__ import annotations

from typing import Any

import numba as nb
import numpy as np
from numpy.typing import NDArray

from .motion import bounded, odds, widened
from .pixels import JIT, between_pixels

Array = NDArray[Any]
_F = np.float32


@nb.njit(**JIT)
def _round_trip(forward: Array, backward: Array, inside: Array, sigma_px: float, out: Array) -> None:
    """``out`` (h, w): -(|forward + backward there| / sigma)² / 2; minus infinity where it leaves the image."""
    h, w = out.shape
    per = _F(-0.5) / (sigma_px * sigma_px)
    for j in range(h):
        for i in range(w):
            fx, fy = forward[j, i, 0], forward[j, i, 1]
            u, v = _F(i) + fx, _F(j) + fy
            if not (inside[j, i] > 0 and 0 <= u <= w - 1 and 0 <= v <= h - 1):
                out[j, i] = -np.inf
                continue
            fx += between_pixels(backward[..., 0], u, v)
            fy += between_pixels(backward[..., 1], u, v)
            out[j, i] = per * (fx * fx + fy * fy)


def round_trip_confidence(forward: Array, backward: Array, inside: Array, sigma_px: float) -> Array:
    """(h, w) exp(-(|forward + backward there| / sigma)² / 2) where ``inside``; 0 where the flow leaves the image.

    ``forward``, ``backward`` (h, w, 2) float32, ``inside`` (h, w).
    """
    out = np.empty(inside.shape, np.float32)
    _round_trip(forward, backward, inside, _F(sigma_px), out)
    return np.exp(out, out=out)


@nb.njit(**JIT)
def _unexplained(
    left: Array, xy: Array, near: Any, twist: Array, slope: Array, sigma: Any, cov: Array
) -> tuple[Any, Any, Any, Any, Any]:
    """Of one pixel: the flow left over without what ``twist`` (6,), times the focal length, explains of it, and its
    covariance, wider by what the depth's 1 sigma may do along the epipolar line."""
    x, y = xy[0], xy[1]
    rx = left[0] - (near * (twist[0] - x * twist[2]) - x * y * twist[3] + (_F(1) + x * x) * twist[4] - y * twist[5])
    ry = left[1] - (near * (twist[1] - y * twist[2]) - (_F(1) + y * y) * twist[3] + x * y * twist[4] + x * twist[5])
    dx, dy = bounded(slope[0] * sigma), bounded(slope[1] * sigma)
    dx, dy = float(dx), float(dy)  # squares of a lost pixel's leave float32
    return rx, ry, cov[0] + dx * dx, cov[1] + dx * dy, cov[2] + dy * dy


@nb.njit(**JIT)
def unexplained_every(
    left: Array, xy: Array, near: Array, twist: Array, slope: Array, sigma: Array, cov: Array, step: int
) -> tuple[Array, Array]:
    """(n, 2) and (n, 3): ``_unexplained`` of every ``step``-th pixel both ways, from the middle of a step."""
    h, w = near.shape
    first = step // 2
    rows, cols = (h - first + step - 1) // step, (w - first + step - 1) // step
    residual, wide = np.empty((rows * cols, 2)), np.empty((rows * cols, 3))
    n = 0
    for j in range(first, h, step):
        for i in range(first, w, step):
            found = _unexplained(left[j, i], xy[j, i], near[j, i], twist, slope[j, i], sigma[j, i], cov[j, i])
            residual[n, 0], residual[n, 1], wide[n, 0], wide[n, 1], wide[n, 2] = found
            n += 1
    return residual, wide


@nb.njit(**JIT)
def grey_differences(gray: Array, stable: Array, gain: float, left: Array, as_static: Array, as_flow: Array) -> None:
    """Squared differences of ``gray`` (h, w) uint8 and ``stable`` times ``gain``: in place, and along ``left``."""
    h, w = gray.shape
    for j in range(h):
        for i in range(w):
            here = _F(gray[j, i])
            still = here - gain * _F(stable[j, i])
            as_static[j, i] = still * still
            u = min(max(_F(i) + left[j, i, 0], _F(0)), _F(w - 1))
            v = min(max(_F(j) + left[j, i, 1], _F(0)), _F(h - 1))
            moved = here - gain * between_pixels(stable, u, v)
            as_flow[j, i] = moved * moved


@nb.njit(**JIT)
def mean_ratio(a: Array, b: Array, inside: Array) -> Any:
    """Mean of ``a`` over that of ``b`` where ``inside`` (h, w) is 1; both are uint8."""
    over, under, count = _F(0), _F(0), inside.size
    for j in range(a.shape[0]):
        for i in range(a.shape[1]):
            over += inside[j, i] * _F(a[j, i])
            under += inside[j, i] * _F(b[j, i])
    return over / max(under, _F(1e-3) * _F(count))


@nb.njit(**JIT)
def confident_share(confidence: Array, inside: Array, static: Array, covered: Array) -> float:
    """Mean ``confidence`` of the static scene that nothing covers."""
    found, scene = 0.0, 0.0
    for j in range(inside.shape[0]):
        for i in range(inside.shape[1]):
            one = inside[j, i] * static[j, i] * (_F(1) - covered[j, i])
            scene += one
            found += one * confidence[j, i]
    return found / max(scene, 1.0)


Geometry = tuple[Array, Array, Array, Array]  # the flow left over; xy, inv_depth and slope of the rigid flow


@nb.njit(**JIT)
def _motion_terms(
    geometry: Geometry, twist: Array, noise: tuple[Array, Array, float], spread: float, log_part: Array, factor: Array
) -> None:
    left, xy, near, slope = geometry
    sigma, cov, inflation = noise
    for j in range(factor.shape[0]):
        for i in range(factor.shape[1]):
            found = _unexplained(left[j, i], xy[j, i], near[j, i], twist, slope[j, i], sigma[j, i], cov[j, i])
            rx, ry, xx, xxy, yy = found
            log_part[j, i], factor[j, i] = widened(rx, ry, inflation * xx, inflation * xxy, inflation * yy, spread)


@nb.njit(**JIT)
def _odds_of(ratio: Array, factor: Array, still_share: float, outlier_share: float) -> None:
    """In place: the exponential of ``widened`` becomes the odds."""
    for j in range(ratio.shape[0]):
        for i in range(ratio.shape[1]):
            ratio[j, i] = odds(ratio[j, i] * factor[j, i], still_share, outlier_share)


def flow_log_ratio(
    geometry: Geometry, twist: Array, noise: tuple[Array, Array, float], shares: tuple[float, float, float]
) -> Array:
    """log p(r | moving) - log p(r | static), (h, w) float32, of the flow r that ``twist`` (6,) does not explain.

    Static: Normal(0, cov), wider by what the depth's 1 sigma may do along the epipolar line, with a share of wrong
    flow. Moving: the same widened by the spread, and a share that shows no motion against the background. Bounded on
    both sides by the shares, near 0 where cov is wide, and 0 where a number is not finite. ``twist`` is given times the
    focal length.
    ``noise``: 1 sigma of inverse depth (h, w), covariance of the flow (h, w, 3), and times that it is wider than it
    claims; ``shares``: the spread in px², of moving things that stand still, of wrong flow.
    """
    ratio, factor = np.empty(geometry[0].shape[:2], np.float32), np.empty(geometry[0].shape[:2], np.float32)
    spread, still_share, outlier_share = map(_F, shares)
    _motion_terms(geometry, twist, (*noise[:2], _F(noise[2])), spread, ratio, factor)
    np.exp(ratio, out=ratio)
    _odds_of(ratio, factor, still_share, outlier_share)
    return np.log(ratio, out=ratio)


@nb.njit(**JIT)
def _unlikely(square: Array, variance: Array, out: Array) -> None:
    for j in range(out.shape[0]):
        for i in range(out.shape[1]):
            out[j, i] = _F(-0.5) * max(square[j, i] / variance[j, i] - _F(2), _F(0))


@nb.njit(**JIT)
def _joined(
    ratio: Array,
    masks: tuple[Array, Array, Array],
    grey: tuple[Array, Array, Array],
    likely: Array,
    fits_gain: float,
    unexplained_gain: float,
) -> None:
    confidence, inside, covered = masks
    square, flow_square, variance = grey
    one = _F(1)
    for j in range(ratio.shape[0]):
        for i in range(ratio.shape[1]):
            unmatched = (one - confidence[j, i]) * (one - covered[j, i])
            fits = min(max(fits_gain * (square[j, i] - flow_square[j, i]) / variance[j, i], _F(-3)), _F(0))
            said = unexplained_gain * unmatched * (one - likely[j, i]) + fits
            ratio[j, i] = ratio[j, i] * confidence[j, i] + inside[j, i] * said


def add_grey_evidence(
    ratio: Array, masks: tuple[Array, Array, Array], grey: tuple[Array, Array, Array], gains: tuple[float, float]
) -> None:
    """``ratio`` (h, w) counts by the flow's confidence, and grey values are added to it, in place.

    ``masks``: confidence, inside, and P(covered by something in the past frame); ``grey``: squared differences of
    static pixels and along the flow, and their variance; ``gains``: of grey values that fit, that nothing explains.
    """
    likely = np.empty(ratio.shape, np.float32)
    _unlikely(grey[0], grey[2], likely)
    np.exp(likely, out=likely)
    _joined(ratio, masks, grey, likely, *map(_F, gains))
