"""Eight float32 lanes for numba through LLVM vector types: no compiler is needed on the user's machine.

``Lanes`` overloads arithmetic, so that a kernel reads like its formula; LLVM turns it into the widest
instructions of the machine (AVX, SSE or NEON). Fast-math flags are set: no NaN, order of sums is free,
but fixed for a given machine, so results are repeatable.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from llvmlite import ir
from numba.core import cgutils

LANES = 8
FLOAT = ir.FloatType()
INDEX = ir.IntType(64)
VECTOR = ir.VectorType(FLOAT, LANES)
_INT32 = ir.IntType(32)
ZERO = ir.Constant(VECTOR, [ir.Constant(FLOAT, 0.0)] * LANES)


def constant(value: float) -> Any:
    """A float32 constant."""
    return ir.Constant(FLOAT, float(value))


def index(value: int) -> Any:
    """A 64-bit integer constant."""
    return ir.Constant(INDEX, value)


class Lanes:
    """Eight float32 values in an LLVM builder; the other operand may be Lanes, a number or a scalar."""

    def __init__(self, builder: Any, value: Any) -> None:
        self.builder, self.value = builder, value

    def _operand(self, other: Any) -> Any:
        if isinstance(other, Lanes):
            return other.value
        if isinstance(other, int | float):
            return ir.Constant(VECTOR, [constant(other)] * LANES)
        return broadcast(self.builder, other).value

    def _binary(self, operation: Callable[..., Any], left: Any, right: Any) -> Lanes:
        return Lanes(self.builder, operation(left, right, flags=("fast",)))

    def __add__(self, other: Any) -> Lanes:
        return self._binary(self.builder.fadd, self.value, self._operand(other))

    def __mul__(self, other: Any) -> Lanes:
        return self._binary(self.builder.fmul, self.value, self._operand(other))

    def __sub__(self, other: Any) -> Lanes:
        return self._binary(self.builder.fsub, self.value, self._operand(other))

    def __rsub__(self, other: Any) -> Lanes:
        return self._binary(self.builder.fsub, self._operand(other), self.value)

    def __truediv__(self, other: Any) -> Lanes:
        return self._binary(self.builder.fdiv, self.value, self._operand(other))

    __radd__ = __add__
    __rmul__ = __mul__

    def below(self, other: Any) -> Any:
        """Lane mask of self < other."""
        return self.builder.fcmp_ordered("<", self.value, self._operand(other))

    def above(self, other: Any) -> Any:
        """Lane mask of self > other."""
        return self.builder.fcmp_ordered(">", self.value, self._operand(other))

    def at_most(self, limit: float) -> Lanes:
        """min(self, limit)."""
        bound = self._operand(limit)
        chosen = self.builder.select(self.builder.fcmp_ordered("<", self.value, bound), self.value, bound)
        return Lanes(self.builder, chosen)

    def where(self, mask: Any) -> Lanes:
        """self where the mask is true, 0 elsewhere."""
        return Lanes(self.builder, self.builder.select(mask, self.value, ZERO))


def broadcast(builder: Any, scalar: Any) -> Lanes:
    """One scalar in all lanes."""
    undefined = ir.Constant(VECTOR, ir.Undefined)
    first = builder.insert_element(undefined, scalar, ir.Constant(_INT32, 0))
    zeros = ir.Constant(ir.VectorType(_INT32, LANES), [ir.Constant(_INT32, 0)] * LANES)
    return Lanes(builder, builder.shuffle_vector(first, undefined, zeros))


def lane_numbers(builder: Any) -> Lanes:
    """0, 1, … 7."""
    return Lanes(builder, ir.Constant(VECTOR, [constant(i) for i in range(LANES)]))


def exp_negative(x: Lanes) -> Lanes:
    """exp(x) for x in -6 … 0: a degree-6 series of x/16, to the 16th power; relative error below 1e-6."""
    y = x * (1 / 16)
    series = y * (1 / 720) + 1 / 120
    for coefficient in (1 / 24, 1 / 6, 1 / 2, 1.0, 1.0):
        series = series * y + coefficient
    for _ in range(4):
        series = series * series
    return series


def load(builder: Any, base: Any, at: Any) -> Lanes:
    """Eight neighbours of a float32 array, from element ``at``."""
    return Lanes(builder, builder.load(_vector_pointer(builder, base, at), align=4, typ=VECTOR))


def store(builder: Any, base: Any, at: Any, lanes: Lanes) -> None:
    """Write eight neighbours of a float32 array, from element ``at``."""
    builder.store(lanes.value, _vector_pointer(builder, base, at), align=4)


def load_scalar(builder: Any, base: Any, at: Any) -> Any:
    """One element of a float32 array."""
    return builder.load(builder.gep(base, [at], source_etype=FLOAT), typ=FLOAT, align=4)


def data_pointer(context: Any, builder: Any, array_type: Any, array: Any) -> Any:
    """Address of the first element of a contiguous numba array."""
    return cgutils.create_struct_proxy(array_type)(context, builder, value=array).data


def _vector_pointer(builder: Any, base: Any, at: Any) -> Any:
    return builder.bitcast(builder.gep(base, [at], source_etype=FLOAT), VECTOR.as_pointer())
