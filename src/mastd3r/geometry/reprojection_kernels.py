"""Numba kernels of the joint optimisation: residuals and Jacobians of flow matches (docs/joint_optimisation.md).

An anchor keyframe i owns inverse depths d at its grid pixels. A match of grid pixel x in keyframe j at x' gives

    u(x)  = e · (1 + k |e|² + m |e|⁴ + n |e|⁶),  e = (x - c)/f   undistortion, unit plane
    Y     = R u(x) + t d,   (R, t) = j_from_i                  u(x) homogeneous
    r     = x' - c - f v(π(Y))                                 pixels, v the inverse of u: as the image has them

unknowns a pose perturbation of j (6), intrinsics g = (log f, k, cx, cy, m, n) (6), and d (1).
"""

from __future__ import annotations

import math
from typing import Any

import numba as nb
import numpy as np
from numpy.typing import NDArray

from .anchor_matches import AnchorMatches

Array = NDArray[Any]
_JIT: dict[str, Any] = {"cache": True, "fastmath": True, "error_model": "numpy", "nogil": True}
N_GLOBAL = 6
N_POSE = 6
N_COLS = N_POSE + N_GLOBAL
CONVERGED = 1e-8  # step of a radius on the unit plane, after which Newton is exact to rounding
MIN_DEPTH = 0.02  # Y_z below this share of the anchor's depth: the point is (nearly) behind the camera


@nb.njit(inline="always", **_JIT)
def _undistort(x: float, y: float, f: float, k: float, m: float, n: float) -> tuple[float, float, float]:
    r2 = (x * x + y * y) / (f * f)
    s = 1.0 + r2 * (k + r2 * (m + n * r2))
    return x / f * s, y / f * s, r2


@nb.njit(**_JIT)
def fold_radius(k: float, m: float, n: float) -> tuple[float, float]:
    """(radius on the bent side, on the straight side) where the lens folds: its slope falls below 0.1 there."""
    if k == 0.0 and m == 0.0 and n == 0.0:
        return 1e9, 1e9
    r = 0.0
    for _ in range(300):
        r2 = (r + 0.01) ** 2
        if 1.0 + r2 * (3.0 * k + r2 * (5.0 * m + 7.0 * n * r2)) < 0.1:
            break
        r += 0.01
    r2 = r * r
    return r, r * (1.0 + r2 * (k + r2 * (m + n * r2)))


@nb.njit(inline="always", **_JIT)
def _distort(
    qx: float, qy: float, k: float, m: float, n: float, fold_r: float, fold_u: float
) -> tuple[float, float, float]:
    """v with v (1 + k |v|² + m |v|⁴ + n |v|⁶) = q by Newton on the radius, and |v|²; -1 beyond the fold."""
    q2 = qx * qx + qy * qy
    if fold_r > 1e8 or q2 == 0.0:
        return qx, qy, q2
    ru = math.sqrt(q2)
    if ru >= fold_u:
        return 0.0, 0.0, -1.0
    r = min(ru, fold_r)
    for _ in range(8):
        r2 = r * r
        slope = 1.0 + r2 * (3.0 * k + r2 * (5.0 * m + 7.0 * n * r2))
        step = (r * (1.0 + r2 * (k + r2 * (m + n * r2))) - ru) / slope
        r = min(max(r - step, 0.0), fold_r)
        if abs(step) < CONVERGED:
            break
    s = r / ru
    return qx * s, qy * s, r * r


@nb.njit(inline="always", **_JIT)
def _pose_columns(jac: Array, f: float, fz: float, d: float, qx: float, qy: float) -> None:
    """Columns 0 to 5 of d(f q), q = pi(Y)."""
    # pose of j, left perturbation: dY = d rho + phi x Y
    jac[0, 0] = fz * d
    jac[0, 1] = 0.0
    jac[0, 2] = -fz * qx * d
    jac[0, 3] = -f * qx * qy
    jac[0, 4] = f * (1.0 + qx * qx)
    jac[0, 5] = -f * qy
    jac[1, 0] = 0.0
    jac[1, 1] = fz * d
    jac[1, 2] = -fz * qy * d
    jac[1, 3] = -f * (1.0 + qy * qy)
    jac[1, 4] = f * qx * qy
    jac[1, 5] = f * qx


@nb.njit(inline="always", **_JIT)
def _lens_columns(
    jac: Array,
    f: float,
    fz: float,
    k: float,
    m: float,
    n: float,
    x: float,
    y: float,
    r2: float,
    vx: float,
    vy: float,
    s2: float,
    qx: float,
    qy: float,
    t: Array,
) -> None:
    """Columns 6 to 11 of d(f q) through the anchor's ray u(x); s2 v, s2² v, s2³ v: k, m, n at the other end."""
    p00 = fz * (t[0, 0] - qx * t[2, 0])
    p01 = fz * (t[0, 1] - qx * t[2, 1])
    p10 = fz * (t[1, 0] - qy * t[2, 0])
    p11 = fz * (t[1, 1] - qy * t[2, 1])
    ex = x / f
    ey = y / f
    c1 = -(1.0 + r2 * (3.0 * k + r2 * (5.0 * m + 7.0 * n * r2)))
    along_x = p00 * ex + p01 * ey
    along_y = p10 * ex + p11 * ey
    jac[0, 6] = c1 * along_x
    jac[1, 6] = c1 * along_y
    jac[0, 7] = r2 * along_x - f * s2 * vx
    jac[1, 7] = r2 * along_y - f * s2 * vy
    jac[0, 10] = r2 * r2 * along_x - f * s2 * s2 * vx
    jac[1, 10] = r2 * r2 * along_y - f * s2 * s2 * vy
    jac[0, 11] = r2 * r2 * r2 * along_x - f * s2 * s2 * s2 * vx
    jac[1, 11] = r2 * r2 * r2 * along_y - f * s2 * s2 * s2 * vy
    si = (1.0 + r2 * (k + r2 * (m + n * r2))) / f
    bend = 2.0 * (k + r2 * (2.0 * m + 3.0 * n * r2)) / f
    m00 = si + bend * ex * ex
    m01 = bend * ex * ey
    m11 = si + bend * ey * ey
    jac[0, 8] = -(p00 * m00 + p01 * m01)
    jac[1, 8] = -(p10 * m00 + p11 * m01)
    jac[0, 9] = -(p00 * m01 + p01 * m11)
    jac[1, 9] = -(p10 * m01 + p11 * m11)


@nb.njit(inline="always", **_JIT)
def _edge_point(
    px: float, py: float, d: float, tx: float, ty: float, t: Array, g: Array, fold: tuple[float, float], lens: bool,
    jac: Array,
) -> tuple[float, float, float, float, float]:  # fmt: skip
    """Residual (rx, ry), depth Jacobian (jd0, jd1) and Y_z; fills ``jac`` (2, 12) for [pose j, globals].

    Without ``lens`` the columns of the globals stay as they are.
    """
    f = math.exp(g[0])
    k = g[1]
    m = g[4]
    n = g[5]
    x = px - g[2]
    y = py - g[3]
    ux, uy, r2 = _undistort(x, y, f, k, m, n)
    yx = t[0, 0] * ux + t[0, 1] * uy + t[0, 2] + t[0, 3] * d
    yy = t[1, 0] * ux + t[1, 1] * uy + t[1, 2] + t[1, 3] * d
    yz = t[2, 0] * ux + t[2, 1] * uy + t[2, 2] + t[2, 3] * d
    if yz < MIN_DEPTH:
        return 0.0, 0.0, 0.0, 0.0, yz
    iz = 1.0 / yz
    fz = f * iz
    qx = yx * iz
    qy = yy * iz
    vx, vy, s2 = _distort(qx, qy, k, m, n, fold[0], fold[1])
    if s2 < 0.0:
        return 0.0, 0.0, 0.0, 0.0, 0.0
    rx = tx - g[2] - f * vx
    ry = ty - g[3] - f * vy
    # d v/d q, the inverse of d u/d x_d = (1 + k s² + m s⁴ + n s⁶) I + 2 (k + 2 m s² + 3 n s⁴) v v^T
    sj = 1.0 + s2 * (k + s2 * (m + n * s2))
    bend = 2.0 * (k + s2 * (2.0 * m + 3.0 * n * s2))
    q = bend / (sj * (sj + bend * s2))
    w00 = 1.0 / sj - q * vx * vx
    w01 = -q * vx * vy
    w11 = 1.0 / sj - q * vy * vy
    _pose_columns(jac, f, fz, d, qx, qy)
    if lens:
        _lens_columns(jac, f, fz, k, m, n, x, y, r2, vx, vy, s2, qx, qy, t)
    jd0 = fz * (t[0, 3] - qx * t[2, 3])
    jd1 = fz * (t[1, 3] - qy * t[2, 3])
    for i in range(N_COLS if lens else N_POSE):
        j0 = jac[0, i]
        jac[0, i] = w00 * j0 + w01 * jac[1, i]
        jac[1, i] = w01 * j0 + w11 * jac[1, i]
    j0 = jd0
    jd0 = w00 * j0 + w01 * jd1
    jd1 = w01 * j0 + w11 * jd1
    if lens:  # the prediction c + f v itself
        jac[0, 6] += f * vx
        jac[1, 6] += f * vy
        jac[0, 8] += 1.0
        jac[1, 9] += 1.0
    return rx, ry, jd0, jd1, yz


@nb.njit(inline="always", **_JIT)
def _edge_residual(
    px: float, py: float, d: float, tx: float, ty: float, t: Array, g: Array, f: float, fold: tuple[float, float]
) -> tuple[float, float, float]:
    """What ``_edge_point`` says without Jacobians: (rx, ry) and Y_z; ``f`` is exp(g[0])."""
    k = g[1]
    m = g[4]
    n = g[5]
    ux, uy, _ = _undistort(px - g[2], py - g[3], f, k, m, n)
    yx = t[0, 0] * ux + t[0, 1] * uy + t[0, 2] + t[0, 3] * d
    yy = t[1, 0] * ux + t[1, 1] * uy + t[1, 2] + t[1, 3] * d
    yz = t[2, 0] * ux + t[2, 1] * uy + t[2, 2] + t[2, 3] * d
    if yz < MIN_DEPTH:
        return 0.0, 0.0, yz
    iz = 1.0 / yz
    vx, vy, s2 = _distort(yx * iz, yy * iz, k, m, n, fold[0], fold[1])
    if s2 < 0.0:
        return 0.0, 0.0, 0.0
    return tx - g[2] - f * vx, ty - g[3] - f * vy, yz


@nb.njit(**_JIT)
def anchor_system(
    px: Array, depth: Array, matches: AnchorMatches, j_from_i: Array, g: Array, kernel_px: float, lens: bool = True
) -> tuple[Array, Array, Array, Array, Array, Array]:
    """Normal-equation parts of all m edges of one anchor keyframe.

    Args: px (p, 2) pixels of it; depth (p,) inverse depths; matches (k of them); j_from_i (m, 4, 4);
        g (6,) intrinsics; kernel_px scale of the Cauchy kernel; lens False: what belongs to g is left at 0.
    Returns: H (m, 12, 12), b (m, 12), E (k, 12) = w J^T J_d, H_dd (p,), b_d (p,), cost (m,).
    """
    m, p = len(matches.first) - 1, px.shape[0]
    hess, rhs = np.zeros((m, N_COLS, N_COLS)), np.zeros((m, N_COLS))
    cross, cost = np.zeros((len(matches.point), N_COLS), np.float32), np.zeros(m)
    hdd, bd = np.zeros(p), np.zeros(p)
    if lens:
        _sum_up(px, depth, matches, j_from_i, g, kernel_px, True, hess, rhs, cross, hdd, bd, cost)
    else:
        _sum_up(px, depth, matches, j_from_i, g, kernel_px, False, hess, rhs, cross, hdd, bd, cost)
    return hess, rhs, cross, hdd, bd, cost


@nb.njit(inline="always", **_JIT)
def _sum_up(
    px: Array, depth: Array, matches: AnchorMatches, j_from_i: Array, g: Array, kernel_px: float, lens: bool,
    hess: Array, rhs: Array, cross: Array, hdd: Array, bd: Array, cost: Array,
) -> None:  # fmt: skip
    """``anchor_system`` into arrays of zeros; inlined, so that loops are made for either ``lens``."""
    first, point, target, weight = matches.first, matches.point, matches.target, matches.weight
    fold = fold_radius(g[1], g[4], g[5])
    c2 = kernel_px * kernel_px
    for e in range(len(first) - 1):
        jac = np.zeros((2, N_COLS))
        for s in range(first[e], first[e + 1]):
            w, n = weight[s], point[s]
            rx, ry, jd0, jd1, yz = _edge_point(
                px[n, 0], px[n, 1], depth[n], target[s, 0], target[s, 1], j_from_i[e], g, fold, lens, jac
            )
            if yz < MIN_DEPTH:
                cost[e] += w * c2 * 4.0
                continue
            r2 = rx * rx + ry * ry
            cost[e] += w * c2 * math.log1p(r2 / c2)
            w = w / (1.0 + r2 / c2)
            hdd[n] += w * (jd0 * jd0 + jd1 * jd1)
            bd[n] += w * (jd0 * rx + jd1 * ry)
            for i in range(N_COLS if lens else N_POSE):
                wi0 = w * jac[0, i]
                wi1 = w * jac[1, i]
                rhs[e, i] += wi0 * rx + wi1 * ry
                cross[s, i] = wi0 * jd0 + wi1 * jd1
                for j in range(i, N_COLS if lens else N_POSE):
                    hess[e, i, j] += wi0 * jac[0, j] + wi1 * jac[1, j]
        for i in range(N_COLS):
            for j in range(i):
                hess[e, i, j] = hess[e, j, i]


@nb.njit(**_JIT)
def anchor_cost(px: Array, depth: Array, matches: AnchorMatches, j_from_i: Array, g: Array, kernel_px: float) -> Array:
    """The robust cost (m,) of ``anchor_system`` alone, for accepting or refusing a step."""
    first, point, target, weight = matches.first, matches.point, matches.target, matches.weight
    m = len(first) - 1
    f, fold = math.exp(g[0]), fold_radius(g[1], g[4], g[5])
    cost = np.zeros(m)
    c2 = kernel_px * kernel_px
    for e in range(m):
        for s in range(first[e], first[e + 1]):
            n = point[s]
            rx, ry, yz = _edge_residual(
                px[n, 0], px[n, 1], depth[n], target[s, 0], target[s, 1], j_from_i[e], g, f, fold
            )
            if yz < MIN_DEPTH:
                cost[e] += weight[s] * c2 * 4.0
            else:
                cost[e] += weight[s] * c2 * math.log1p((rx * rx + ry * ry) / c2)
    return cost


@nb.njit(**_JIT)
def edge_residuals(px: Array, depth: Array, target: Array, j_from_i: Array, g: Array) -> tuple[Array, Array]:
    """Residuals (p, 2) in pixels and Y_z (p,) of one edge (1000 px where the point is behind j)."""
    p = px.shape[0]
    f, fold = math.exp(g[0]), fold_radius(g[1], g[4], g[5])
    out = np.empty((p, 2))
    z = np.empty(p)
    for n in range(p):
        rx, ry, yz = _edge_residual(px[n, 0], px[n, 1], depth[n], target[n, 0], target[n, 1], j_from_i, g, f, fold)
        z[n] = yz
        out[n, 0] = rx if yz >= MIN_DEPTH else 1e3
        out[n, 1] = ry if yz >= MIN_DEPTH else 1e3
    return out, z


@nb.njit(**_JIT)
def pose_system(
    px: Array,
    depth: Array,
    depth_info: Array,
    target: Array,
    weight: Array,
    j_from_i: Array,
    g: Array,
    kernel_px: float,
) -> tuple[Array, Array, float]:
    """Pose-only normal equations (6, 6), (6,) and cost, each depth marginalised under its own information.

    ``depth_info`` (p,) is 1/variance of the inverse depth, in units in which one pixel has variance 1:
    the information of a residual is I - J_d J_d^T / (depth_info + |J_d|²), so unsure depths still give rotation.
    """
    hess = np.zeros((N_POSE, N_POSE))
    rhs = np.zeros(N_POSE)
    cost = 0.0
    c2 = kernel_px * kernel_px
    jac = np.zeros((2, N_COLS))
    fold = fold_radius(g[1], g[4], g[5])
    for n in range(px.shape[0]):
        w = weight[n]
        if w <= 0.0:
            continue
        rx, ry, a, b, yz = _edge_point(
            px[n, 0], px[n, 1], depth[n], target[n, 0], target[n, 1], j_from_i, g, fold, False, jac
        )
        if yz < MIN_DEPTH:
            cost += w * c2 * 4.0
            continue
        s = 1.0 / (depth_info[n] + a * a + b * b + 1e-12)
        i00 = 1.0 - a * a * s
        i01 = -a * b * s
        i11 = 1.0 - b * b * s
        sx = i00 * rx + i01 * ry
        sy = i01 * rx + i11 * ry
        r2 = rx * sx + ry * sy
        cost += w * c2 * math.log1p(r2 / c2)
        w = w / (1.0 + r2 / c2)
        for i in range(N_POSE):
            k0 = w * (jac[0, i] * i00 + jac[1, i] * i01)
            k1 = w * (jac[0, i] * i01 + jac[1, i] * i11)
            rhs[i] += w * (jac[0, i] * sx + jac[1, i] * sy)
            for j in range(i, N_POSE):
                hess[i, j] += k0 * jac[0, j] + k1 * jac[1, j]
    for i in range(N_POSE):
        for j in range(i):
            hess[i, j] = hess[j, i]
    return hess, rhs, cost
