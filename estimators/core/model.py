"""What an error-state filter works on: the arrays of `Model`, and the parts of its nominal state.

The nominal state is lat, lon, h, v_n, q_nb and the sensor-error states of the blocks, in that order; the error state is
position (m), velocity and attitude (rotation vector) in n, then the same sensor-error states. SI units and radians.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numba import types
from numpy.typing import NDArray

from estimators.core.propagate import Coupling, Scratch
from testbed.kernels import njit

Array = NDArray[np.float64]

AUX = 10
"""First sensor-error state in the nominal state."""
PHI, INVARIANT = 0, 1
"""Error definitions, see `retract`."""
REJECTED = 0.0
"""What a policy returns for an update that is not to be made."""


class Inputs(NamedTuple):
    """What moves the filter: recordings of the IMU and the noise that its specification promises."""

    imu: Array
    """(N,6) angular rate (rad/s) and specific force (m/s²), means over the intervals."""
    white: Array
    """(6,) spectral densities of accelerometer and gyro noise along b."""
    drive: Array
    """(k,) spectral densities of what drives the sensor-error states."""
    decay: Array
    """(k,) their inverse correlation times, 1/s."""
    centre: Array
    """(k,) what they return to."""
    chain: NDArray[np.int64]
    """(c,2) sensor-error states of which the first is the integral of the second."""
    eager: int
    """Error states that each sample carries; those behind wait for a measurement (`estimators.core.postponed`)."""
    estimated: Array
    """(n,) 1, or 0 of a state that is considered: it counts in the covariance, and is never corrected."""


class Blocks(NamedTuple):
    """Where each block's states lie and what they add to the IMU."""

    couples: NDArray[np.int64]
    """(B,) addresses of the compiled ``couple`` of blocks whose coupling follows the IMU sample."""
    places: NDArray[np.int64]
    """(B,2) their first and last + 1 sensor-error state."""
    accel: Array
    """(k,3) what one unit of a state adds to specific force in b."""
    gyro: Array
    """(k,3) the same for angular rate."""


class Events(NamedTuple):
    """The samples of all aiding sensors in the order of time, and how each is used."""

    kind: NDArray[np.int64]
    """(E,) row of the aiding in the arrays below."""
    z: Array
    """(E,m) measurement."""
    r: Array
    """(E,m) noise variances."""
    mix: Array
    """(E,m,m) unit lower triangles L, the noise's covariance is L diag(r) L'; (0,m,m) where none is correlated."""
    rows: NDArray[np.int64]
    """(A,) length of an aiding's measurement."""
    measures: NDArray[np.int64]
    """(A,) addresses of the compiled ``measure``."""
    parameters: Array
    """(A,p) of each aiding."""
    policies: NDArray[np.int64]
    """(A,) addresses of the compiled ``policy``."""
    memory: Array
    """(A,q) of each policy, overwritten."""


class Work(NamedTuple):
    """Arrays that are overwritten in every step."""

    whole: Array
    """(6,) angle and velocity increments of the last whole sample."""
    corrections: Array
    """(6,) coning and sculling of the present one."""
    clean: Array
    """(6,) the present sample without its estimated errors."""
    sample: Array
    """(6,) the same but for what the errors have changed since the sample before; couplings are evaluated there."""
    residual: Array
    """(m,)"""
    r: Array
    """(m,)"""
    s: Array
    """(m * m,) innovation covariance."""
    h: Array
    """(m,n)"""
    x: Array
    """(n,) what an update adds to the state: minus the estimated error; position and velocity as `retract` moved them."""
    scalars: Array
    """(m,2) see `update`"""
    scratch: Array
    """(4,n)"""
    drive: Array
    """(k,) densities that, times a step, are what the variances of the sensor-error states gain in it."""
    dt: Array
    """(1,) the step that ``drive`` and the coupling's ``keep`` are of."""


class Model(NamedTuple):
    """An error-state filter on a log, for `estimators.core.timeline.walk`. ``keep`` says what a run leaves behind."""

    inputs: Inputs
    blocks: Blocks
    events: Events
    error: int
    state: Array
    """(10 + k,) or lanes, overwritten."""
    p: Array
    """Covariance, overwritten."""
    propagation: Scratch
    coupling: Coupling
    work: Work
    keep: Any
    """A `Recording`, or another class with its own ``note_update`` and ``note_sample``."""


@njit(cache=True, nogil=True, _nrt=False, forceinline=True)
def triple(array, first):
    """Three numbers of a row."""
    return array[first], array[first + 1], array[first + 2]


@njit(cache=True, nogil=True, _nrt=False, forceinline=True)
def put_triple(array, first, a):
    """Set three numbers of a row."""
    array[first] = a[0]
    array[first + 1] = a[1]
    array[first + 2] = a[2]


@njit(cache=True, nogil=True, _nrt=False, forceinline=True)
def scaled(a, factor):
    """A triple times a number."""
    return (a[0] * factor, a[1] * factor, a[2] * factor)


@njit(cache=True, nogil=True, _nrt=False, forceinline=True)
def attitude(state):
    """q_nb of a nominal state."""
    return state[6], state[7], state[8], state[9]


def is_single(model: Any) -> bool:
    """Whether a model's numbers are floats."""
    return isinstance(model[model.fields.index("state")], types.Array)
