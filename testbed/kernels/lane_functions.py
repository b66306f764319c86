"""Functions of numpy on lanes: roots, angles and powers, each lane by itself. Kernels only."""

from __future__ import annotations

import math
import operator
from typing import Any

import numpy as np
from llvmlite import ir
from numba import njit, types
from numba.core import cgutils
from numba.extending import intrinsic, overload

from testbed.kernels.lanes import VECTOR, WIDTH, LanesType, lanes, select, splat


def _function(call: Any) -> Any:
    """A function of one argument, lanes, that ``call`` makes of a builder and the argument."""

    @intrinsic
    def function(typing_context: Any, value: Any) -> Any:
        if not isinstance(value, LanesType):
            return None
        return lanes(lanes), lambda context, builder, sig, args: call(builder, args[0])

    return function


def _unary(name: str) -> Any:
    """An instruction of the processor."""

    def call(builder: Any, x: Any) -> Any:
        kind = ir.FunctionType(VECTOR, [VECTOR])
        return builder.call(cgutils.get_or_insert_function(builder.module, kind, f"llvm.{name}.v{WIDTH}f64"), [x])

    return _function(call)


def _each(name: str) -> Any:
    """A function of the C library on the lanes one by one: the same bits as on floats."""

    def call(builder: Any, x: Any) -> Any:
        kind = ir.FunctionType(ir.DoubleType(), [ir.DoubleType()])
        function = cgutils.get_or_insert_function(builder.module, kind, name)
        out = ir.Constant(VECTOR, ir.Undefined)
        for lane in range(WIDTH):
            at = ir.Constant(ir.IntType(32), lane)
            out = builder.insert_element(out, builder.call(function, [builder.extract_element(x, at)]), at)
        return out

    return _function(call)


_log, _exp = _each("log"), _each("exp")
_square_root, _magnitude = _unary("sqrt"), _unary("fabs")
floor = _unary("floor")


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
    """Through a quarter of the angle, twice doubled: exact to rounding up to 4 rad."""
    quarter = 0.25 * x
    sine, cosine = circular(-(quarter * quarter))
    sine = quarter * sine
    sine, cosine = 2.0 * (sine * cosine), 1.0 - 2.0 * (sine * sine)
    return 2.0 * (sine * cosine), 1.0 - 2.0 * (sine * sine)


_ATAN = (-0.8750608600031904, -16.157537187333652, -75.00855792314705, -122.88666844901361, -64.85021904942025)
_ATAN_BELOW = (24.858464901423062, 165.02700983169885, 432.88106049129027, 485.3903996359137, 194.5506571482614)
"""Rational approximation of arctan up to 0.66 (Moshier, *Cephes*): x + x z P(z) / Q(z), z = x²."""


@njit(cache=True, nogil=True, forceinline=True)
def arctangent(y, x):
    """Angle of (x, y) in all quadrants, to the last digit or two; 0 where both are zero."""
    along, across = abs(x), abs(y)
    steep = across > along
    small, large = select(steep, along, across), select(steep, across, along)
    large = select(large > 0.0, large, 1.0)
    eighth = small > 0.41421356237309503 * large
    ratio = select(eighth, small - large, small) / select(eighth, small + large, large)
    z = ratio * ratio
    above = (((_ATAN[0] * z + _ATAN[1]) * z + _ATAN[2]) * z + _ATAN[3]) * z + _ATAN[4]
    below = ((((z + _ATAN_BELOW[0]) * z + _ATAN_BELOW[1]) * z + _ATAN_BELOW[2]) * z + _ATAN_BELOW[3]) * z + _ATAN_BELOW[
        4
    ]
    angle = ratio + ratio * (z * above / below)
    angle = select(eighth, 0.25 * np.pi + angle, angle)
    angle = select(steep, 0.5 * np.pi - angle, angle)
    angle = select(x < 0.0, np.pi - angle, angle)
    return select(y < 0.0, -angle, angle)


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
        return lambda y, x: arctangent(y, x)
    return None


@overload(np.hypot)
def _hypot(x, y):
    if isinstance(x, LanesType):
        return lambda x, y: _square_root(x * x + y * y)
    return None


@overload(np.tan)
def _tan(x):
    if isinstance(x, LanesType):

        def tangent(x):
            sine, cosine = sine_cosine(x)
            return sine / cosine

        return tangent
    return None


@overload(np.log)
def _logarithm(x):
    return (lambda x: _log(x)) if isinstance(x, LanesType) else None


@overload(np.exp)
def _exponential(x):
    return (lambda x: _exp(x)) if isinstance(x, LanesType) else None


@overload(abs)
def _abs(x):
    return (lambda x: _magnitude(x)) if isinstance(x, LanesType) else None


@overload(np.mod)
def _mod(x, period):
    if isinstance(x, LanesType) and not isinstance(period, LanesType):
        return lambda x, period: x - floor(x * (1.0 / period)) * period
    return None


def half_turn(square):
    """Cosine of half an angle and sine of half of it over the angle, from the angle's ``square`` (rad²); kernels only."""
    raise NotImplementedError("kernels only")


@overload(half_turn)
def _half_turn(square):
    def series(square):
        sine, cosine = circular(-0.25 * square)
        return cosine, 0.5 * sine

    def branches(square):
        if square < 1e-8:  # the series keeps full precision at zero
            return 1.0 - square / 8.0, 0.5 - square / 48.0
        angle = np.sqrt(square)
        return np.cos(0.5 * angle), np.sin(0.5 * angle) / angle

    return series if isinstance(square, LanesType) else branches if isinstance(square, types.Float) else None


@overload(operator.pow)
def _power(x, exponent):
    if isinstance(x, LanesType) and isinstance(exponent, types.IntegerLiteral) and exponent.literal_value == 2:
        return lambda x, exponent: x * x
    return None
