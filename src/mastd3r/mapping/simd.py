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

_Order = tuple[int, ...]
LANES = 8
FLOAT = ir.FloatType()
INDEX = ir.IntType(64)
VECTOR = ir.VectorType(FLOAT, LANES)
_INT32 = ir.IntType(32)
ZERO = ir.Constant(VECTOR, [ir.Constant(FLOAT, 0.0)] * LANES)
_INT_VECTOR = ir.VectorType(_INT32, LANES)
_HALF = ir.VectorType(FLOAT, 4)
# 2^x for |x| <= 1/2, highest power first: least largest relative error, 8e-8
_EXP2 = (0.001327647129, 0.009675540961, 0.05550713093, 0.2402212024, 0.693146944, 1.000000119)


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
            return _splat(other)
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

    def at_most(self, limit: Any) -> Lanes:
        """min(self, limit)."""
        bound = self._operand(limit)
        return Lanes(self.builder, self.builder.select(self.below(limit), self.value, bound))

    def at_least(self, limit: Any) -> Lanes:
        """max(self, limit)."""
        bound = self._operand(limit)
        return Lanes(self.builder, self.builder.select(self.above(limit), self.value, bound))

    def where(self, mask: Any, otherwise: Any = 0.0) -> Lanes:
        """self where the mask is true, ``otherwise`` elsewhere."""
        return Lanes(self.builder, self.builder.select(mask, self.value, self._operand(otherwise)))


def _splat(value: float) -> Any:
    return ir.Constant(VECTOR, [constant(value)] * LANES)


def broadcast(builder: Any, scalar: Any) -> Lanes:
    """One scalar in all lanes."""
    undefined = ir.Constant(VECTOR, ir.Undefined)
    first = builder.insert_element(undefined, scalar, ir.Constant(_INT32, 0))
    zeros = ir.Constant(ir.VectorType(_INT32, LANES), [ir.Constant(_INT32, 0)] * LANES)
    return Lanes(builder, builder.shuffle_vector(first, undefined, zeros))


def lane_numbers(builder: Any) -> Lanes:
    """0, 1, … 7."""
    return Lanes(builder, ir.Constant(VECTOR, [constant(i) for i in range(LANES)]))


def exp2(x: Lanes) -> Lanes:
    """2^x for x in -126 … 0: whole part into the exponent's bits, rest by a polynomial; relative error below 3e-7."""
    builder = x.builder
    whole = _of_one(x, "rint")
    rest = x - whole
    series = rest * _EXP2[0] + _EXP2[1]
    for coefficient in _EXP2[2:]:
        series = series * rest + coefficient
    places = ir.Constant(_INT_VECTOR, [ir.Constant(_INT32, 23)] * LANES)
    exponent = builder.shl(builder.fptosi(whole.value, _INT_VECTOR), places)
    bits = builder.add(builder.bitcast(series.value, _INT_VECTOR), exponent)
    return Lanes(builder, builder.bitcast(bits, VECTOR))


def square_root(x: Lanes) -> Lanes:
    """Of lanes that are not negative."""
    return _of_one(x, "sqrt")


def _of_one(x: Lanes, name: str) -> Lanes:
    """LLVM's function of that name, lane by lane."""
    kind = ir.FunctionType(VECTOR, [VECTOR])
    function = cgutils.get_or_insert_function(x.builder.module, kind, f"llvm.{name}.v{LANES}f32")
    return Lanes(x.builder, x.builder.call(function, [x.value]))


def minus_size(x: Lanes) -> Lanes:
    """-|x|."""
    sign = ir.Constant(_INT_VECTOR, [ir.Constant(_INT32, -(2**31))] * LANES)
    bits = x.builder.or_(x.builder.bitcast(x.value, _INT_VECTOR), sign)
    return Lanes(x.builder, x.builder.bitcast(bits, VECTOR))


def bits_of(builder: Any, mask: Any) -> Any:
    """A lane mask as a 64-bit integer, lane 0 in the lowest bit."""
    return builder.zext(builder.bitcast(mask, ir.IntType(LANES)), INDEX)


def store_sums(builder: Any, base: Any, at: Any, vectors: list[Lanes]) -> None:
    """Write the sum over the lanes of each of the vectors, one after the other from element ``at``."""
    for first in range(0, len(vectors), 4):
        group = [_half_sum(v) for v in vectors[first : first + 4]]
        number = len(group)
        group += [ir.Constant(_HALF, [constant(0.0)] * 4)] * (4 - number)
        a, b, c, d = group
        ab, cd = (_add_shuffled(builder, *two, (0, 4, 1, 5), (2, 6, 3, 7)) for two in ((a, b), (c, d)))
        total = _add_shuffled(builder, ab, cd, (0, 1, 4, 5), (2, 3, 6, 7))
        if number < 4:
            total = _shuffle(builder, total, total, tuple(range(number)))
        place = builder.gep(base, [builder.add(at, index(first))], source_etype=FLOAT)
        builder.store(total, builder.bitcast(place, total.type.as_pointer()), align=4)


def _half_sum(x: Lanes) -> Any:
    low, high = _shuffle(x.builder, x.value, x.value, (0, 1, 2, 3)), _shuffle(x.builder, x.value, x.value, (4, 5, 6, 7))
    return x.builder.fadd(low, high)


def _add_shuffled(builder: Any, a: Any, b: Any, one: _Order, other: _Order) -> Any:
    return builder.fadd(_shuffle(builder, a, b, one), _shuffle(builder, a, b, other))


def _shuffle(builder: Any, a: Any, b: Any, lanes: _Order) -> Any:
    order = ir.Constant(ir.VectorType(_INT32, len(lanes)), [ir.Constant(_INT32, lane) for lane in lanes])
    return builder.shuffle_vector(a, b, order)


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
