"""Velocity in body axes: an odometer, wheels that do not slip sideways, and a vehicle that stands.

Groves, 2nd ed., sections 15.3.1 (zero velocity) and 15.4.1 (land vehicle); Dissanayake et al., *IEEE Trans. Robotics and
Automation* 17 (2001). The point of contact at the arm l moves with v_b = C_bn v_n + w_eb x l over the Earth.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from estimators.aiding import ABSENT, Aiding, Array, Columns, Measurements, add_aiding
from estimators.aiding.standstill import stops
from estimators.blocks.sensors import samples_of
from estimators.core.model import attitude, triple
from estimators.policies import positive
from testbed.base.errors import InputError
from testbed.data.records import SensorLog
from testbed.kernels import njit
from testbed.physics import earth
from testbed.physics.rotations import cross, matrix_rotate, quat_to_matrix

GYRO_BIAS, SCALE, MOUNTING = 3, 4, 5
"""Places in the parameters of the columns of blocks, behind the arm."""
SMALLEST_STD = 1e-4
"""m/s: R of an ideal sensor is zero, which no filter can use."""


@njit(cache=True, nogil=True)
def column_of(parameters, place):
    """First column of a block, below 0 where the filter does not carry it."""
    return int(parameters[place])


@njit(cache=True, nogil=True)
def speed_along(state, imu, parameters, u, h, row):
    """Speed of the contact point along ``u`` (in b), with its derivatives in ``row`` of ``h``; also its velocity in b.

    What the turning Earth adds to the derivative by attitude, 7e-5 rad/s times the arm, is left out.
    """
    m, v, arm = quat_to_matrix(attitude(state)), triple(state, 3), triple(parameters, 0)
    earth_n, _, earth_d = earth.earth_rate_n(state[0])
    sweep = cross(triple(imu, 0), arm)
    drag = cross((earth_n, 0.0, earth_d), matrix_rotate(m, arm))
    over_ground = (v[0] - drag[0], v[1] - drag[1], v[2] - drag[2])
    v_b = (
        m[0][0] * over_ground[0] + m[1][0] * over_ground[1] + m[2][0] * over_ground[2] + sweep[0],
        m[0][1] * over_ground[0] + m[1][1] * over_ground[1] + m[2][1] * over_ground[2] + sweep[1],
        m[0][2] * over_ground[0] + m[1][2] * over_ground[1] + m[2][2] * over_ground[2] + sweep[2],
    )
    u_n = matrix_rotate(m, u)
    by_attitude, by_bias = cross(u_n, v), cross(u, arm)
    first = column_of(parameters, GYRO_BIAS)
    for i in range(3):
        h[row, 3 + i] = u_n[i]
        h[row, 6 + i] = by_attitude[i]
        if first >= 0:
            h[row, first + i] = by_bias[i]
    return u[0] * v_b[0] + u[1] * v_b[1] + u[2] * v_b[2], v_b


@njit(cache=True, nogil=True)
def mounting(state, parameters):
    """Angles of the rolling direction about y and z, to first order: 4e-5 of the speed is lost at 0.5 degrees."""
    column = column_of(parameters, MOUNTING)
    if column >= 0:
        return state[1 + column], state[2 + column]
    return 0.0 * state[0], 0.0 * state[0]


def measure_odometer(state, imu, parameters, z, residual, h):
    """Speed of the wheel along its way (1,), m/s, with its scale error and the direction in which it rolls."""
    about_y, about_z = mounting(state, parameters)
    speed, v_b = speed_along(state, imu, parameters, (1.0, about_z, -about_y), h, 0)
    scale, column = column_of(parameters, SCALE), column_of(parameters, MOUNTING)
    stretch = 1.0 + 0.0 * speed
    if scale >= 0:
        stretch = stretch + state[1 + scale]
        h[0, scale] = speed
    for i in range(3, h.shape[1]):
        if i != scale:
            h[0, i] = stretch * h[0, i]
    if column >= 0:
        h[0, column] = -(stretch * v_b[2])
        h[0, column + 1] = stretch * v_b[1]
    residual[0] = z[0] - stretch * speed


def measure_sideways(state, imu, parameters, z, residual, h):
    """Speed across and below a wheel that does not slip (2,), m/s: zero."""
    about_y, about_z = mounting(state, parameters)
    side, v_b = speed_along(state, imu, parameters, (-about_z, 1.0, 0.0 * about_z), h, 0)
    down, _ = speed_along(state, imu, parameters, (about_y, 0.0 * about_y, 1.0), h, 1)
    column = column_of(parameters, MOUNTING)
    if column >= 0:
        h[0, column + 1] = -v_b[0]
        h[1, column] = v_b[0]
    residual[0] = z[0] - side
    residual[1] = z[1] - down


def measure_standstill(state, imu, parameters, z, residual, h):
    """Velocity of a vehicle that stands (3,), m/s: zero."""
    for i in range(3):
        residual[i] = z[i] - state[3 + i]
        h[i, 3 + i] = 1.0


def _parameters(arm: Sequence[float], columns: Columns) -> Array:
    places = [columns.get(name, ABSENT) for name in ("gyro-bias", "odometer-scale", "odometer-mounting")]
    return np.array([*np.asarray(arm, dtype=float), *places], dtype=float)


def speeds(log: SensorLog, columns: Columns) -> Measurements:
    """Speed of each sample, at the middle of its counting interval; noise and rounding to whole pulses by the data sheet."""
    odometer = samples_of(log, "odometer", "the aiding 'odometer'")
    spec = odometer.spec
    r = np.full((len(odometer.t), 1), max(spec.measurement_std(), SMALLEST_STD) ** 2)
    return Measurements(odometer.t - spec.latency_s, odometer.speed[:, None], r, _parameters(spec.lever_arm_b, columns))


def no_slip(
    log: SensorLog,
    columns: Columns,
    sigma_mps: float = 0.1,
    rate_hz: float = 1.0,
    lever_arm_m: Sequence[float] | None = None,
) -> Measurements:
    """No speed sideways and upwards where the wheels touch the ground.

    ``sigma_mps``: a tyre in a bend at 0.2 g slips by half a degree, 0.1 m/s at 14 m/s, and springs move as fast.
    ``rate_hz``: slip lasts as long as a bend, seconds; more samples would claim what is not known. ``lever_arm_m``: from the
    IMU to the middle of the wheels that do not steer; by default the odometer's contact point, or none without one.
    """
    sigma = positive("non-holonomic sigma_mps", sigma_mps)
    step = 1.0 / positive("non-holonomic rate_hz", rate_hz)
    arm: Sequence[float] = (0.0, 0.0, 0.0) if log.odometer is None else log.odometer.spec.lever_arm_b
    if lever_arm_m is not None:
        arm = lever_arm_m
    if len(arm) != 3 or not all(isinstance(x, int | float) and np.isfinite(x) for x in arm):
        raise InputError(f"non-holonomic lever_arm_m = {arm!r}: must be three numbers, forward, right, down")
    t = np.arange(log.initial.t + step, log.imu.t[-1], step)
    return Measurements(t, np.zeros((len(t), 2)), np.full((len(t), 2), sigma**2), _parameters(arm, columns))


def standing(log: SensorLog, columns: Columns, window_s: float = 0.5, pass_rate: float = 0.999) -> Measurements:
    """Velocity zero at the end of each window in which the vehicle stands: see `estimators.aiding.standstill`.

    R: an acceleration as small as the noise of the window's mean, which the test cannot see, acting through the window.
    """
    found = stops(log, positive("zero-velocity window_s", window_s), pass_rate)
    sigma = max(log.imu.spec.accel.white_noise * np.sqrt(window_s), SMALLEST_STD)
    return Measurements(found, np.zeros((len(found), 3)), np.full((len(found), 3), sigma**2), np.zeros(1))


add_aiding(
    Aiding(
        "odometer",
        "odometer",
        ("speed, m/s",),
        measure_odometer,
        speeds,
        summary="speed of a wheel along its way",
        in_lanes=True,
    )
)
add_aiding(
    Aiding(
        "non-holonomic",
        "imu",
        ("right, m/s", "down, m/s"),
        measure_sideways,
        no_slip,
        summary="wheels slip neither sideways nor upwards",
        in_lanes=True,
    )
)
add_aiding(
    Aiding(
        "zero-velocity",
        "imu",
        ("north, m/s", "east, m/s", "down, m/s"),
        measure_standstill,
        standing,
        summary="no velocity where the IMU feels that the vehicle stands",
    )
)
