"""Lessons for a gain: the errors of an INS along a true path, as a linear system that fixes correct.

A filter that is near the truth sees the same error equations as the truth does, so that a flight can be told once, without any filter:
over each step of 0.2 s the transition by the filters' own error model (`estimators.core.nav_errors`), its process noise, what
the INS that starts from the truth errs by itself, and at the end of the step the error of the fix. A filter in torch then
learns on small matrices instead of on strapdown integration. What is left out is of second order in the errors, and what
an attitude error does through the lever arm of the antenna. Errors are estimate minus truth, in n; SI units.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numpy.typing import NDArray

from estimators.aiding.gnss import MINIMUM_STD
from estimators.blocks.imu import noise_model
from estimators.core.nav_errors import coefficients, nav_errors
from estimators.core.strapdown import integrate
from testbed.kernels import njit
from testbed.physics.earth import position_difference
from testbed.physics.rotations import attitude_errors, quats_to_matrices

if TYPE_CHECKING:
    from testbed.data.records import SensorErrors, SensorLog, Trajectory

Array = NDArray[np.float64]

STATES = 15
"""Position, velocity, attitude, accelerometer bias, gyro bias."""
STEP_S = 0.2
"""Between two fixes at 5 Hz; slower receivers have steps without one."""
UNSEEN = 1e12
"""Variance of a fix that is not there."""


class Lesson(NamedTuple):
    """A flight of n steps. ``fix`` is the fix less the true antenna, as a measurement of position and velocity errors."""

    phi: Array
    """(n,15,15) transition of each step."""
    q: Array
    """(n,15,15) what the specification says it adds to the covariance."""
    own: Array
    """(n,15) what it does add to the errors."""
    fix: Array
    """(n,6) m, m/s."""
    r: Array
    """(n,6) its stated variances; `UNSEEN` where there is none."""
    start: Array
    """(15,) errors at the beginning."""
    p0: Array
    """(15,15) their covariance as the log tells it."""


def lesson(truth: Trajectory, log: SensorLog, errors: SensorErrors) -> Lesson:
    """The lesson of a flight. Raises ValueError where samples, truth and fixes do not share a grid."""
    if len(truth.t) != len(log.imu.t) + 1 or len(errors.t) != len(log.imu.t):
        raise ValueError("a lesson needs a truth at the start and at every sample of the IMU")
    model = noise_model(log)
    per_step = round(STEP_S / truth.dt)
    c_nb = quats_to_matrices(truth.q_nb)
    each = transitions(truth.lat, truth.h, truth.v_n, c_nb, truth.f_b, model.decay, truth.dt)
    phi, q = compose(each, driving(model.q) * truth.dt, per_step)
    bias = np.hstack([errors.accel_bias, errors.gyro_bias])
    bias = np.vstack([bias[:1], bias])  # at the times of the truth
    own = own_errors(truth, log, bias, per_step)
    keep = np.repeat(np.exp(-STEP_S * model.decay), 3)
    before, after = bias[: per_step * len(own) : per_step], bias[per_step::per_step][: len(own)]
    own[:, 9:] = keep * before + (1.0 - keep) * model.bias_mean - after
    fix, r = fixes(truth, log, c_nb, len(own), per_step)
    return Lesson(phi, q, own, fix, r, errors_at_start(truth, log, bias[0]), model.covariance)


def driving(q: Array) -> Array:
    """(15,15) spectral densities of the states from those of `noise_model`: white noise drives velocity and attitude."""
    return np.diag(np.concatenate([np.zeros(3), q]))


@njit(cache=True)
def transitions(lat, h, v_n, c_nb, f_b, decay, dt):
    """(N,15,15) of each IMU interval; row 0, which no interval precedes, is zero."""
    out = np.zeros((len(lat), STATES, STATES))
    force, column = np.zeros(3), np.zeros(STATES)
    for k in range(1, len(lat)):
        middle = 0.5 * (c_nb[k - 1] + c_nb[k])
        for i in range(3):
            force[i] = middle[i, 0] * f_b[k, 0] + middle[i, 1] * f_b[k, 1] + middle[i, 2] * f_b[k, 2]
        v = (v_n[k - 1, 0], v_n[k - 1, 1], v_n[k - 1, 2])
        motion = (coefficients(lat[k - 1], h[k - 1], v), (force[0], force[1], force[2]), v)
        for j in range(STATES):
            column[:] = 0.0
            column[j] = 1.0
            accel, gyro = (0.0, 0.0, 0.0), (0.0, 0.0, 0.0)
            if j >= 12:
                gyro = (middle[0, j - 12], middle[1, j - 12], middle[2, j - 12])
            elif j >= 9:
                accel = (middle[0, j - 9], middle[1, j - 9], middle[2, j - 9])
            before = (
                (column[0], column[1], column[2]),
                (column[3], column[4], column[5]),
                (column[6], column[7], column[8]),
            )
            r, u, p = nav_errors(before, gyro, accel, motion, dt)
            for i in range(3):
                out[k, i, j], out[k, 3 + i, j], out[k, 6 + i, j] = r[i], u[i], p[i]
            if j >= 9:
                out[k, j, j] = np.exp(-dt * decay[(j - 9) // 3])
    return out


def compose(each: Array, noise: Array, per_step: int) -> tuple[Array, Array]:
    """Transition and process noise (n,15,15) of whole steps; ``noise`` (15,15) is that of one interval."""
    n = (len(each) - 1) // per_step
    phi, q = np.tile(np.eye(STATES), (n, 1, 1)), np.zeros((n, STATES, STATES))
    for j in range(1, per_step + 1):
        one = each[j::per_step][:n]
        phi, q = one @ phi, one @ q @ one.transpose(0, 2, 1) + noise
    return phi, q


def own_errors(truth: Trajectory, log: SensorLog, bias: Array, per_step: int) -> Array:
    """(n,15) errors of position, velocity and attitude of an INS that each step starts from the truth, biases included."""
    n = (len(truth.t) - 1) // per_step
    ends = np.arange(1, n + 1) * per_step
    lla, velocity, quaternion = np.empty((n, 3)), np.empty((n, 3)), np.empty((n, 4))
    rows = np.empty((per_step, 3)), np.empty((per_step, 3)), np.empty((per_step, 4))
    imu = log.imu
    for i, last in enumerate(ends):
        k, span = last - per_step, slice(last - per_step, last)
        place = truth.lat[k], truth.lon[k], truth.h[k]
        given = imu.t[span], imu.gyro[span], imu.accel[span]
        integrate(truth.t[k], *given, *place, truth.v_n[k], truth.q_nb[k], bias[k, :3], bias[k, 3:], *rows)
        lla[i], velocity[i], quaternion[i] = rows[0][-1], rows[1][-1], rows[2][-1]
    out = np.zeros((n, STATES))
    out[:, :3] = np.column_stack(position_difference(*lla.T.copy(), truth.lat[ends], truth.lon[ends], truth.h[ends]))
    out[:, 3:6] = velocity - truth.v_n[ends]
    out[:, 6:9] = attitude_errors(quaternion, truth.q_nb[ends])
    return out


def fixes(truth: Trajectory, log: SensorLog, c_nb: Array, n: int, per_step: int) -> tuple[Array, Array]:
    """(n,6) errors of the fixes at the ends of the steps, and their stated variances."""
    gnss = log.gnss
    if gnss is None or gnss.correlation is not None:
        raise ValueError("a lesson needs fixes whose errors are not correlated among the axes")
    fix, r = np.zeros((n, 6)), np.full((n, 6), UNSEEN)
    place = (gnss.t - gnss.spec.latency_s - truth.t[0]) / STEP_S
    step = np.rint(place).astype(int)
    if np.abs(place - step).max() > 1e-4:
        raise ValueError(
            f"a lesson needs fixes every {STEP_S:g} s from the start of the flight, or every so many of them"
        )
    inside = (step >= 1) & (step <= n)
    step, k = step[inside], step[inside] * per_step
    lever = np.array(gnss.spec.lever_arm_b)
    arm = c_nb[k] @ lever
    sweep = np.einsum("kij,kj->ki", c_nb[k], np.cross(truth.w_ib_b[k], lever))
    seen = gnss.lat[inside], gnss.lon[inside], gnss.h[inside]
    fix[step - 1, :3] = np.column_stack(position_difference(*seen, truth.lat[k], truth.lon[k], truth.h[k])) - arm
    fix[step - 1, 3:] = gnss.v_n[inside] - truth.v_n[k] - sweep
    r[step - 1] = np.maximum(gnss.measurement_std()[inside], MINIMUM_STD) ** 2
    return fix, r


def errors_at_start(truth: Trajectory, log: SensorLog, bias: Array) -> Array:
    """(15,) errors of the state that the log gives a filter to start from."""
    s = log.initial
    there = position_difference(s.lat, s.lon, s.h, truth.lat[0], truth.lon[0], truth.h[0])
    turn = attitude_errors(np.atleast_2d(s.q_nb), truth.q_nb[:1])[0]
    return np.concatenate([there, s.v_n - truth.v_n[0], turn, s.accel_bias - bias[:3], s.gyro_bias - bias[3:]])
