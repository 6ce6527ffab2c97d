"""Gaussians over the pixels of one 16 x 16 tile, sixteen pixels at a time, forward and backward.

A tile has 16 blocks of 8 x 2 pixels: block b = 8 · half + band spans columns 8 · half … and rows 2 · band …; a set of
blocks is an integer with bit b. The tile is a float32 scratch array, block after block, each with planes of 16 pixels
in the order of the PLANE constants. Transmittance is kept negative once a pixel is opaque (it would fall to 1e-4 or
below), or outside the image. Alpha of a pixel = min(0.999, 2^e), e = log2 opacity - log2(e)/2 d^T conic d, cut to 0
below 1/255. What blending reads of a Gaussian is one row of 16 floats, 64 bytes; the ROW constants name its columns.
For developers: numba's cache on disk watches only the file of a kernel, so after a change in this file, in
``simd.py`` or in ``rasterise_cpu_matrices.py`` remove ``__pycache__/rasterise_cpu_*.nb?``.
"""

# mypy: disallow-untyped-defs=False
from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from contextlib import contextmanager
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
    bits_of,
    broadcast,
    constant,
    data_pointer,
    exp2,
    index,
    lane_numbers,
    load,
    load_scalar,
    minus_size,
    square_root,
    store,
    store_sums,
)

TILE = 16
GROUP = 2  # tiles along a side of a group, which share one list of Gaussians
GROUP_PIXELS = GROUP * TILE
BLOCKS, BANDS = 16, 8  # blocks of a tile, and of a half of it
CHANNELS = 4  # red, green, blue, depth
ALPHA_CUT = 1 / 255
ALPHA_MAX = 0.999
TRANSMITTANCE_STOP = 1e-4
LOG2_CUT = math.log2(ALPHA_CUT)
MARGIN = 1e-3  # px by which an ellipse is taken wider, so that rounding hides no pixel of it

PLANE_TRANSMITTANCE = 0
PLANE_COLOR = 1  # forward: accumulated channels
PLANE_BEHIND = 1  # backward: loss gradient times all that lies behind
PLANE_COLOR_GRAD = 2  # backward: loss gradient of the channels
PIXELS = 2 * LANES  # of a block
BLOCK_FORWARD = (1 + CHANNELS) * PIXELS
BLOCK_BACKWARD = (2 + CHANNELS) * PIXELS
SUMS = 6 + CHANNELS  # of the backward pass: g, g dx, g dy, g dx², g dx dy, g dy², channels

# e = (A dx + B dy) dx + C dy² + LOG2; the ellipse of alpha 1/255 reaches REACH to the sides, its rightmost point lies
# TURN below the centre; at dy it spans SHEAR dy ± sqrt(WIDE - NARROW dy²)
(
    ROW_X, ROW_Y, ROW_A, ROW_B, ROW_C, ROW_LOG2, ROW_CHANNEL, _, _, _,
    ROW_REACH_X, ROW_REACH_Y, ROW_TURN, ROW_SHEAR, ROW_WIDE, ROW_NARROW,
) = range(16)  # fmt: skip
ROW = 16


class _Gaussian:
    """The row of one Gaussian, read as it is needed."""

    def __init__(self, builder: Any, base: Any, number: Any) -> None:
        self.builder, self.base, self.start = builder, base, builder.mul(number, index(ROW))

    def scalar(self, column: int) -> Any:
        return load_scalar(self.builder, self.base, self.builder.add(self.start, index(column)))

    def lanes(self, column: int) -> Lanes:
        return broadcast(self.builder, self.scalar(column))

    def channels(self) -> list[Lanes]:
        return [self.lanes(ROW_CHANNEL + i) for i in range(CHANNELS)]


class _Block:
    """One block of a tile: places of its pixels, and its planes as two vectors, a row each."""

    def __init__(self, builder: Any, tile: Any, number: Any, floats: int) -> None:
        self.builder, self.tile, self.start = builder, tile, builder.mul(number, index(floats))

    def _at(self, plane: int, row: int) -> Any:
        return self.builder.add(self.start, index(plane * PIXELS + row * LANES))

    def load(self, plane: int, row: int) -> Lanes:
        return load(self.builder, self.tile, self._at(plane, row))

    def store(self, plane: int, row: int, value: Lanes) -> None:
        store(self.builder, self.tile, self._at(plane, row), value)


class _Slots:
    """Vectors that a loop changes; LLVM keeps them in registers as far as there are any."""

    def __init__(self, builder: Any, count: int) -> None:
        self.builder = builder
        self.slots = [cgutils.alloca_once(builder, VECTOR) for _ in range(count)]
        self.clear()

    def clear(self) -> None:
        for slot in self.slots:
            self.builder.store(ZERO, slot)

    def get(self, number: int) -> Lanes:
        return Lanes(self.builder, self.builder.load(self.slots[number], typ=VECTOR))

    def put(self, number: int, value: Lanes) -> None:
        self.builder.store(value.value, self.slots[number])

    def add(self, number: int, value: Lanes) -> None:
        self.put(number, self.get(number) + value)


def _floats(builder: Any, number: Any) -> Lanes:
    return broadcast(builder, builder.sitofp(number, FLOAT))


def _offset_x(builder: Any, gaussian: _Gaussian, half: Any) -> Lanes:
    """dx of eight columns: the same in both rows of a block."""
    first = builder.fsub(builder.sitofp(builder.mul(half, index(LANES)), FLOAT), gaussian.scalar(ROW_X))
    return lane_numbers(builder) + first


def _offsets_y(builder: Any, gaussian: _Gaussian, band: Any) -> list[Any]:
    """dy of the two rows of a block, scalars."""
    first = builder.fsub(builder.sitofp(builder.mul(band, index(2)), FLOAT), gaussian.scalar(ROW_Y))
    return [first, builder.fadd(first, constant(1.0))]


def _raw_alpha(builder: Any, gaussian: _Gaussian, dx: Lanes, dy: Any) -> tuple[Lanes, Any]:
    """2^e of eight pixels, and where it is not cut: elsewhere the value may be anything."""
    slope = builder.fmul(gaussian.scalar(ROW_B), dy)
    level = builder.fadd(
        builder.fmul(builder.fmul(gaussian.scalar(ROW_C), dy), dy, flags=("fast",)),
        gaussian.scalar(ROW_LOG2),
        flags=("fast",),
    )
    e = (dx * gaussian.scalar(ROW_A) + slope) * dx + level
    return exp2(e), e.above(LOG2_CUT)


def _pass(transmittance: Lanes, alpha: Lanes) -> tuple[Lanes, Lanes, Any]:
    """Transmittance behind a Gaussian, the Gaussian's weight, and where the pixel stays open."""
    weight = alpha * transmittance
    after = transmittance - weight
    stays = after.above(TRANSMITTANCE_STOP)
    return after.where(stays, minus_size(transmittance)), weight.where(stays), stays


@intrinsic
def ellipse_blocks(typing, rows, gaussian, x, y):
    """Blocks that the ellipse of a Gaussian reaches when its centre is at x, y of the tile (pixels are integers)."""
    signature = types.int64(rows, types.intp, types.float32, types.float32)

    def generate(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        row = _Gaussian(builder, data_pointer(context, builder, sig.args[0], args[0]), args[1])
        x, y = broadcast(builder, args[2]), broadcast(builder, args[3])
        top = lane_numbers(builder) * 2.0 - y
        bottom = top + 1.0
        reach, turn, shear = row.lanes(ROW_REACH_Y), row.lanes(ROW_TURN), row.lanes(ROW_SHEAR)
        wide, narrow = row.lanes(ROW_WIDE), row.lanes(ROW_NARROW)

        def side(turn: Lanes, sign: float) -> Lanes:
            dy = top.at_least(turn).at_most(bottom)
            return x + shear * dy + (square_root((wide - narrow * dy * dy).at_least(0.0)) + MARGIN) * sign

        right, left = side(turn, 1.0), side(0.0 - turn, -1.0)
        inside = builder.and_(bits_of(builder, top.below(reach)), bits_of(builder, bottom.above(0.0 - reach)))
        halves = []
        for half in range(2):
            first, last = float(LANES * half), float(LANES * half + LANES - 1)
            hit = builder.and_(bits_of(builder, left.below(last)), bits_of(builder, right.above(first)))
            halves.append(builder.and_(inside, hit))
        return builder.or_(halves[0], builder.shl(halves[1], index(BANDS)))

    return signature, generate


@intrinsic
def blend_forward(typing, tile, block, gaussians, listed, first, count, weights):
    """Blend ``count`` Gaussians over one block, front to back: color += T alpha f, T *= 1 - alpha.

    ``listed[first …]`` are their rows in ``gaussians``, whose centres are relative to the tile; ``weights`` (count, 16)
    is scratch memory. Returns whether any pixel of the block is still open.
    """
    signature = types.boolean(tile, types.intp, gaussians, listed, types.intp, types.intp, weights)

    def generate(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        arrays = (data_pointer(context, builder, sig.args[i], args[i]) for i in (0, 2, 3, 6))
        tile_at, rows_at, list_at, weights_at = arrays
        block = _Block(builder, tile_at, args[1], BLOCK_FORWARD)
        half, band = builder.lshr(args[1], index(3)), builder.and_(args[1], index(BANDS - 1))
        transmittance = _Slots(builder, 2)
        for row in range(2):
            transmittance.put(row, block.load(PLANE_TRANSMITTANCE, row))
        with cgutils.for_range(builder, args[5]) as loop:
            gaussian = _Gaussian(builder, rows_at, _listed(builder, list_at, args[4], loop.index))
            dx, kept = _offset_x(builder, gaussian, half), _Block(builder, weights_at, loop.index, PIXELS)
            for row, dy in enumerate(_offsets_y(builder, gaussian, band)):
                raw, seen = _raw_alpha(builder, gaussian, dx, dy)
                after, weight, _ = _pass(transmittance.get(row), raw.at_most(ALPHA_MAX).where(seen))
                transmittance.put(row, after)
                kept.store(0, row, weight)
        for row in range(2):
            block.store(PLANE_TRANSMITTANCE, row, transmittance.get(row))
        _add_colors(builder, block, rows_at, weights_at, lambda k: _listed(builder, list_at, args[4], k), args[5])
        return _any_open(builder, [transmittance.get(0), transmittance.get(1)])

    return signature, generate


def _listed(builder: Any, listed: Any, first: Any, number: Any) -> Any:
    place = builder.gep(listed, [builder.add(first, number)], source_etype=ir.IntType(32))
    return builder.zext(builder.load(place, typ=ir.IntType(32)), INDEX)


def _add_colors(
    builder: Any, block: _Block, rows_at: Any, weights_at: Any, listed: Callable[[Any], Any], count: Any
) -> None:
    """The channels, in a loop of their own: so the sums of both loops stay in registers."""
    planes = [(PLANE_COLOR + i, row) for i in range(CHANNELS) for row in range(2)]
    color = _Slots(builder, len(planes))
    for number, plane in enumerate(planes):
        color.put(number, block.load(*plane))
    with cgutils.for_range(builder, count) as loop:
        kept = _Block(builder, weights_at, loop.index, PIXELS)
        weights = [kept.load(0, row) for row in range(2)]
        for i, channel in enumerate(_Gaussian(builder, rows_at, listed(loop.index)).channels()):
            for row in range(2):
                color.add(2 * i + row, weights[row] * channel)
    for number, plane in enumerate(planes):
        block.store(*plane, color.get(number))


def _any_open(builder: Any, transmittance: list[Lanes]) -> Any:
    first, second = (bits_of(builder, t.above(0.0)) for t in transmittance)
    return builder.icmp_unsigned("!=", builder.or_(first, second), index(0))


@intrinsic
def block_open(typing, tile, block):
    """Whether any pixel of a block of the backward pass is still open."""
    signature = types.boolean(tile, types.intp)

    def generate(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        block = _Block(builder, data_pointer(context, builder, sig.args[0], args[0]), args[1], BLOCK_BACKWARD)
        return _any_open(builder, [block.load(PLANE_TRANSMITTANCE, row) for row in range(2)])

    return signature, generate


@contextmanager
def _each_bit(builder: Any, bits: Any) -> Iterator[Any]:
    """A loop over the numbers of the set bits, lowest first."""
    head, body, done = (builder.append_basic_block(f"bits.{name}") for name in ("head", "body", "done"))
    left = cgutils.alloca_once(builder, INDEX)
    builder.store(bits, left)
    builder.branch(head)
    builder.position_at_end(head)
    now = builder.load(left, typ=INDEX)
    builder.cbranch(builder.icmp_unsigned("!=", now, index(0)), body, done)
    builder.position_at_end(body)
    yield builder.cttz(now, ir.Constant(ir.IntType(1), 1))
    builder.store(builder.and_(now, builder.sub(now, index(1))), left)
    builder.branch(head)
    builder.position_at_end(done)


@intrinsic
def blend_backward(typing, tile, gaussians, number, blocks, sums, pair):
    """Repeat ``blend_forward`` for one Gaussian; its loss gradients, summed over the blocks, go to ``sums[pair]``.

    The plane ``behind`` starts as grad · final colour - T_end · grad_alpha and loses each Gaussian's own
    part, so that d loss / d alpha = T (grad · f) - behind / (1 - alpha) needs no second, back-to-front pass.
    """
    signature = types.void(tile, gaussians, types.intp, types.int64, sums, types.intp)

    def generate(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        tile_at, rows_at, sums_at = (data_pointer(context, builder, sig.args[i], args[i]) for i in (0, 1, 4))
        gaussian = _Gaussian(builder, rows_at, args[2])
        channels = gaussian.channels()
        total, by_row = _Slots(builder, SUMS), _Slots(builder, 3)
        with cgutils.for_range(builder, index(2)) as halves:
            dx = _offset_x(builder, gaussian, halves.index)
            first = builder.mul(halves.index, index(BANDS))
            by_row.clear()
            with _each_bit(builder, builder.and_(builder.lshr(args[3], first), index(2**BANDS - 1))) as band:
                block = _Block(builder, tile_at, builder.add(first, band), BLOCK_BACKWARD)
                for row, dy in enumerate(_offsets_y(builder, gaussian, band)):
                    g = _backward_pixels(builder, gaussian, channels, block, row, dx, dy, total)
                    for power, slope in enumerate((1.0, dy, builder.fmul(dy, dy))):
                        by_row.add(power, g * slope)
            s, s_dy, s_dy2 = (by_row.get(i) for i in range(3))
            for i, lanes in enumerate((s, s * dx, s_dy, s * dx * dx, s_dy * dx, s_dy2)):
                total.add(i, lanes)
        store_sums(builder, sums_at, builder.mul(args[5], index(SUMS)), [total.get(i) for i in range(SUMS)])
        return context.get_dummy_value()

    return signature, generate


def _backward_pixels(
    builder: Any, gaussian: _Gaussian, channels: list[Lanes], block: _Block, row: int, dx: Lanes, dy: Any, total: _Slots
) -> Lanes:
    """One row of a block: minus the loss gradient of the power; the channels' gradients go to ``total``."""
    raw, seen = _raw_alpha(builder, gaussian, dx, dy)
    alpha = raw.at_most(ALPHA_MAX).where(seen)
    transmittance = block.load(PLANE_TRANSMITTANCE, row)
    after, weight, stays = _pass(transmittance, alpha)
    block.store(PLANE_TRANSMITTANCE, row, after)
    grad_dot_feature = Lanes(builder, ZERO)
    for i, channel in enumerate(channels):
        color_grad = block.load(PLANE_COLOR_GRAD + i, row)
        grad_dot_feature = grad_dot_feature + color_grad * channel
        total.add(6 + i, weight * color_grad)
    behind = block.load(PLANE_BEHIND, row) - weight * grad_dot_feature
    block.store(PLANE_BEHIND, row, behind)
    alpha_grad = transmittance * grad_dot_feature - behind / (1.0 - alpha)
    return (alpha_grad * raw).where(seen).where(stays).where(raw.below(ALPHA_MAX))
