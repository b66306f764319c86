"""A plug-in as it was written for version 0.1, first of two: 15 columns without names, innovations alone, all by position.

It must go on working for one version; see test_plugins_of_0_1.py. Truth plus 1 m north of sigma 1 m.
"""

import numpy as np
from testbed.earth import metres_per_radian
from testbed.records import Innovations, NavSolution, SensorLog


class OldFilter:
    """Stands where the log starts."""

    name = "old-filter"

    def run(self, log: SensorLog) -> NavSolution:
        t, first = log.imu.t, log.initial
        n, north = len(t), metres_per_radian(first.lat, first.h)[0]
        place = np.full(n, first.lat + 1.0 / north), np.full(n, first.lon), np.full(n, first.h)
        motion = np.tile(first.v_n, (n, 1)), np.tile(first.q_nb, (n, 1))
        biases = np.tile(first.accel_bias, (n, 1)), np.tile(first.gyro_bias, (n, 1))
        nu = Innovations(t[::10], np.ones((len(t[::10]), 6)), np.tile(np.eye(6), (len(t[::10]), 1, 1)))
        snapshots = t[::10], np.tile(np.eye(15), (len(t[::10]), 1, 1))
        return NavSolution(t, *place, *motion, *biases, np.ones((n, 15)), *snapshots, nu, {"steps": (t, np.arange(n))})
