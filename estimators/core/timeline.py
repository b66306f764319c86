"""The one time line of a log: IMU samples, and between them the events of all other sensors, each at its own time.

A filter is a NamedTuple of arrays, its *model*, and four kernels that `steps` ties to the model's class:

- ``begin(model, k, whole)`` opens IMU sample k, whose interval lasts ``whole`` seconds;
- ``predict(model, k, dt, part)`` carries the state ``dt`` seconds on within sample k, ``part`` = dt / whole of its interval;
- ``correct(model, k, e)`` uses event e, which falls into the interval of sample k;
- ``record(model, k)`` keeps what the filter knows at the end of sample k.

`walk` calls them in the order of time, and may be called again to go on where it stopped. Times in seconds.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np
from numba.extending import overload, register_jitable
from numpy.typing import NDArray

from testbed.base.errors import InputError
from testbed.kernels import njit

INLINED = {"forceinline": True, "nogil": True, "_nrt": False, "no_cpython_wrapper": True, "no_cfunc_wrapper": True}
"""For what takes a whole model: by value it is hundreds of numbers, and to hand them on takes 50 ns. Nor is it called from
Python, where unpacking a model would be a fifth of what there is to compile."""
inner = register_jitable(**INLINED)
"""Decorator of a function that takes a whole model: compiled where a kernel calls it, and in no other place."""
SAME_TIME = 1e-7
"""Times (s) closer than this are one: a step so short would only add rounding."""


class Timeline(NamedTuple):
    """Where a filter stands in a log. IMU sample k is the mean over (t[k-1], t[k]]."""

    t: NDArray[np.float64]
    """(N,) ends of the IMU intervals."""
    event_t: NDArray[np.float64]
    """(E,) times that the events describe, in order."""
    now: NDArray[np.float64]
    """(1,) time of the filter's state, overwritten."""
    place: NDArray[np.int64]
    """(2,) next IMU sample and next event, overwritten."""


def make_timeline(start: float, t: NDArray[np.float64], event_t: NDArray[np.float64]) -> Timeline:
    """The time line of a filter that starts at ``start``; events before it are passed over."""
    first = int(np.searchsorted(event_t, start - SAME_TIME))
    return Timeline(t, event_t, np.array([start], dtype=np.float64), np.array([0, first], dtype=np.int64))


def require_one_timeline(lines: Sequence[Timeline], who: str) -> None:
    """Raises InputError where the lines are not of the same times: filters side by side share one."""
    first = lines[0]
    for line in lines[1:]:
        if not all(np.array_equal(a, b) for a, b in zip(first, line, strict=True)):
            raise InputError(f"{who}: logs that are filtered side by side need the same times of samples and fixes")


_STEPS: dict[type, tuple[Callable[..., Any], ...]] = {}


def steps(
    model: type,
    begin: Callable[..., Any],
    predict: Callable[..., Any],
    correct: Callable[..., Any],
    record: Callable[..., Any],
) -> None:
    """Tie four kernels to the NamedTuple class of a filter's model; `walk` is compiled for it with them inside."""
    _STEPS[model] = tuple(getattr(kernel, "py_func", kernel) for kernel in (begin, predict, correct, record))


def _begin(model, k, whole):
    raise NotImplementedError("kernels only")


def _predict(model, k, dt, part):
    raise NotImplementedError("kernels only")


def _correct(model, k, e):
    raise NotImplementedError("kernels only")


def _record(model, k):
    raise NotImplementedError("kernels only")


@overload(_begin, jit_options=INLINED, strict=False)
def _choose_begin(model, k, whole):
    return _STEPS[model.instance_class][0]


@overload(_predict, jit_options=INLINED, strict=False)
def _choose_predict(model, k, dt, part):
    return _STEPS[model.instance_class][1]


@overload(_correct, jit_options=INLINED, strict=False)
def _choose_correct(model, k, e):
    return _STEPS[model.instance_class][2]


@overload(_record, jit_options=INLINED, strict=False)
def _choose_record(model, k):
    return _STEPS[model.instance_class][3]


@njit(cache=True, nogil=True, _nrt=False)
def walk(line, model, stop):
    """Take ``model`` from its place on the ``line`` to the end of IMU sample ``stop`` - 1; later calls go on from there."""
    t, event_t = line.t, line.event_t
    now, e = line.now[0], line.place[1]
    for k in range(line.place[0], stop):
        whole = t[k] - now
        _begin(model, k, whole)
        while True:
            has_event = e < event_t.shape[0] and event_t[e] <= t[k] + SAME_TIME
            target = min(event_t[e], t[k]) if has_event else t[k]
            dt = target - now
            if dt > SAME_TIME:
                _predict(model, k, dt, dt / whole)
                now = target
            if not has_event:
                break
            _correct(model, k, e)
            e += 1
        now = t[k]
        _record(model, k)
    line.now[0], line.place[0], line.place[1] = now, stop, e
