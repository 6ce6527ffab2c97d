"""Projection of 3-D Gaussians to the image, forward and backward, over an index range first … last-1.

Small matrices are row-major tuples: 2 x 3 has 6 entries, 3 x 3 has 9. All arithmetic is float64, because the
determinant of a long thin 2-D covariance cancels in float32. ``lens`` = fx, fy, cx, cy, width, height, where
pixel i spans i … i+1 (the caller has already moved the principal point by half a pixel).
"""

# mypy: disallow-untyped-defs=False
from __future__ import annotations

import math
from typing import Any

import numpy as np
from numba import njit

from .rasterise_cpu_blend import (
    ALPHA_CUT,
    CHANNELS,
    GROUP_PIXELS,
    ROW_A,
    ROW_B,
    ROW_C,
    ROW_CHANNEL,
    ROW_LOG2,
    ROW_NARROW,
    ROW_REACH_X,
    ROW_REACH_Y,
    ROW_SHEAR,
    ROW_TURN,
    ROW_WIDE,
    ROW_X,
    ROW_Y,
    SUMS,
)
from .rasterise_cpu_matrices import JIT, scaled_columns, times, times_transposed, transposed_times

FIELD_MARGIN = 0.15  # the Jacobian is taken at most this share of the width outside the image
_LOG2_E = 1 / math.log(2)
_WIDER = 1 + 1e-5  # share by which the square of an ellipse's width is taken larger, against rounding at its tips


@njit(**JIT)
def _to_camera(view, means, i):
    x0, y0, z0 = float(means[i, 0]), float(means[i, 1]), float(means[i, 2])
    x = view[0, 0] * x0 + view[0, 1] * y0 + view[0, 2] * z0 + view[0, 3]
    y = view[1, 0] * x0 + view[1, 1] * y0 + view[1, 2] * z0 + view[1, 3]
    z = view[2, 0] * x0 + view[2, 1] * y0 + view[2, 2] * z0 + view[2, 3]
    return x, y, z


@njit(**JIT)
def _unit_quaternion(quats, i):
    w, x, y, z = float(quats[i, 0]), float(quats[i, 1]), float(quats[i, 2]), float(quats[i, 3])
    inverse_norm = 1.0 / math.sqrt(w * w + x * x + y * y + z * z)
    return w * inverse_norm, x * inverse_norm, y * inverse_norm, z * inverse_norm, inverse_norm


@njit(**JIT)
def _rotation(w, x, y, z):
    return (
        1 - 2 * (y * y + z * z),
        2 * (x * y - w * z),
        2 * (x * z + w * y),
        2 * (x * y + w * z),
        1 - 2 * (x * x + z * z),
        2 * (y * z - w * x),
        2 * (x * z - w * y),
        2 * (y * z + w * x),
        1 - 2 * (x * x + y * y),
    )


@njit(**JIT)
def _slopes(x, y, z, lens):
    """Entries of the projection's Jacobian, the clamped x and y, and whether they are not clamped."""
    fx, fy, cx, cy, width, height = lens[0], lens[1], lens[2], lens[3], lens[4], lens[5]
    right, left = (width - cx + FIELD_MARGIN * width) / fx, -(cx + FIELD_MARGIN * width) / fx
    bottom, top = (height - cy + FIELD_MARGIN * height) / fy, -(cy + FIELD_MARGIN * height) / fy
    inverse_z = 1.0 / z
    x_ratio, y_ratio = x * inverse_z, y * inverse_z
    x_free, y_free = left <= x_ratio <= right, top <= y_ratio <= bottom
    x_used, y_used = z * min(right, max(left, x_ratio)), z * min(bottom, max(top, y_ratio))
    j02, j12 = -fx * x_used * inverse_z * inverse_z, -fy * y_used * inverse_z * inverse_z
    return fx * inverse_z, j02, fy * inverse_z, j12, x_used, y_used, x_free, y_free


@njit(**JIT)
def _jacobian_times_view(j00, j02, j11, j12, view):
    return (
        j00 * view[0, 0] + j02 * view[2, 0],
        j00 * view[0, 1] + j02 * view[2, 1],
        j00 * view[0, 2] + j02 * view[2, 2],
        j11 * view[1, 0] + j12 * view[2, 0],
        j11 * view[1, 1] + j12 * view[2, 1],
        j11 * view[1, 2] + j12 * view[2, 2],
    )


@njit(**JIT)
def _write_row(rows, i, u, v, var_x, cov_xy, var_y, determinant, opacity, spread):
    """What blending reads of Gaussian i, but its channels; spread = squared standard deviations to alpha 1/255."""
    rows[i, ROW_X] = u
    rows[i, ROW_Y] = v
    rows[i, ROW_A] = -0.5 * _LOG2_E * var_y / determinant
    rows[i, ROW_B] = _LOG2_E * cov_xy / determinant
    rows[i, ROW_C] = -0.5 * _LOG2_E * var_x / determinant
    rows[i, ROW_LOG2] = _LOG2_E * math.log(opacity)
    rows[i, ROW_REACH_X] = math.sqrt(spread * var_x)
    rows[i, ROW_REACH_Y] = math.sqrt(spread * var_y)
    rows[i, ROW_TURN] = cov_xy * math.sqrt(spread / var_x)
    rows[i, ROW_SHEAR] = cov_xy / var_y
    rows[i, ROW_WIDE] = _WIDER * spread * determinant / var_y
    rows[i, ROW_NARROW] = determinant / (var_y * var_y)


@njit(**JIT)
def _write_box(box, i, u, v, radius_x, radius_y, lens):
    """Groups of tiles that the drawn box touches: left, right, top, bottom, without the last."""
    box[i, 0] = max(0.0, math.floor((u - radius_x) / GROUP_PIXELS))
    box[i, 1] = min(math.ceil(lens[4] / GROUP_PIXELS), math.ceil((u + radius_x) / GROUP_PIXELS))
    box[i, 2] = max(0.0, math.floor((v - radius_y) / GROUP_PIXELS))
    box[i, 3] = min(math.ceil(lens[5] / GROUP_PIXELS), math.ceil((v + radius_y) / GROUP_PIXELS))


@njit(**JIT)
def project_forward(
    first, last, means, quats, scales, opacities, colors, view, lens, near, eps2d, rows, depth, radius, box
):  # fmt: skip
    """Gaussians first … last-1: rows (N,16) for blending, depth (N,), radius (N,2) of the drawn box, px, box (N,4).

    Radius 0 and an empty box = not seen; such a row is not written.
    """
    for i in range(first, last):
        radius[i, 0] = 0
        radius[i, 1] = 0
        box[i, 0] = box[i, 1] = box[i, 2] = box[i, 3] = 0
        x, y, z = _to_camera(view, means, i)
        depth[i] = z
        opacity = float(opacities[i])
        if not (z > near and opacity >= ALPHA_CUT):
            continue
        w, qx, qy, qz, _ = _unit_quaternion(quats, i)
        shape = scaled_columns(_rotation(w, qx, qy, qz), scales[i, 0], scales[i, 1], scales[i, 2])
        j00, j02, j11, j12, _, _, _, _ = _slopes(x, y, z, lens)
        b = times(_jacobian_times_view(j00, j02, j11, j12, view), shape)
        var_x = b[0] * b[0] + b[1] * b[1] + b[2] * b[2] + eps2d
        cov_xy = b[0] * b[3] + b[1] * b[4] + b[2] * b[5]
        var_y = b[3] * b[3] + b[4] * b[4] + b[5] * b[5] + eps2d
        determinant = var_x * var_y - cov_xy * cov_xy
        if not determinant > 0:
            continue
        u, v = lens[0] * x / z + lens[2], lens[1] * y / z + lens[3]
        spread = 2 * math.log(opacity * 255.0)
        radius_x, radius_y = math.ceil(math.sqrt(spread * var_x)), math.ceil(math.sqrt(spread * var_y))
        if u + radius_x <= 0 or u - radius_x >= lens[4] or v + radius_y <= 0 or v - radius_y >= lens[5]:
            continue
        radius[i, 0] = min(radius_x, 2.0**30)
        radius[i, 1] = min(radius_y, 2.0**30)
        _write_box(box, i, u, v, radius_x, radius_y, lens)
        _write_row(rows, i, u, v, var_x, cov_xy, var_y, determinant, opacity, spread)
        for channel in range(CHANNELS - 1):
            rows[i, ROW_CHANNEL + channel] = colors[i, channel]
        rows[i, ROW_CHANNEL + CHANNELS - 1] = z


@njit(**JIT)
def _screen_grads(rows, opacities, sums, i, row):
    """Conic a, b, c of Gaussian i, and loss gradients of its pixel (2), conic (3) and opacity from the sums."""
    a = -2 / _LOG2_E * float(rows[i, ROW_A])
    b = -1 / _LOG2_E * float(rows[i, ROW_B])
    c = -2 / _LOG2_E * float(rows[i, ROW_C])
    gx, gy = float(sums[row, 1]), float(sums[row, 2])
    conic_grad = -0.5 * sums[row, 3], -1.0 * sums[row, 4], -0.5 * sums[row, 5]
    return (a, b, c), (a * gx + b * gy, b * gx + c * gy), conic_grad, sums[row, 0] / opacities[i]


@njit(**JIT)
def _covariance_grad(conic, conic_grad):
    """Gradient of the 2-D covariance from that of its inverse: -X G X, G symmetric."""
    a, b, c = conic
    ga, gb, gc = conic_grad[0], 0.5 * conic_grad[1], conic_grad[2]
    p00, p01, p10, p11 = a * ga + b * gb, a * gb + b * gc, b * ga + c * gb, b * gb + c * gc
    return -(p00 * a + p01 * b), -(p00 * b + p01 * c), -(p10 * b + p11 * c)


@njit(**JIT)
def _quaternion_grad(w, x, y, z, inverse_norm, h):
    """Gradient of the raw quaternion from that of the rotation matrix (9 entries)."""
    dw = 2 * (-z * h[1] + y * h[2] + z * h[3] - x * h[5] - y * h[6] + x * h[7])
    dx = 2 * (y * h[1] + z * h[2] + y * h[3] - 2 * x * h[4] - w * h[5] + z * h[6] + w * h[7] - 2 * x * h[8])
    dy = 2 * (-2 * y * h[0] + x * h[1] + w * h[2] + x * h[3] + z * h[5] - w * h[6] + z * h[7] - 2 * y * h[8])
    dz = 2 * (-2 * z * h[0] - w * h[1] + x * h[2] + w * h[3] - 2 * z * h[4] + y * h[5] + x * h[6] + y * h[7])
    along = dw * w + dx * x + dy * y + dz * z
    return (
        (dw - along * w) * inverse_norm,
        (dx - along * x) * inverse_norm,
        (dy - along * y) * inverse_norm,
        (dz - along * z) * inverse_norm,
    )


@njit(**JIT)
def _point_grad(x, y, z, lens, slopes, pixel_grad, depth_grad, jacobian_grad):
    """Gradient of the camera-frame point: through the pixel, the depth channel and the Jacobian."""
    fx, fy = lens[0], lens[1]
    _, _, _, _, x_used, y_used, x_free, y_free = slopes
    g00, g02, g11, g12 = jacobian_grad
    r, gu, gv = 1.0 / z, pixel_grad[0], pixel_grad[1]
    gx, gy = fx * r * gu, fy * r * gv
    gz = -(fx * x * gu + fy * y * gv) * r * r + depth_grad - (fx * g00 + fy * g11) * r * r
    if x_free:
        gx -= fx * r * r * g02
        gz += 2 * fx * x_used * r * r * r * g02
    else:
        gz += fx * x_used * r * r * r * g02
    if y_free:
        gy -= fy * r * r * g12
        gz += 2 * fy * y_used * r * r * r * g12
    else:
        gz += fy * y_used * r * r * r * g12
    return gx, gy, gz


@njit(**JIT)
def _add_view_grad(view_grad, chunk, slopes, product_grad, point_grad, means, i):
    j00, j02, j11, j12 = slopes[0], slopes[1], slopes[2], slopes[3]
    for k in range(3):
        world = float(means[i, k])
        view_grad[chunk, 0, k] += j00 * product_grad[k] + point_grad[0] * world
        view_grad[chunk, 1, k] += j11 * product_grad[3 + k] + point_grad[1] * world
        view_grad[chunk, 2, k] += j02 * product_grad[k] + j12 * product_grad[3 + k] + point_grad[2] * world
        view_grad[chunk, k, 3] += point_grad[k]


@njit(**JIT)
def _jacobian_grad(product_grad, view):
    p = product_grad
    return (
        p[0] * view[0, 0] + p[1] * view[0, 1] + p[2] * view[0, 2],
        p[0] * view[2, 0] + p[1] * view[2, 1] + p[2] * view[2, 2],
        p[3] * view[1, 0] + p[4] * view[1, 1] + p[5] * view[1, 2],
        p[3] * view[2, 0] + p[4] * view[2, 1] + p[5] * view[2, 2],
    )


@njit(**JIT)
def _sum_pairs(first, last, pair_gaussian, pair_sums):
    """Rows that the tiles left for Gaussians first … last-1, summed in the order of the tiles."""
    sums = np.zeros((last - first, SUMS), np.float32)
    for p in range(len(pair_gaussian)):
        row = pair_gaussian[p] - first
        if 0 <= row < last - first:
            for k in range(SUMS):
                sums[row, k] += pair_sums[p, k]
    return sums


@njit(**JIT)
def _any(sums, row):
    found = False
    for k in range(SUMS):
        found = found or sums[row, k] != 0
    return found


@njit(**JIT)
def project_backward(
    first,
    last,
    inputs,
    view,
    lens,
    rows,
    pair_gaussian,
    pair_sums,
    outputs,
    view_grad,
):
    """Chain rule for chunks first … last-1 of all Gaussians.

    From the sums of the pairs to ``outputs`` (mean (N,3), quaternion (N,4), scale (N,3), opacity (N,), colour (N,3),
    pixel (N,2), all zero where a Gaussian was not seen) and view (chunks,4,4). The result does not depend on the split.
    """
    means, quats, scales, opacities = inputs
    count, chunks = means.shape[0], view_grad.shape[0]
    begin = first * count // chunks
    sums = _sum_pairs(begin, last * count // chunks, pair_gaussian, pair_sums)
    for chunk in range(first, last):
        for i in range(chunk * count // chunks, (chunk + 1) * count // chunks):
            if _any(sums, i - begin):
                _chain(i, sums, i - begin, means, quats, scales, opacities, view, lens, rows, outputs, view_grad, chunk)
            else:
                _no_gradient(outputs, i)


@njit(**JIT)
def _no_gradient(outputs, i):
    mean_grad, quat_grad, scale_grad, opacity_grad, color_grad, pixel_grad = outputs
    opacity_grad[i] = 0
    for k in range(4):
        quat_grad[i, k] = 0
    for k in range(3):
        mean_grad[i, k] = 0
        scale_grad[i, k] = 0
        color_grad[i, k] = 0
    for k in range(2):
        pixel_grad[i, k] = 0


@njit(**JIT)
def _chain(i, sums, row, means, quats, scales, opacities, view, lens, rows, outputs, view_grad, chunk):
    mean_grad, quat_grad, scale_grad, opacity_grad, color_grad, pixel_grad = outputs
    x, y, z = _to_camera(view, means, i)
    w, qx, qy, qz, inverse_norm = _unit_quaternion(quats, i)
    r = _rotation(w, qx, qy, qz)
    s0, s1, s2 = float(scales[i, 0]), float(scales[i, 1]), float(scales[i, 2])
    shape = scaled_columns(r, s0, s1, s2)
    slopes = _slopes(x, y, z, lens)
    a = _jacobian_times_view(slopes[0], slopes[1], slopes[2], slopes[3], view)
    b = times(a, shape)
    conic, pixel, conic_grad, opacity_grad[i] = _screen_grads(rows, opacities, sums, i, row)
    e00, e01, e11 = _covariance_grad(conic, conic_grad)  # cov = b b^T + eps
    f = (
        2 * (e00 * b[0] + e01 * b[3]),
        2 * (e00 * b[1] + e01 * b[4]),
        2 * (e00 * b[2] + e01 * b[5]),
        2 * (e01 * b[0] + e11 * b[3]),
        2 * (e01 * b[1] + e11 * b[4]),
        2 * (e01 * b[2] + e11 * b[5]),
    )
    m = transposed_times(a, f)
    product_grad = times_transposed(f, shape)
    point = _point_grad(x, y, z, lens, slopes, pixel, float(sums[row, 9]), _jacobian_grad(product_grad, view))
    _add_view_grad(view_grad, chunk, slopes, product_grad, point, means, i)
    turn = _quaternion_grad(w, qx, qy, qz, inverse_norm, scaled_columns(m, s0, s1, s2))
    for k in range(4):
        quat_grad[i, k] = turn[k]
    for k in range(3):
        mean_grad[i, k] = view[0, k] * point[0] + view[1, k] * point[1] + view[2, k] * point[2]
        color_grad[i, k] = sums[row, 6 + k]
    scale_grad[i, 0] = r[0] * m[0] + r[3] * m[3] + r[6] * m[6]
    scale_grad[i, 1] = r[1] * m[1] + r[4] * m[4] + r[7] * m[7]
    scale_grad[i, 2] = r[2] * m[2] + r[5] * m[5] + r[8] * m[8]
    pixel_grad[i, 0] = pixel[0]
    pixel_grad[i, 1] = pixel[1]


def view_parameters(view: Any, intrinsics: Any, width: int, height: int) -> tuple[Any, Any]:
    """View matrix and lens as float64 arrays for the kernels."""
    k = np.asarray(intrinsics, np.float64)
    lens = np.array([k[0, 0], k[1, 1], k[0, 2], k[1, 2], width, height], np.float64)
    return np.ascontiguousarray(view, np.float64), lens
