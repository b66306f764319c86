"""What every loosely coupled peer is told of the start and of the fixes, from the log alone; SI units."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from estimators.aiding.gnss import MINIMUM_STD
from testbed.data.records import GnssFixes, SensorLog

Array = NDArray[np.float64]

LEAST_STD = np.repeat([1e-3, 1e-4, 1e-6, 1e-6, 1e-9], 3)
"""Of the initial state: a covariance with a zero on its diagonal has no factors, and a filter could never leave such a state."""


def initial_std(log: SensorLog) -> Array:
    """(15,) 1 sigma of the start in the order of `STATE_NAMES`, none zero."""
    return np.maximum(np.asarray(log.initial.std, dtype=float), LEAST_STD)


def fix_covariance(gnss: GnssFixes, fix: int) -> Array:
    """(6,6) of a fix as the receiver states it: position (m), then velocity (m/s), north, east and down."""
    std = np.maximum(gnss.measurement_std()[fix], MINIMUM_STD)
    both = np.eye(6)
    if gnss.correlation is not None:
        for first in (0, 3):
            for k, (i, j) in enumerate(((0, 1), (0, 2), (1, 2))):
                both[first + i, first + j] = both[first + j, first + i] = gnss.correlation[fix, first + k]
    return np.asarray(both * np.outer(std, std))
