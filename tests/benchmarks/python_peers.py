"""Peers written as most published Python is: a loop in the interpreter over small numpy arrays, and filterpy's UKF.

The strapdown loop has the structure of the free-integration examples of Python INS simulators (one function call and a
dozen small arrays per sample); equations from Groves, 2nd ed., section 5.4, first order. Frames n and b, SI and radians.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from testbed.data.records import SensorLog

SEMI_MAJOR, ECCENTRICITY_2, EARTH_RATE = 6378137.0, 6.69437999014e-3, 7.292115e-5


def free_integration(log: SensorLog) -> tuple[np.ndarray, np.ndarray]:
    """Positions (N,3: lat, lon, h) and velocities (N,3) of a log, sample by sample in plain Python and numpy."""
    start, imu = log.initial, log.imu
    place, v, q = np.array([start.lat, start.lon, start.h]), np.array(start.v_n, float), np.array(start.q_nb, float)
    places, velocities = np.empty((len(imu.t), 3)), np.empty((len(imu.t), 3))
    now = start.t
    for k, t in enumerate(imu.t):
        dt = t - now
        place, v, q = _step(place, v, q, imu.gyro[k] - start.gyro_bias, imu.accel[k] - start.accel_bias, dt)
        places[k], velocities[k] = place, v
        now = t
    return places, velocities


def _step(place: Any, v: Any, q: Any, gyro: Any, accel: Any, dt: float) -> tuple[Any, Any, Any]:
    sine, cosine = math.sin(place[0]), math.cos(place[0])
    root = math.sqrt(1.0 - ECCENTRICITY_2 * sine * sine)
    north = SEMI_MAJOR * (1.0 - ECCENTRICITY_2) / root**3 + place[2]
    east = SEMI_MAJOR / root + place[2]
    w_ie = EARTH_RATE * np.array([cosine, 0.0, -sine])
    w_en = np.array([v[1] / east, -v[0] / north, -v[1] * sine / cosine / east])
    gravity = 9.7803253359 * (1.0 + 0.001931853 * sine * sine) / root - 3.0877e-6 * place[2]
    c_nb = _matrix(q)
    a_n = c_nb @ accel + np.array([0.0, 0.0, gravity]) - np.cross(2.0 * w_ie + w_en, v)
    v_end = v + a_n * dt
    mean = 0.5 * (v + v_end)
    place = place + dt * np.array([mean[0] / north, mean[1] / (east * cosine), -mean[2]])
    x, y, z = dt * (gyro - c_nb.T @ (w_ie + w_en))
    turn = np.array([[0.0, -x, -y, -z], [x, 0.0, z, -y], [y, -z, 0.0, x], [z, y, -x, 0.0]])
    q = q + 0.5 * turn @ q
    return place, v_end, q / np.linalg.norm(q)


def _matrix(q: Any) -> Any:
    a, b, c, d = q
    return np.array(
        [
            [a * a + b * b - c * c - d * d, 2 * (b * c - a * d), 2 * (b * d + a * c)],
            [2 * (b * c + a * d), a * a - b * b + c * c - d * d, 2 * (c * d - a * b)],
            [2 * (b * d - a * c), 2 * (c * d + a * b), a * a - b * b - c * c + d * d],
        ]
    )


def filterpy_ukf(log: SensorLog, samples: int) -> np.ndarray:
    """States (samples,15) of filterpy's UnscentedKalmanFilter on the first samples of a log.

    Its model functions are this project's compiled ones, so that what is timed is filterpy's own machinery and one call
    from Python per sigma point. Fixes are taken at the IMU sample at or after their time.
    """
    from filterpy.kalman import JulierSigmaPoints, UnscentedKalmanFilter

    from estimators.methods.direct_ukf import DirectUkf
    from estimators.methods.motion_models import Step, add_process_noise, advance, transition

    task = DirectUkf().problem(log)
    out, corrections, inputs = np.empty(15), np.zeros(6), task.inputs

    def move(x: Any, dt: float, imu: Any) -> Any:
        advance(task.motion, x, Step(imu, corrections, dt), out)
        return out.copy()

    filter_ = UnscentedKalmanFilter(15, 6, float(np.diff(task.t[:2])[0]), lambda x: x[:6], move, JulierSigmaPoints(15))
    # scipy's Cholesky factor wants every variance positive
    filter_.x, filter_.P, filter_.Q = task.x.copy(), task.p + 1e-12 * np.eye(15), np.zeros((15, 15))
    states, phi, now, g = np.empty((samples, 15)), np.zeros((15, 15)), task.start, 0
    for k in range(samples):
        dt = task.t[k] - now
        transition(task.motion, filter_.x, Step(inputs.imu[k], corrections, dt), phi)
        filter_.Q[:] = 0.0
        add_process_noise(filter_.Q, phi, task.motion.noise, dt)
        filter_.predict(dt=dt, imu=inputs.imu[k])
        if g < len(task.gnss_t) and task.gnss_t[g] <= task.t[k] + 1e-9:
            filter_.update(inputs.z[g], R=np.diag(inputs.r[g]))
            g += 1
        states[k], now = filter_.x, task.t[k]
    return states
