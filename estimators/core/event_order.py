"""The samples of several aidings as one list of events in the order of time."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from estimators.aiding import Measurements

Array = NDArray[np.float64]


def in_order(measurements: Sequence[Measurements]) -> tuple[Array, NDArray[np.int64]]:
    """Times of all samples in order, and for each its aiding and its row there; at one time in the order of the aidings."""
    t = np.concatenate([np.zeros(0), *(m.t for m in measurements)])
    index = [np.column_stack([np.full(len(m.t), k), np.arange(len(m.t))]) for k, m in enumerate(measurements)]
    order = np.argsort(t, kind="stable")
    return t[order], np.concatenate([np.zeros((0, 2), dtype=np.int64), *index])[order].astype(np.int64)


def stacked(measurements: Sequence[Measurements], events: NDArray[np.int64], column: int) -> Array:
    """Measurements (1) or variances (2) of all events in order, (E,m); a shorter one is filled up with ones."""
    out = np.ones((len(events), max([1, *(m.z.shape[1] for m in measurements)])))
    for k, measured in enumerate(measurements):
        mine = events[:, 0] == k
        values = (measured.z if column == 1 else measured.r)[events[mine, 1]]
        out[mine, : values.shape[1]] = values
    return out


def mixes(measurements: Sequence[Measurements], events: NDArray[np.int64]) -> Array | None:
    """Unit triangles of all events in order, (E,m,m); None where no aiding has any."""
    if all(measured.mix is None for measured in measurements):
        return None
    width = max(m.z.shape[1] for m in measurements)
    out = np.tile(np.eye(width), (len(events), 1, 1))
    for k, measured in enumerate(measurements):
        if measured.mix is not None:
            mine, m = events[:, 0] == k, measured.mix.shape[1]
            out[mine, :m, :m] = measured.mix[events[mine, 1]]
    return out
