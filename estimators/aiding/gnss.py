"""Position and velocity of a GNSS antenna at the end of a lever arm: loosely coupled aiding.

Groves, 2nd ed., eq. 14.110 and 14.111, with position in metres. The antenna's velocity has the sweep of the arm and, as the
velocity is that over ground, what the Earth turns under it.
"""

from __future__ import annotations

import numpy as np

from estimators.aiding import ABSENT, Aiding, Array, Columns, Measurements, add_aiding
from estimators.core.lever_arm import lever_arm
from estimators.core.model import attitude, triple
from testbed.base.errors import InputError
from testbed.data.records import GnssFixes, SensorLog
from testbed.kernels import njit
from testbed.physics import earth
from testbed.physics.rotations import cross, matrix_rotate, quat_to_matrix

MINIMUM_STD = np.array([1e-3, 1e-3, 1e-3, 1e-4, 1e-4, 1e-4])
"""R of an ideal receiver is zero, which no filter can use: 1 mm and 0.1 mm/s are the least (1 sigma)."""
GYRO_BIAS = 3
"""Place of the gyro bias' column in the parameters, behind the lever arm."""


def require_gnss(log: SensorLog, name: str) -> GnssFixes:
    """The log's GNSS fixes. Raises InputError when it has none."""
    if log.gnss is None or len(log.gnss.t) == 0:
        raise InputError(
            f"estimator '{name}' needs GNSS fixes, but the log '{log.name}' has none; add [sensors.gnss] or use 'ins'"
        )
    return log.gnss


def fixes(log: SensorLog, columns: Columns) -> Measurements:
    """Latitude, longitude (rad), height (m) and velocity (m/s) of each fix, with the covariance that the receiver states."""
    return _parts_of_fixes(log, columns, slice(0, 6))


def _parts_of_fixes(log: SensorLog, columns: Columns, part: slice) -> Measurements:
    gnss = require_gnss(log, "eskf")
    z = np.column_stack([gnss.lat, gnss.lon, gnss.h, gnss.v_n])[:, part]
    std = np.maximum(gnss.measurement_std(), MINIMUM_STD)
    t, parameters = gnss.t - gnss.spec.latency_s, antenna_parameters(gnss, columns)
    if gnss.correlation is None:
        return Measurements(t, z, std[:, part] ** 2, parameters)
    r, mix = _decorrelated(std, gnss.correlation)
    return Measurements(t, z, r[:, part], parameters, mix[:, part, part])


def _decorrelated(std: Array, correlation: Array) -> tuple[Array, Array]:
    """Variances (M,6) D and unit lower triangles (M,6,6) L with L diag(D) L' the covariance: position and velocity apart."""
    r, mix = np.ones(std.shape), np.tile(np.eye(6), (len(std), 1, 1))
    for first in (0, 3):
        own, both = slice(first, first + 3), np.tile(np.eye(3), (len(std), 1, 1))
        for k, (i, j) in enumerate(((0, 1), (0, 2), (1, 2))):
            both[:, i, j] = both[:, j, i] = correlation[:, first + k]
        root = np.linalg.cholesky(both) * std[:, own, None]
        diagonal = np.einsum("kii->ki", root)
        r[:, own], mix[:, own, own] = diagonal**2, root / diagonal[:, None, :]
    return r, mix


def antenna_parameters(gnss: GnssFixes, columns: Columns) -> Array:
    """Lever arm (3) and the gyro bias' column."""
    return np.array([*gnss.spec.lever_arm_b, columns.get("gyro-bias", ABSENT)], dtype=float)


@njit(cache=True, nogil=True)
def skew_into(h, row, column, a):
    """Write -[a x] at (row, column) of ``h``."""
    h[row, column + 1] = a[2]
    h[row, column + 2] = -a[1]
    h[row + 1, column] = -a[2]
    h[row + 1, column + 2] = a[0]
    h[row + 2, column] = a[1]
    h[row + 2, column + 1] = -a[0]


@njit(cache=True, nogil=True)
def place_of_antenna(state, parameters, z, residual, h, row):
    """Rows ``row`` to ``row`` + 2: position north, east, down (m), from latitude, longitude and height in ``z`` there."""
    lat, lon, height = triple(state, 0)
    arm = matrix_rotate(quat_to_matrix(attitude(state)), triple(parameters, 0))
    per_north, per_east = earth.metres_per_radian(lat, height)
    antenna = (lat + arm[0] / per_north, lon + arm[1] / per_east, height - arm[2])
    place = earth.position_difference(z[row], z[row + 1], z[row + 2], antenna[0], antenna[1], antenna[2])
    for i in range(3):
        residual[row + i] = place[i]
        h[row + i, i] = 1.0
    skew_into(h, row, 6, arm)


@njit(cache=True, nogil=True)
def velocity_of_antenna(state, imu, parameters, z, residual, h, row):
    """Rows ``row`` to ``row`` + 2: velocity north, east, down (m/s)."""
    lever, m = triple(parameters, 0), quat_to_matrix(attitude(state))
    arm, sweep, drag = lever_arm(m, lever, triple(imu, 0), state[0])
    moving = (sweep[0] - drag[0], sweep[1] - drag[1], sweep[2] - drag[2])
    for i in range(3):
        residual[row + i] = z[row + i] - (state[3 + i] + moving[i])
        h[row + i, 3 + i] = 1.0
    skew_into(h, row, 6, moving)
    first = int(parameters[GYRO_BIAS])
    if first >= 0:
        for j in range(3):
            # A gyro bias error turns the sweep of the arm: C [l x], column by column.
            column = cross(arm, (m[0][j], m[1][j], m[2][j]))
            for i in range(3):
                h[row + i, first + j] = column[i]


def measure_fix(state, imu, parameters, z, residual, h):
    """Position (rad, rad, m) and velocity (m/s) of a fix (6,), at its antenna."""
    place_of_antenna(state, parameters, z, residual, h, 0)
    velocity_of_antenna(state, imu, parameters, z, residual, h, 3)


def measure_place(state, imu, parameters, z, residual, h):
    """Position of a fix alone (3,), rad, rad, m, at its antenna."""
    place_of_antenna(state, parameters, z, residual, h, 0)


def measure_velocity(state, imu, parameters, z, residual, h):
    """Velocity of a fix alone (3,), m/s, at its antenna."""
    velocity_of_antenna(state, imu, parameters, z, residual, h, 0)


def whole(log: SensorLog, columns: Columns) -> Measurements:
    """Position and velocity."""
    return fixes(log, columns)


def places(log: SensorLog, columns: Columns) -> Measurements:
    """Position alone."""
    return _parts_of_fixes(log, columns, slice(0, 3))


def velocities(log: SensorLog, columns: Columns) -> Measurements:
    """Velocity alone."""
    return _parts_of_fixes(log, columns, slice(3, 6))


PLACE = ("north, m", "east, m", "down, m")
VELOCITY = ("north, m/s", "east, m/s", "down, m/s")
add_aiding(
    Aiding(
        "gnss", "gnss", PLACE + VELOCITY, measure_fix, whole, summary="position and velocity of each fix", in_lanes=True
    )
)
add_aiding(Aiding("gnss-position", "gnss", PLACE, measure_place, places, summary="position alone", in_lanes=True))
add_aiding(
    Aiding("gnss-velocity", "gnss", VELOCITY, measure_velocity, velocities, summary="velocity alone", in_lanes=True)
)
