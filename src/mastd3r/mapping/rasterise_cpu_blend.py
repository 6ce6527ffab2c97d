"""One Gaussian over the pixels of one 16 x 16 tile, eight pixels at a time, forward and backward.

A tile is a float32 scratch array of 16 rows; each row holds planes of 16 pixels, in the order of the PLANE
constants. ``live`` is 1 until a pixel is opaque (transmittance would fall to 1e-4 or below), then 0.
Alpha of a pixel = min(0.999, opacity * exp(-power)), power = 1/2 d^T conic d, cut to 0 below 1/255.
For developers: numba's cache on disk watches only the file of a kernel, so after a change in this file or in
``simd.py`` remove ``__pycache__/rasterise_cpu_tiles*.nb?``.
"""

# mypy: disallow-untyped-defs=False
from __future__ import annotations

from typing import Any

from llvmlite import ir
from numba.core import cgutils, types
from numba.extending import intrinsic

from .simd import (
    FLOAT,
    INDEX,
    LANES,
    VECTOR,
    ZERO,
    Lanes,
    constant,
    data_pointer,
    exp_negative,
    index,
    lane_numbers,
    load,
    load_scalar,
    store,
)

TILE = 16
CHANNELS = 4  # red, green, blue, depth
ALPHA_CUT = 1 / 255
ALPHA_MAX = 0.999
TRANSMITTANCE_STOP = 1e-4
POWER_MAX = 6.0  # above ln(255), where every alpha is cut

PLANE_TRANSMITTANCE, PLANE_LIVE = 0, 1
PLANE_COLOR = 2  # forward: accumulated channels
PLANE_BEHIND = 2  # backward: loss gradient times all that lies behind
PLANE_COLOR_GRAD = 3  # backward: loss gradient of the channels
ROW_FORWARD = (2 + CHANNELS) * TILE
ROW_BACKWARD = (3 + CHANNELS) * TILE
SUMS = 6 + CHANNELS  # of the backward pass: g, g dx, g dy, g dx², g dx dy, g dy², channels

_SCALARS = [types.float32] * 7  # conic a, b, c; opacity; centre x, y in the tile; largest power


class _TileLoop:
    """Rows and half rows of a tile that a Gaussian reaches; gives power and addresses for eight pixels."""

    def __init__(self, builder: Any, scalars: Any, row_floats: int) -> None:
        self.builder, self.row_floats = builder, row_floats
        self.a, self.b, self.c, self.opacity, self.centre_x, self.centre_y, self.power_max = scalars
        self.half_a = builder.fmul(constant(0.5), self.a)
        self.half_c = builder.fmul(constant(0.5), self.c)

    def row(self, y: Any) -> None:
        """Terms that a whole row shares."""
        b = self.builder
        self.y = y
        self.dy = b.fsub(b.sitofp(y, FLOAT), self.centre_y)
        self.dy_squared = b.fmul(self.dy, self.dy)
        self.row_power = b.fmul(self.half_c, self.dy_squared)
        self.row_slope = b.fmul(self.b, self.dy)

    def half(self, half: Any) -> tuple[Lanes, Lanes]:
        """dx and power of eight pixels."""
        b = self.builder
        self.base = b.add(b.mul(self.y, index(self.row_floats)), b.mul(half, index(LANES)))
        first = b.fsub(b.fmul(b.sitofp(half, FLOAT), constant(LANES)), self.centre_x)
        dx = lane_numbers(b) + first
        return dx, (dx * self.half_a + self.row_slope) * dx + self.row_power

    def raw_alpha(self, power: Lanes) -> Lanes:
        """opacity * exp(-power), before clamp and cut."""
        return exp_negative(power.at_most(POWER_MAX) * -1.0) * self.opacity

    def plane(self, number: int) -> Any:
        """Address of the eight pixels in a plane."""
        return self.builder.add(self.base, index(TILE * number))


def _features(builder: Any, base: Any, gaussian: Any) -> list[Any]:
    start = builder.mul(gaussian, index(CHANNELS))
    return [load_scalar(builder, base, builder.add(start, index(i))) for i in range(CHANNELS)]


@intrinsic
def blend_forward(typing, tile, row0, row1, half0, half1, a, b, c, opacity, x, y, power_max, features, gaussian):
    """Add one Gaussian to a tile, front to back: color += T alpha f, T *= 1 - alpha."""
    signature = types.void(tile, *([types.intp] * 4), *_SCALARS, features, types.intp)

    def generate(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        tile_at = data_pointer(context, builder, sig.args[0], args[0])
        feature = _features(builder, data_pointer(context, builder, sig.args[12], args[12]), args[13])
        loop = _TileLoop(builder, args[5:12], ROW_FORWARD)
        with cgutils.for_range(builder, builder.sub(args[2], args[1])) as rows:
            loop.row(builder.add(rows.index, args[1]))
            with cgutils.for_range(builder, builder.sub(args[4], args[3])) as halves:
                _, power = loop.half(builder.add(halves.index, args[3]))
                alpha = loop.raw_alpha(power).at_most(ALPHA_MAX).where(power.below(loop.power_max))
                transmittance = load(builder, tile_at, loop.plane(PLANE_TRANSMITTANCE))
                stays = (transmittance * (1.0 - alpha)).above(TRANSMITTANCE_STOP)
                live = load(builder, tile_at, loop.plane(PLANE_LIVE)).where(stays)
                weight = live * alpha * transmittance
                store(builder, tile_at, loop.plane(PLANE_TRANSMITTANCE), transmittance - weight)
                store(builder, tile_at, loop.plane(PLANE_LIVE), live)
                for i in range(CHANNELS):
                    at = loop.plane(PLANE_COLOR + i)
                    store(builder, tile_at, at, load(builder, tile_at, at) + weight * feature[i])
        return context.get_dummy_value()

    return signature, generate


class _Sums:
    """Vector accumulators that live in registers for one Gaussian."""

    def __init__(self, builder: Any) -> None:
        self.builder = builder
        self.slots = [cgutils.alloca_once_value(builder, ZERO) for _ in range(SUMS)]
        for slot in self.slots:
            builder.store(ZERO, slot)

    def add(self, number: int, lanes: Lanes) -> None:
        before = self.builder.load(self.slots[number], typ=VECTOR)
        self.builder.store(self.builder.fadd(before, lanes.value, flags=("fast",)), self.slots[number])

    def write(self, base: Any) -> None:
        for number, slot in enumerate(self.slots):
            value = Lanes(self.builder, self.builder.load(slot, typ=VECTOR))
            store(self.builder, base, ir.Constant(INDEX, LANES * number), value)


@intrinsic
def blend_backward(typing, tile, sums, row0, row1, half0, half1, a, b, c, opacity, x, y, power_max, features, gaussian):
    """Repeat ``blend_forward`` and sum the loss gradients of one Gaussian over the tile into ``sums``.

    The plane ``behind`` starts as grad · final colour - T_end · grad_alpha and loses each Gaussian's own
    part, so that d loss / d alpha = T (grad · f) - behind / (1 - alpha) needs no second, back-to-front pass.
    """
    signature = types.void(tile, sums, *([types.intp] * 4), *_SCALARS, features, types.intp)

    def generate(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        tile_at = data_pointer(context, builder, sig.args[0], args[0])
        feature = _features(builder, data_pointer(context, builder, sig.args[13], args[13]), args[14])
        loop, total = _TileLoop(builder, args[6:13], ROW_BACKWARD), _Sums(builder)
        with cgutils.for_range(builder, builder.sub(args[3], args[2])) as rows:
            loop.row(builder.add(rows.index, args[2]))
            with cgutils.for_range(builder, builder.sub(args[5], args[4])) as halves:
                dx, power = loop.half(builder.add(halves.index, args[4]))
                _backward_pixels(builder, loop, total, tile_at, feature, dx, power)
        total.write(data_pointer(context, builder, sig.args[1], args[1]))
        return context.get_dummy_value()

    return signature, generate


def _backward_pixels(
    builder: Any, loop: _TileLoop, total: _Sums, tile_at: Any, feature: list[Any], dx: Lanes, power: Lanes
) -> None:
    raw = loop.raw_alpha(power)
    alpha = raw.at_most(ALPHA_MAX).where(power.below(loop.power_max))
    transmittance = load(builder, tile_at, loop.plane(PLANE_TRANSMITTANCE))
    stays = (transmittance * (1.0 - alpha)).above(TRANSMITTANCE_STOP)
    live = load(builder, tile_at, loop.plane(PLANE_LIVE)).where(stays)
    alpha = alpha * live
    weight = alpha * transmittance
    store(builder, tile_at, loop.plane(PLANE_TRANSMITTANCE), transmittance - weight)
    store(builder, tile_at, loop.plane(PLANE_LIVE), live)
    grad_dot_feature = Lanes(builder, ZERO)
    for i in range(CHANNELS):
        color_grad = load(builder, tile_at, loop.plane(PLANE_COLOR_GRAD + i))
        grad_dot_feature = grad_dot_feature + color_grad * feature[i]
        total.add(6 + i, weight * color_grad)
    behind = load(builder, tile_at, loop.plane(PLANE_BEHIND)) - weight * grad_dot_feature
    store(builder, tile_at, loop.plane(PLANE_BEHIND), behind)
    alpha_grad = transmittance * grad_dot_feature - behind / (1.0 - alpha)
    alpha_grad = alpha_grad.where(alpha.above(0.0)).where(raw.below(ALPHA_MAX))
    g = alpha_grad * raw  # minus the gradient of power
    g_dx, g_dy = g * dx, g * loop.dy
    for number, lanes in enumerate((g, g_dx, g_dy, g_dx * dx, g_dx * loop.dy, g * loop.dy_squared)):
        total.add(number, lanes)
