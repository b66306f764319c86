"""Parts of a filter as compiled functions that a loop calls by address, so that one compiled loop serves every composition.

A part is written as a plain function of arrays; `address` compiles it (once per machine: compiled parts are cached beside
their source) for floats, or for lanes where filters run side by side. Calling by address costs a few nanoseconds.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable
from typing import Any

from llvmlite import ir
from numba import types
from numba.core.errors import NumbaWarning
from numba.extending import intrinsic

from testbed.kernels import cfunc, njit
from testbed.kernels.tables import TableType


def array(dimensions: int) -> types.Array:
    """The type of a C-contiguous array of float64."""
    return types.Array(types.float64, dimensions, "C")


COUPLE = types.void(array(1), array(1), array(2), array(2))
"""couple(aux, imu, accel, gyro): see `estimators.blocks`."""
MEASURE = types.void(array(1), array(1), array(1), array(1), array(1), array(2))
"""measure(state, imu, parameters, z, residual, h): see `estimators.aiding`."""
POLICY = types.float64(array(1), array(1), array(2), array(1), array(2), array(2))
"""policy(memory, residual, s, r, h, p) -> fading: see `estimators.policies`."""
COUPLE_LANES = types.void(TableType(1), TableType(1), TableType(2), TableType(2))
MEASURE_LANES = types.void(TableType(1), TableType(1), array(1), TableType(1), TableType(1), TableType(2))

NOTHING = 0
"""Address of a part that is left out."""

_compiled: dict[tuple[Callable[..., Any], Any], Any] = {}


def address(function: Callable[..., Any] | None, signature: Any) -> int:
    """Address of a function compiled for a signature; `NOTHING` for None. Raises numba's errors when it does not compile."""
    if function is None:
        return NOTHING
    key = (function, signature)
    if key not in _compiled:
        with warnings.catch_warnings():
            # Functions written in a notebook have no file to be cached beside.
            warnings.simplefilter("ignore", NumbaWarning)
            try:
                _compiled[key] = cfunc(signature, cache=True)(function)
            except RuntimeError:
                _compiled[key] = cfunc(signature)(function)
    made: int = _compiled[key].address
    return made


def caller(signature: Any) -> Any:
    """A function ``call(address, *arguments)`` for kernels, which calls what `address` gave for this signature."""
    kinds, returned = signature.args, signature.return_type

    @intrinsic
    def call(typing_context: Any, where: Any, arguments: Any) -> Any:
        def generate(context: Any, builder: Any, sig: Any, values: Any) -> Any:
            types_of = [context.get_value_type(kind) for kind in kinds]
            function = ir.FunctionType(context.get_value_type(returned), types_of)
            pointer = builder.inttoptr(values[0], function.as_pointer())
            result = builder.call(pointer, [builder.extract_value(values[1], k) for k in range(len(kinds))])
            return context.get_dummy_value() if returned == types.void else result

        return returned(types.int64, types.Tuple(kinds)), generate

    return call


call_couple, call_measure, call_policy = caller(COUPLE), caller(MEASURE), caller(POLICY)
call_couple_lanes, call_measure_lanes = caller(COUPLE_LANES), caller(MEASURE_LANES)


@njit(cache=True)
def couple_now(where, aux, imu, accel, gyro):
    """Call the ``couple`` at an address once, from Python."""
    call_couple(where, (aux, imu, accel, gyro))
