"""A numba type for `WIDTH` numbers that go through the same arithmetic side by side: one vector register, a number per lane.

Kernels only: values of this type live inside compiled functions. Each operation is that of IEEE 754 on each lane by itself,
so a result depends neither on the other lanes nor on the place among them, and a NaN stays in its lane.

A kernel that reads and writes its arrays through `get`, `put`, `entry` and `set_entry` is written once for both kinds of
number: an array (n,) or (n,m) holds floats, a table (n,WIDTH) or (n,m,WIDTH) holds lanes.
"""

from __future__ import annotations

import math
import operator
from typing import Any

import numpy as np
from llvmlite import ir
from numba import njit, types
from numba.core import cgutils
from numba.core.typing.templates import AbstractTemplate, infer_global, signature
from numba.extending import intrinsic, lower_builtin, models, overload, register_model
from numpy.typing import NDArray

from testbed.physics.rotations import half_turn

WIDTH = 8
"""Numbers side by side: a cache line of doubles, one AVX-512 register or two of AVX2."""
LINE = 64
_VECTOR = ir.VectorType(ir.DoubleType(), WIDTH)


class LanesType(types.Type):
    """`WIDTH` doubles."""

    def __init__(self) -> None:
        super().__init__(name=f"lanes{WIDTH}")


lanes = LanesType()


@register_model(LanesType)
class _LanesModel(models.PrimitiveModel):
    def __init__(self, manager: Any, kind: Any) -> None:
        super().__init__(manager, kind, _VECTOR)


def aligned(rows: int) -> NDArray[np.float64]:
    """Zeros (rows, `WIDTH`) on cache lines: a row is one `load`."""
    raw = np.zeros(rows * WIDTH + LINE // 8)
    skip = (-raw.ctypes.data % LINE) // 8
    return raw[skip : skip + rows * WIDTH].reshape(rows, WIDTH)


def _splat(builder: Any, number: Any) -> Any:
    first = builder.insert_element(ir.Constant(_VECTOR, ir.Undefined), number, ir.Constant(ir.IntType(32), 0))
    mask = ir.Constant(ir.VectorType(ir.IntType(32), WIDTH), [0] * WIDTH)
    return builder.shuffle_vector(first, ir.Constant(_VECTOR, ir.Undefined), mask)


def _as_lanes(builder: Any, value: Any, kind: Any) -> Any:
    return value if isinstance(kind, LanesType) else _splat(builder, value)


def _register(function: Any, instruction: str) -> None:
    """Let an operator take two lanes, or lanes and a float64 that stands for `WIDTH` equal numbers."""

    @infer_global(function)
    class Template(AbstractTemplate):
        def generic(self, args: Any, kws: Any) -> Any:
            known = all(isinstance(a, LanesType) or a == types.float64 for a in args)
            if len(args) == 2 and known and any(isinstance(a, LanesType) for a in args):
                return signature(lanes, *args)
            return None

    def lower(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        left, right = (_as_lanes(builder, value, kind) for value, kind in zip(args, sig.args, strict=True))
        return getattr(builder, instruction)(left, right)

    for kinds in ((LanesType, LanesType), (LanesType, types.Float), (types.Float, LanesType)):
        lower_builtin(function, *kinds)(lower)


for _operator, _instruction in (
    (operator.add, "fadd"),
    (operator.sub, "fsub"),
    (operator.mul, "fmul"),
    (operator.truediv, "fdiv"),
):
    _register(_operator, _instruction)


@infer_global(operator.neg)
class _Negative(AbstractTemplate):
    def generic(self, args: Any, kws: Any) -> Any:
        return signature(lanes, lanes) if args == (lanes,) else None


@lower_builtin(operator.neg, LanesType)
def _lower_negative(context: Any, builder: Any, sig: Any, args: Any) -> Any:
    return builder.fneg(args[0])


def _pointer(context: Any, builder: Any, array_type: Any, array: Any, row: Any) -> Any:
    data = context.make_array(array_type)(context, builder, array).data
    first = builder.mul(row, ir.Constant(row.type, WIDTH))
    return builder.bitcast(builder.gep(data, [first], inbounds=True), _VECTOR.as_pointer())


def _is_table(kind: Any) -> bool:
    return isinstance(kind, types.Array) and kind.dtype == types.float64 and kind.ndim > 1 and kind.layout == "C"


@intrinsic
def load(typing_context: Any, table: Any, row: Any) -> Any:
    """Row of a table of `aligned`, counted through all its axes but the last."""
    if not _is_table(table) or not isinstance(row, types.Integer):
        return None

    def generate(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        return builder.load(_pointer(context, builder, table, *args), align=LINE)

    return lanes(table, types.intp), generate


@intrinsic
def store(typing_context: Any, table: Any, row: Any, value: Any) -> Any:
    """Set a row of a table of `aligned`."""
    if not _is_table(table) or not isinstance(row, types.Integer) or not isinstance(value, LanesType):
        return None

    def generate(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        builder.store(args[2], _pointer(context, builder, table, args[0], args[1]), align=LINE)
        return context.get_dummy_value()

    return types.void(table, types.intp, lanes), generate


@intrinsic
def splat(typing_context: Any, number: Any) -> Any:
    """The same number in each lane."""
    if number != types.float64:
        return None

    def generate(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        return _splat(builder, args[0])

    return lanes(types.float64), generate


def _unary(name: str) -> Any:
    @intrinsic
    def function(typing_context: Any, value: Any) -> Any:
        if not isinstance(value, LanesType):
            return None

        def generate(context: Any, builder: Any, sig: Any, args: Any) -> Any:
            kind = ir.FunctionType(_VECTOR, [_VECTOR])
            return builder.call(cgutils.get_or_insert_function(builder.module, kind, f"llvm.{name}.v{WIDTH}f64"), args)

        return lanes(lanes), generate

    return function


def _binary_each(name: str) -> Any:
    """A function of the C library on the lanes one by one: the same bits as on floats."""

    @intrinsic
    def function(typing_context: Any, left: Any, right: Any) -> Any:
        if not isinstance(left, LanesType) or not isinstance(right, LanesType):
            return None

        def generate(context: Any, builder: Any, sig: Any, args: Any) -> Any:
            kind = ir.FunctionType(ir.DoubleType(), [ir.DoubleType()] * 2)
            call = cgutils.get_or_insert_function(builder.module, kind, name)
            out = ir.Constant(_VECTOR, ir.Undefined)
            for lane in range(WIDTH):
                at = ir.Constant(ir.IntType(32), lane)
                numbers = [builder.extract_element(vector, at) for vector in args]
                out = builder.insert_element(out, builder.call(call, numbers), at)
            return out

        return lanes(lanes, lanes), generate

    return function


_angle = _binary_each("atan2")
_square_root = _unary("sqrt")
floor = _unary("floor")


def get(array: Any, i: Any) -> Any:
    """Number i: a float of an array (n,), lanes of a table (n,WIDTH)."""
    raise NotImplementedError("kernels only")


def put(array: Any, i: Any, x: Any) -> None:
    """Set number i; a float fills all lanes of a table."""
    raise NotImplementedError("kernels only")


def entry(array: Any, i: Any, j: Any) -> Any:
    """Number (i,j) of an array (n,m) or a table (n,m,WIDTH)."""
    raise NotImplementedError("kernels only")


def set_entry(array: Any, i: Any, j: Any, x: Any) -> None:
    """Set number (i,j)."""
    raise NotImplementedError("kernels only")


@overload(get)
def _get(array, i):
    return (lambda array, i: array[i]) if array.ndim == 1 else lambda array, i: load(array, i)


@overload(put)
def _put(array, i, x):
    if array.ndim > 1:
        return lambda array, i, x: store(array, i, as_lanes(x))

    def put_float(array, i, x):
        array[i] = x

    return put_float


@overload(entry)
def _entry(array, i, j):
    if array.ndim == 2:
        return lambda array, i, j: array[i, j]
    return lambda array, i, j: load(array, i * array.shape[1] + j)


@overload(set_entry)
def _set_entry(array, i, j, x):
    if array.ndim > 2:
        return lambda array, i, j, x: store(array, i * array.shape[1] + j, as_lanes(x))

    def set_float(array, i, j, x):
        array[i, j] = x

    return set_float


def as_lanes(x: Any) -> Any:
    """Lanes as they are, a float in each lane."""
    raise NotImplementedError("kernels only")


@overload(as_lanes)
def _lanes_of(x):
    return (lambda x: x) if isinstance(x, LanesType) else lambda x: splat(float(x))


def is_zero(x: Any) -> Any:
    """Whether a number is zero and may be left out of a sum; lanes are never taken to be."""
    raise NotImplementedError("kernels only")


@overload(is_zero)
def _is_zero(x):
    return (lambda x: False) if isinstance(x, LanesType) else lambda x: x == 0.0


TERMS = 9
_SINE = tuple(1.0 / math.factorial(2 * k + 1) for k in range(TERMS))
_COSINE = tuple(1.0 / math.factorial(2 * k) for k in range(TERMS))


@njit(cache=True, nogil=True, forceinline=True)
def circular(u):
    """sin(x)/x and cos(x) for u = -x², by their series: exact to rounding up to x = 1, and to 1e-12 up to x = pi / 2."""
    sine, cosine = splat(_SINE[TERMS - 1]), splat(_COSINE[TERMS - 1])
    for k in range(TERMS - 2, -1, -1):
        sine = sine * u + _SINE[k]
        cosine = cosine * u + _COSINE[k]
    return sine, cosine


@njit(cache=True, nogil=True, forceinline=True)
def sine_cosine(x):
    """Through the half angle: exact to rounding up to 90°, where latitudes end."""
    half = 0.5 * x
    sine, cosine = circular(-(half * half))
    sine = half * sine
    return 2.0 * (sine * cosine), 1.0 - 2.0 * (sine * sine)


@overload(np.sin)
def _sin(x):
    if isinstance(x, LanesType):
        return lambda x: sine_cosine(x)[0]
    return None


@overload(np.cos)
def _cos(x):
    if isinstance(x, LanesType):
        return lambda x: sine_cosine(x)[1]
    return None


@overload(np.sqrt)
def _sqrt(x):
    if isinstance(x, LanesType):
        return lambda x: _square_root(x)
    return None


@overload(np.arctan2)
def _arctan2(y, x):
    if isinstance(y, LanesType):
        return lambda y, x: _angle(y, x)
    return None


@overload(np.mod)
def _mod(x, period):
    if isinstance(x, LanesType) and not isinstance(period, LanesType):
        return lambda x, period: x - floor(x * (1.0 / period)) * period
    return None


@overload(half_turn)
def _half_turn(square):
    if isinstance(square, LanesType):

        def series(square):
            sine, cosine = circular(-0.25 * square)
            return cosine, 0.5 * sine

        return series
    return None


@overload(operator.pow)
def _power(x, exponent):
    if isinstance(x, LanesType) and isinstance(exponent, types.IntegerLiteral) and exponent.literal_value == 2:
        return lambda x, exponent: x * x
    return None
