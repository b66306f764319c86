"""The free copy of the NARX schemes: the direct filters' mechanization without a covariance. Kernels only.

State, models and ``place`` as in `motion_models`; begun and carried on like a `direct_kernels.Ekf`.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from estimators.core.timeline import inner, steps
from estimators.methods.body_axes import Axes
from estimators.methods.direct_kernels import Inputs, Work, antenna, begin, stretch
from estimators.methods.motion_models import N_STATES, Motion, advance
from testbed.kernels import njit

Array = NDArray[np.float64]


class Coasting(NamedTuple):
    """A free run, for `estimators.core.timeline.walk`."""

    inputs: Inputs
    motion: Motion
    state: Array
    """(15,), overwritten."""
    work: Work
    axes: Axes
    states: Array
    """(N,15): the state after each IMU sample, overwritten."""


@inner
def predict(model, k, dt, part):
    """Carry the state ``dt`` (s) on within IMU sample ``k``."""
    moved = model.work.rows[0]
    advance(model.motion, model.state, stretch(model, k, dt, part), moved)
    for i in range(N_STATES):
        model.state[i] = moved[i]


@inner
def correct(model, k, e):
    """There is nothing to correct by."""


@inner
def record(model, k):
    """Keep the state."""
    for i in range(N_STATES):
        model.states[k, i] = model.state[i]


steps(Coasting, begin, predict, correct, record)


@njit(cache=True, nogil=True, _nrt=False)
def antennas(states, imu, setting, out):
    """`direct_kernels.antenna` of each row: ``states`` (E,15), ``imu`` (E,6), ``out`` (E,6)."""
    for k in range(states.shape[0]):
        antenna(states[k], imu[k], setting, out[k])
