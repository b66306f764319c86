"""`my-estimator`: the IMU integrated, and pulled towards every GNSS fix by constant gains. A start to change.

Loosely coupled observer with four gains. NED frame, SI units and radians; quaternions body-to-nav, scalar first.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import numpy as np
from numba import njit

from estimators.strapdown import advance, compensate, increments
from testbed import InputError, NavSolution, SensorLog
from testbed.rotations import cross, quat_multiply, quat_rotate_inverse, rotvec_to_quat


@dataclass(frozen=True)
class MyEstimator:
    """Strapdown navigation with constant-gain corrections at every GNSS fix."""

    # The name of its row in every table, and what --estimators and [[estimators]] name = "..." refer to.
    name: ClassVar[str] = "my-estimator"

    # Parameters: fields with defaults. A scenario sets them with params = { position_gain = 0.05 }.
    position_gain: float = 0.1  # share of the position difference corrected at a fix
    velocity_gain: float = 0.3  # share of the velocity difference corrected at a fix
    attitude_gain: float = 0.4  # 1/s; tilt that the velocity difference shows, corrected at a fix
    gyro_bias_gain: float = 0.3  # 1/s; share of each attitude correction that goes to the gyro bias

    def __post_init__(self) -> None:
        if not 0.0 <= self.position_gain <= 1.0 or not 0.0 <= self.velocity_gain <= 1.0:
            raise InputError("my-estimator: position_gain and velocity_gain must lie between 0 and 1")

    def run(self, log: SensorLog) -> NavSolution:
        """All that is known is in ``log``: .imu, .initial, .gnss, .mag, .baro ... (each may be None). The truth is not in it."""
        imu, gnss, start = log.imu, log.gnss, log.initial
        if gnss is None:
            raise InputError("my-estimator: the scenario has no [sensors.gnss]")
        fixes = np.column_stack([gnss.t, gnss.lat, gnss.lon, gnss.h, gnss.v_n])
        gains = (self.position_gain, self.velocity_gain, self.attitude_gain, self.gyro_bias_gain)
        first = (start.lat, start.lon, start.h, tuple(start.v_n), tuple(start.q_nb))
        out = np.empty((len(imu.t), 10))
        bias = np.empty((len(imu.t), 3))
        _navigate(
            start.t, imu.t, imu.gyro, imu.accel, fixes, first, start.accel_bias, start.gyro_bias, gains, out, bias
        )
        # Optional, for NEES, NIS and three-sigma bands: states with std (N,n), covariance, innovations; see testbed.records.
        return NavSolution(imu.t, out[:, 0], out[:, 1], out[:, 2], out[:, 3:6], out[:, 6:10], gyro_bias=bias)


@njit(cache=True)
def _navigate(t_start, t, gyro, accel, fixes, first, accel_bias, gyro_bias, gains, out, bias):
    """Compiled loop. Sample k is the mean over the interval that ends at t[k]; a fix is used at the first t[k] not before it."""
    lat, lon, h, v, q = first
    b = gyro_bias.copy()
    now, fix, last_fix = t_start, 0, t_start
    for k in range(len(t)):
        dt = t[k] - now
        angle, velocity = increments(gyro[k], accel[k], b, accel_bias, dt)
        rotation, change = compensate(angle, velocity, (0.0, 0.0, 0.0), (0.0, 0.0, 0.0))
        lat, lon, h, v, q, f = advance(lat, lon, h, v, q, rotation, change, dt)
        now = t[k]
        while fix < len(fixes) and fixes[fix, 0] <= now:
            interval = fixes[fix, 0] - last_fix
            last_fix = fixes[fix, 0]
            dv = (v[0] - fixes[fix, 4], v[1] - fixes[fix, 5], v[2] - fixes[fix, 6])
            lat -= gains[0] * (lat - fixes[fix, 1])
            lon -= gains[0] * (lon - fixes[fix, 2])
            h -= gains[0] * (h - fixes[fix, 3])
            v = (v[0] - gains[1] * dv[0], v[1] - gains[1] * dv[1], v[2] - gains[1] * dv[2])
            # A tilt phi makes the velocity error grow by phi x f: its part across f is f x dv / |f|² per second.
            tilt = cross(f, dv)
            scale = gains[2] * min(interval, 1.0) / (f[0] ** 2 + f[1] ** 2 + f[2] ** 2)
            phi = (scale * tilt[0], scale * tilt[1], scale * tilt[2])
            q = quat_multiply(rotvec_to_quat((-phi[0], -phi[1], -phi[2])), q)
            body = quat_rotate_inverse(q, phi)
            for i in range(3):
                b[i] += gains[3] * body[i]
            fix += 1
        out[k, 0], out[k, 1], out[k, 2] = lat, lon, h
        for i in range(3):
            out[k, 3 + i], bias[k, i] = v[i], b[i]
        for i in range(4):
            out[k, 6 + i] = q[i]
