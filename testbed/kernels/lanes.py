"""A numba type for `WIDTH` numbers that go through the same arithmetic side by side: one vector register, a number per lane.

Kernels only: values of this type live inside compiled functions. Each operation is that of IEEE 754 on each lane by itself,
so a result depends neither on the other lanes nor on the place among them, and a NaN stays in its lane.

`testbed.kernels.tables` holds arrays of them.
"""

from __future__ import annotations

import operator
from typing import Any

import numpy as np
from llvmlite import ir
from numba import types
from numba.core.typing.templates import AbstractTemplate, infer_global, signature
from numba.extending import intrinsic, lower_builtin, models, overload, register_model
from numpy.typing import NDArray

WIDTH = 8
"""Numbers side by side: a cache line of doubles, one AVX-512 register or two of AVX2."""
LINE = 64
VECTOR = ir.VectorType(ir.DoubleType(), WIDTH)


class LanesType(types.Type):
    """`WIDTH` doubles."""

    def __init__(self) -> None:
        super().__init__(name=f"lanes{WIDTH}")


lanes = LanesType()


@register_model(LanesType)
class _LanesModel(models.PrimitiveModel):
    def __init__(self, manager: Any, kind: Any) -> None:
        super().__init__(manager, kind, VECTOR)


def aligned(rows: int) -> NDArray[np.float64]:
    """Zeros (rows, `WIDTH`) on cache lines: a row is one `load`."""
    raw = np.zeros(rows * WIDTH + LINE // 8)
    skip = (-raw.ctypes.data % LINE) // 8
    return raw[skip : skip + rows * WIDTH].reshape(rows, WIDTH)


def _splat(builder: Any, number: Any) -> Any:
    first = builder.insert_element(ir.Constant(VECTOR, ir.Undefined), number, ir.Constant(ir.IntType(32), 0))
    mask = ir.Constant(ir.VectorType(ir.IntType(32), WIDTH), [0] * WIDTH)
    return builder.shuffle_vector(first, ir.Constant(VECTOR, ir.Undefined), mask)


def _as_lanes(builder: Any, value: Any, kind: Any) -> Any:
    return value if isinstance(kind, LanesType) else _splat(builder, value)


@infer_global(operator.neg)
class _Negative(AbstractTemplate):
    def generic(self, args: Any, kws: Any) -> Any:
        return signature(lanes, lanes) if args == (lanes,) else None


@lower_builtin(operator.neg, LanesType)
def _lower_negative(context: Any, builder: Any, sig: Any, args: Any) -> Any:
    return builder.fneg(args[0])


class MaskType(types.Type):
    """`WIDTH` yes or no."""

    def __init__(self) -> None:
        super().__init__(name=f"mask{WIDTH}")


mask = MaskType()
_BITS = ir.VectorType(ir.IntType(1), WIDTH)


@register_model(MaskType)
class _MaskModel(models.PrimitiveModel):
    def __init__(self, manager: Any, kind: Any) -> None:
        super().__init__(manager, kind, _BITS)


def _instruction_of(name: str) -> Any:
    """What makes an instruction of a builder."""
    return lambda builder, left, right: getattr(builder, name)(left, right)


def _comparison(sign: str) -> Any:
    """What compares; a NaN is unequal to all and neither more nor less."""
    name = "fcmp_unordered" if sign == "!=" else "fcmp_ordered"
    return lambda builder, left, right: getattr(builder, name)(sign, left, right)


def _as_mask(builder: Any, value: Any, kind: Any) -> Any:
    if isinstance(kind, MaskType):
        return value
    on, off = ir.Constant(_BITS, [1] * WIDTH), ir.Constant(_BITS, [0] * WIDTH)
    return builder.select(value, on, off)


def _register(function: Any, kind: types.Type, number: types.Type, out: types.Type, combine: Any) -> None:
    """Let an operator take two of ``kind``, lanes or masks, or one of them and a ``number`` that stands for `WIDTH` equal ones.

    ``combine`` makes the instruction of a builder and two vectors, whose result is of type ``out``.
    """
    widen = _as_lanes if kind == lanes else _as_mask

    @infer_global(function)
    class Template(AbstractTemplate):
        def generic(self, args: Any, kws: Any) -> Any:
            known = all(a in (kind, number) for a in args)
            return signature(out, *args) if len(args) == 2 and known and kind in args else None

    def lower(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        left, right = (widen(builder, value, given) for value, given in zip(args, sig.args, strict=True))
        return combine(builder, left, right)

    for kinds in ((kind, kind), (kind, number), (number, kind)):
        lower_builtin(function, *kinds)(lower)


for _operators, _instruction in (
    ((operator.add, operator.iadd), "fadd"),
    ((operator.sub, operator.isub), "fsub"),
    ((operator.mul, operator.imul), "fmul"),
    ((operator.truediv, operator.itruediv), "fdiv"),
):
    for _operator in _operators:
        _register(_operator, lanes, types.float64, lanes, _instruction_of(_instruction))

for _operator, _sign in (
    (operator.lt, "<"),
    (operator.le, "<="),
    (operator.gt, ">"),
    (operator.ge, ">="),
    (operator.eq, "=="),
    (operator.ne, "!="),
):
    _register(_operator, lanes, types.float64, mask, _comparison(_sign))

for _operator, _instruction in ((operator.and_, "and_"), (operator.or_, "or_")):
    _register(_operator, mask, types.boolean, mask, _instruction_of(_instruction))


@intrinsic
def _blend(typing_context: Any, which: Any, yes: Any, no: Any) -> Any:
    kinds = (yes, no)
    if not isinstance(which, MaskType) or not all(isinstance(k, LanesType) or k == types.float64 for k in kinds):
        return None

    def generate(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        left, right = (_as_lanes(builder, value, kind) for value, kind in zip(args[1:], kinds, strict=True))
        return builder.select(args[0], left, right)

    return lanes(which, yes, no), generate


def select(which, yes, no):
    """``yes`` where ``which`` holds, else ``no``; kernels only."""
    raise NotImplementedError("kernels only")


@overload(select)
def _select(which, yes, no):
    if isinstance(which, MaskType):
        return lambda which, yes, no: _blend(which, yes, no)
    return (lambda which, yes, no: yes if which else no) if isinstance(which, types.Boolean) else None


@intrinsic
def _any_lane(typing_context: Any, which: Any) -> Any:
    def generate(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        bits = builder.bitcast(args[0], ir.IntType(WIDTH))
        return builder.icmp_unsigned("!=", bits, ir.Constant(ir.IntType(WIDTH), 0))

    return types.boolean(which), generate


def any_of(which: Any) -> Any:
    """Whether a condition holds, or holds in any of the lanes."""
    raise NotImplementedError("kernels only")


@overload(any_of)
def _any_of(which):
    return (lambda which: _any_lane(which)) if isinstance(which, MaskType) else lambda which: which


def _pointer(context: Any, builder: Any, array_type: Any, array: Any, row: Any) -> Any:
    data = context.make_array(array_type)(context, builder, array).data
    first = builder.mul(row, ir.Constant(row.type, WIDTH))
    return builder.bitcast(builder.gep(data, [first], inbounds=True), VECTOR.as_pointer())


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
def scatter(typing_context: Any, array: Any, offset: Any, value: Any) -> Any:
    """Set number ``offset`` of each of `WIDTH` equal parts of an array to that of its lane."""
    if not _is_table(array) or not isinstance(offset, types.Integer) or not isinstance(value, LanesType):
        return None

    def generate(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        room = context.make_array(array)(context, builder, args[0])
        size = builder.udiv(room.nitems, ir.Constant(room.nitems.type, WIDTH))
        place = args[1]
        for lane in range(WIDTH):
            number = builder.extract_element(args[2], ir.Constant(ir.IntType(32), lane))
            builder.store(number, builder.gep(room.data, [place], inbounds=True))
            place = builder.add(place, size)
        return context.get_dummy_value()

    return types.void(array, types.intp, lanes), generate


@intrinsic
def splat(typing_context: Any, number: Any) -> Any:
    """The same number in each lane."""
    if number != types.float64:
        return None

    def generate(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        return _splat(builder, args[0])

    return lanes(types.float64), generate


def as_lanes(x: Any) -> Any:
    """Lanes as they are, a float in each lane."""
    raise NotImplementedError("kernels only")


@overload(as_lanes)
def _lanes_of(x):
    return (lambda x: x) if isinstance(x, LanesType) else lambda x: splat(float(x))


def alike(x: Any, number: Any) -> Any:
    """A number as ``x`` is one: a float, or the same in each lane."""
    raise NotImplementedError("kernels only")


@overload(alike)
def _alike(x, number):
    return (lambda x, number: splat(float(number))) if isinstance(x, LanesType) else lambda x, number: float(number)


def is_zero(x: Any) -> Any:
    """Whether a number is zero and may be left out of a sum; lanes are never taken to be."""
    raise NotImplementedError("kernels only")


@overload(is_zero)
def _is_zero(x):
    return (lambda x: False) if isinstance(x, LanesType) else lambda x: x == 0.0
