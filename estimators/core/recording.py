"""What a run of a filter leaves behind, for every filter that `estimators.core.timeline.walk` takes along a log."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numba.extending import overload
from numpy.typing import NDArray

from estimators.core.postponed import catch_up, present_std
from estimators.core.timeline import INLINED

Array = NDArray[np.float64]


class Recording(NamedTuple):
    """What a run leaves behind; row k // stride is the state after every measurement up to t[k]."""

    stride: int
    state: Array
    """(N // stride, 10 + k), or as many of its first columns as are kept"""
    std: Array
    """(N // stride, n), likewise"""
    snapshot_stride: int
    covariance: Array
    """(K,n,n), likewise"""
    innovation: Array
    """(E,m), NaN where an event lies outside of the IMU's time"""
    innovation_covariance: Array
    """(E,m,m)"""
    fading: Array
    """(E,) what the policy returned: 1 a plain update, `REJECTED` none, more a faded covariance"""


def empty_recording(samples: int, events: int, sizes: tuple[int, int, int], every: int, stride: int = 1) -> Recording:
    """Room for a run over so many IMU samples and events; ``sizes``: of the nominal state, the error state, an innovation.

    A covariance is kept every ``every`` samples, state and sigmas every ``stride``.
    """
    state, n, m = sizes
    return Recording(
        stride,
        np.empty((samples // stride, state)),
        np.empty((samples // stride, n)),
        every,
        np.empty((samples // every, n, n)),
        np.full((events, m), np.nan),
        np.full((events, m, m), np.nan),
        np.full(events, np.nan),
    )


def note_update(keep, model, e, count, fading):
    """Keep what event ``e``, of ``count`` rows, was to the filter. Kernels only."""
    raise NotImplementedError("kernels only")


def note_sample(keep, model, k):
    """Keep the state after IMU sample ``k``. Kernels only."""
    raise NotImplementedError("kernels only")


@overload(note_update, jit_options=INLINED)
def _note_update(keep, model, e, count, fading):
    return _KEEPERS[keep.instance_class][0]


@overload(note_sample, jit_options=INLINED)
def _note_sample(keep, model, k):
    return _KEEPERS[keep.instance_class][1]


_KEEPERS: dict[type, tuple[Any, Any]] = {}


def keeper(kind: type, update_noted: Any, sample_noted: Any) -> None:
    """Tie two plain functions, compiled where they are used, to a class of what a run leaves behind."""
    _KEEPERS[kind] = (update_noted, sample_noted)


def _record_update(keep, model, e, count, fading):
    innovation, covariance, residual, s = keep.innovation, keep.innovation_covariance, model.work.residual, model.work.s
    for a in range(count):
        innovation[e, a] = residual[a]
        for b in range(count):
            covariance[e, a, b] = s[a * count + b]
    keep.fading[e] = fading


def _record_sample(keep, model, k):
    state, p, states, std = model.state, model.p, keep.state, keep.std
    snapshot_due = (k + 1) % keep.snapshot_stride == 0
    if snapshot_due:
        catch_up(model)
    if (k + 1) % keep.stride == 0:
        row = k // keep.stride
        for i in range(states.shape[1]):
            states[row, i] = state[i]
        present_std(model, std[row])
    if snapshot_due:
        snapshot = keep.covariance[k // keep.snapshot_stride]
        for i in range(snapshot.shape[0]):
            for j in range(snapshot.shape[0]):
                snapshot[i, j] = p[i, j]


keeper(Recording, _record_update, _record_sample)
