"""Levelling: specific force of a vehicle that hardly accelerates points upwards.

Groves, 2nd ed., section 5.6.2. Only stretches whose specific force has the size of gravity are used. SI units.
"""

from __future__ import annotations

import numpy as np

from estimators.aiding import ABSENT, Aiding, Columns, Measurements, add_aiding
from estimators.aiding.standstill import SIGMAS, mean_std
from estimators.core.model import attitude
from estimators.policies import positive
from testbed.data.records import SensorLog
from testbed.physics import earth
from testbed.physics.rotations import cross, quat_to_matrix


def levels(log: SensorLog, columns: Columns, window_s: float = 0.2, rate_hz: float = 1.0) -> Measurements:
    """Mean specific force of a window at its middle, where its size is that of gravity as far as the biases are known.

    ``window_s``: short against a turn of the body. ``rate_hz``: an acceleration lasts for seconds, and more samples would
    claim what is not known. R: a horizontal acceleration a adds a²/2g to the size, so that one of sqrt(2 g d) hides in a
    test that leaves d.
    """
    spec, initial = log.imu.spec, log.initial
    dt = (log.imu.t[-1] - initial.t) / len(log.imu.t)
    width = max(1, round(positive("gravity window_s", window_s) / dt))
    stride = max(width, round(1.0 / (positive("gravity rate_hz", rate_hz) * dt)))
    first = np.arange(0, len(log.imu.t) - width + 1, stride)
    mean = log.imu.accel[first[:, None] + np.arange(width)].mean(axis=1)
    gravity = float(earth.gravity(initial.lat, initial.h))
    std = np.asarray(initial.std, dtype=float)[9:12]
    slack = SIGMAS * mean_std(spec.accel, std, width * dt, gravity)
    still = np.abs(np.linalg.norm(mean - initial.accel_bias, axis=1) - gravity) < slack
    t = log.imu.t[first] + (0.5 * width - 1.0) * dt
    variance = np.full((int(still.sum()), 3), 2.0 * gravity * slack)
    return Measurements(t[still], mean[still], variance, np.array([columns.get("accel-bias", ABSENT)], dtype=float))


def measure_level(state, imu, parameters, z, residual, h):
    """Specific force (3,), m/s², of a vehicle that hardly accelerates: gravity, turned into b."""
    m, column = quat_to_matrix(attitude(state)), int(parameters[0])
    up = -earth.gravity(state[0], state[2])
    for i in range(3):
        predicted = m[2][i] * up
        if column >= 0:
            predicted = predicted + state[1 + column + i]
            h[i, column + i] = 1.0
        by_attitude = cross((m[0][i], m[1][i], m[2][i]), (0.0 * up, 0.0 * up, up))
        for j in range(3):
            h[i, 6 + j] = by_attitude[j]
        residual[i] = z[i] - predicted


add_aiding(
    Aiding(
        "gravity",
        "imu",
        ("x, m/s²", "y, m/s²", "z, m/s²"),
        measure_level,
        levels,
        summary="specific force points upwards where it has the size of gravity",
    )
)
