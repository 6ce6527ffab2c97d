"""Numba kernels of the joint optimisation: residuals and Jacobians of flow matches (docs/joint_optimisation.md).

A host keyframe i owns inverse depths d at its grid pixels. A match of grid pixel x in keyframe j at x' gives

    u(x)  = (x - c)/f · (1 + k |x - c|²/f²)                    undistortion, unit plane
    Y     = R u(x) + t d,   (R, t) = j_from_i                  u(x) homogeneous
    r     = x' - c - f v(π(Y))                                 pixels, v the inverse of u: as the image has them

unknowns a pose perturbation of j (6), intrinsics g = (log f, k, cx, cy) (4), and d (1).
"""

from __future__ import annotations

import math
from typing import Any

import numba as nb
import numpy as np
from numpy.typing import NDArray

Array = NDArray[Any]
_JIT: dict[str, Any] = {"cache": True, "fastmath": True, "error_model": "numpy", "nogil": True}
N_GLOBAL = 4
N_POSE = 6
N_COLS = N_POSE + N_GLOBAL
MIN_DEPTH = 0.02  # Y_z below this share of the host's depth: the point is (nearly) behind the camera


@nb.njit(inline="always", **_JIT)
def _undistort(x: float, y: float, f: float, k: float) -> tuple[float, float, float]:
    r2 = (x * x + y * y) / (f * f)
    s = 1.0 + k * r2
    return x / f * s, y / f * s, r2


@nb.njit(inline="always", **_JIT)
def _distort(qx: float, qy: float, k: float) -> tuple[float, float, float]:
    """v with v (1 + k |v|²) = q by Newton on the radius, and |v|²; -1 for a ray that the bent lens does not image."""
    q2 = qx * qx + qy * qy
    if k == 0.0 or q2 == 0.0:
        return qx, qy, q2
    ru = math.sqrt(q2)
    if k < 0.0 and ru > 0.7 * math.sqrt(-0.3 / k):  # there 1 + 3 k r² falls below 0.1
        return 0.0, 0.0, -1.0
    r = ru
    for _ in range(8):
        r -= (r * (1.0 + k * r * r) - ru) / (1.0 + 3.0 * k * r * r)
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
    x: float,
    y: float,
    r2: float,
    bent_x: float,
    bent_y: float,
    qx: float,
    qy: float,
    t: Array,
) -> None:
    """Columns 6 to 9 of d(f q) through the host's ray u(x); ``bent`` = |v|² v is what k does at the other end."""
    p00 = fz * (t[0, 0] - qx * t[2, 0])
    p01 = fz * (t[0, 1] - qx * t[2, 1])
    p10 = fz * (t[1, 0] - qy * t[2, 0])
    p11 = fz * (t[1, 1] - qy * t[2, 1])
    ex = x / f
    ey = y / f
    c1 = -(1.0 + 3.0 * k * r2)
    jac[0, 6] = c1 * (p00 * ex + p01 * ey)
    jac[1, 6] = c1 * (p10 * ex + p11 * ey)
    jac[0, 7] = r2 * (p00 * ex + p01 * ey) - f * bent_x
    jac[1, 7] = r2 * (p10 * ex + p11 * ey) - f * bent_y
    si = (1.0 + k * r2) / f
    m00 = si + 2.0 * k * ex * ex / f
    m01 = 2.0 * k * ex * ey / f
    m11 = si + 2.0 * k * ey * ey / f
    jac[0, 8] = -(p00 * m00 + p01 * m01)
    jac[1, 8] = -(p10 * m00 + p11 * m01)
    jac[0, 9] = -(p00 * m01 + p01 * m11)
    jac[1, 9] = -(p10 * m01 + p11 * m11)


@nb.njit(inline="always", **_JIT)
def _edge_point(
    px: float, py: float, d: float, tx: float, ty: float, t: Array, g: Array, jac: Array
) -> tuple[float, float, float, float, float]:
    """Residual (rx, ry), depth Jacobian (jd0, jd1) and Y_z; fills ``jac`` (2, 10) for [pose j, globals]."""
    f = math.exp(g[0])
    k = g[1]
    x = px - g[2]
    y = py - g[3]
    ux, uy, r2 = _undistort(x, y, f, k)
    yx = t[0, 0] * ux + t[0, 1] * uy + t[0, 2] + t[0, 3] * d
    yy = t[1, 0] * ux + t[1, 1] * uy + t[1, 2] + t[1, 3] * d
    yz = t[2, 0] * ux + t[2, 1] * uy + t[2, 2] + t[2, 3] * d
    if yz < MIN_DEPTH:
        return 0.0, 0.0, 0.0, 0.0, yz
    iz = 1.0 / yz
    fz = f * iz
    qx = yx * iz
    qy = yy * iz
    vx, vy, s2 = _distort(qx, qy, k)
    if s2 < 0.0:
        return 0.0, 0.0, 0.0, 0.0, 0.0
    rx = tx - g[2] - f * vx
    ry = ty - g[3] - f * vy
    # d v/d q, the inverse of d u/d x_d = (1 + k s²) I + 2 k v v^T
    sj = 1.0 + k * s2
    q = 2.0 * k / (sj * (sj + 2.0 * k * s2))
    w00 = 1.0 / sj - q * vx * vx
    w01 = -q * vx * vy
    w11 = 1.0 / sj - q * vy * vy
    _pose_columns(jac, f, fz, d, qx, qy)
    _lens_columns(jac, f, fz, k, x, y, r2, s2 * vx, s2 * vy, qx, qy, t)
    jd0 = fz * (t[0, 3] - qx * t[2, 3])
    jd1 = fz * (t[1, 3] - qy * t[2, 3])
    for i in range(N_COLS):
        j0 = jac[0, i]
        jac[0, i] = w00 * j0 + w01 * jac[1, i]
        jac[1, i] = w01 * j0 + w11 * jac[1, i]
    j0 = jd0
    jd0 = w00 * j0 + w01 * jd1
    jd1 = w01 * j0 + w11 * jd1
    # the prediction c + f v itself
    jac[0, 6] += f * vx
    jac[1, 6] += f * vy
    jac[0, 8] += 1.0
    jac[1, 9] += 1.0
    return rx, ry, jd0, jd1, yz


@nb.njit(**_JIT)
def host_system(
    px: Array, depth: Array, target: Array, weight: Array, j_from_i: Array, g: Array, kernel_px: float
) -> tuple[Array, Array, Array, Array, Array, Array]:
    """Normal-equation parts of all m edges of one host.

    Args: px (p, 2) host pixels; depth (p,) inverse depths; target (m, p, 2) pixels in j; weight (m, p);
        j_from_i (m, 4, 4); g (4,) intrinsics; kernel_px scale of the Cauchy kernel.
    Returns: H (m, 10, 10), b (m, 10), E (m, p, 10) = w J^T J_d, H_dd (m, p), b_d (m, p), cost (m,).
    """
    m, p = weight.shape
    hess = np.zeros((m, N_COLS, N_COLS))
    rhs = np.zeros((m, N_COLS))
    cross = np.zeros((m, p, N_COLS), np.float32)
    hdd = np.zeros((m, p))
    bd = np.zeros((m, p))
    cost = np.zeros(m)
    c2 = kernel_px * kernel_px
    for e in range(m):
        jac = np.zeros((2, N_COLS))
        for n in range(p):
            w = weight[e, n]
            if w <= 0.0:
                continue
            rx, ry, jd0, jd1, yz = _edge_point(
                px[n, 0], px[n, 1], depth[n], target[e, n, 0], target[e, n, 1], j_from_i[e], g, jac
            )
            if yz < MIN_DEPTH:
                cost[e] += w * c2 * 4.0
                continue
            r2 = rx * rx + ry * ry
            cost[e] += w * c2 * math.log1p(r2 / c2)
            w = w / (1.0 + r2 / c2)
            hdd[e, n] = w * (jd0 * jd0 + jd1 * jd1)
            bd[e, n] = w * (jd0 * rx + jd1 * ry)
            for i in range(N_COLS):
                wi0 = w * jac[0, i]
                wi1 = w * jac[1, i]
                rhs[e, i] += wi0 * rx + wi1 * ry
                cross[e, n, i] = wi0 * jd0 + wi1 * jd1
                for j in range(i, N_COLS):
                    hess[e, i, j] += wi0 * jac[0, j] + wi1 * jac[1, j]
        for i in range(N_COLS):
            for j in range(i):
                hess[e, i, j] = hess[e, j, i]
    return hess, rhs, cross, hdd, bd, cost


@nb.njit(**_JIT)
def host_cost(
    px: Array, depth: Array, target: Array, weight: Array, j_from_i: Array, g: Array, kernel_px: float
) -> Array:
    """The robust cost (m,) of ``host_system`` alone, for accepting or refusing a step."""
    m, p = weight.shape
    cost = np.zeros(m)
    c2 = kernel_px * kernel_px
    for e in range(m):
        jac = np.zeros((2, N_COLS))
        for n in range(p):
            if weight[e, n] <= 0.0:
                continue
            rx, ry, _, _, yz = _edge_point(
                px[n, 0], px[n, 1], depth[n], target[e, n, 0], target[e, n, 1], j_from_i[e], g, jac
            )
            if yz < MIN_DEPTH:
                cost[e] += weight[e, n] * c2 * 4.0
            else:
                cost[e] += weight[e, n] * c2 * math.log1p((rx * rx + ry * ry) / c2)
    return cost


@nb.njit(**_JIT)
def edge_residuals(px: Array, depth: Array, target: Array, j_from_i: Array, g: Array) -> tuple[Array, Array]:
    """Residuals (p, 2) in pixels and Y_z (p,) of one edge (1000 px where the point is behind j)."""
    p = px.shape[0]
    out = np.empty((p, 2))
    z = np.empty(p)
    for n in range(p):
        jac = np.empty((2, N_COLS))
        rx, ry, _, _, yz = _edge_point(px[n, 0], px[n, 1], depth[n], target[n, 0], target[n, 1], j_from_i, g, jac)
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
    for n in range(px.shape[0]):
        w = weight[n]
        if w <= 0.0:
            continue
        rx, ry, a, b, yz = _edge_point(px[n, 0], px[n, 1], depth[n], target[n, 0], target[n, 1], j_from_i, g, jac)
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
