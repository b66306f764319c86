"""A plug-in as it was written for version 0.1, second of two: on the strapdown of the estimators, without any covariance.

It must go on working for one version; see test_plugins_of_0_1.py.
"""

from dataclasses import dataclass

import numpy as np
from estimators.strapdown import integrate
from testbed.errors import InputError
from testbed.records import NavSolution, SensorLog
from testbed.rotations import quat_to_matrix


@dataclass(frozen=True)
class OldStrapdown:
    """Free inertial navigation, which counts the fixes, the field samples and the pressures of the log."""

    share: float = 1.0
    name = "old-strapdown"

    def run(self, log: SensorLog) -> NavSolution:
        if log.gnss is None or log.mag is None or log.baro is None:
            raise InputError("old-strapdown: needs GNSS, magnetometer and barometer")
        s, imu, n = log.initial, log.imu, len(log.imu.t)
        lla, v_n, q_nb = np.empty((n, 3)), np.empty((n, 3)), np.empty((n, 4))
        biases = np.asarray(s.accel_bias, float), np.asarray(s.gyro_bias, float)
        integrate(s.t, imu.t, imu.gyro, imu.accel, s.lat, s.lon, s.h, s.v_n, s.q_nb, *biases, lla, v_n, q_nb)
        heading = np.arctan2(*(np.array(quat_to_matrix(q_nb[-1]))[[1, 0], 0]))
        counts = [len(log.gnss.t), len(log.mag.field), len(log.baro.pressure), log.gnss.spec.rate_hz, heading]
        extras = {"seen": (imu.t[-1:], np.array([counts]))}
        return NavSolution(
            imu.t, *lla.T, v_n, q_nb, np.tile(biases[0], (n, 1)), np.tile(biases[1], (n, 1)), extras=extras
        )
