"""`ins`: strapdown navigation alone, from the initial state to the end without any aid.

The mechanization is `estimators.core.strapdown` (Savage 1998). NED frame, SI units and radians.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from testbed.data.records import NavSolution, SensorLog


@dataclass(frozen=True)
class Ins:
    """Integrates the IMU from ``log.initial``; the initial bias estimates are subtracted throughout."""

    name: ClassVar[str] = "ins"
    sensors: ClassVar[tuple[str, ...]] = ("imu",)

    def run(self, log: SensorLog) -> NavSolution:
        """Navigate at the IMU times. There is no covariance: ``std`` is None."""
        from estimators.core.strapdown import integrate

        imu, start = log.imu, log.initial
        n = len(imu.t)
        lla, v_n, q_nb = np.empty((n, 3)), np.empty((n, 3)), np.empty((n, 4))
        integrate(
            start.t,
            imu.t,
            imu.gyro,
            imu.accel,
            start.lat,
            start.lon,
            start.h,
            np.asarray(start.v_n, float),
            np.asarray(start.q_nb, float),
            np.asarray(start.accel_bias, float),
            np.asarray(start.gyro_bias, float),
            lla,
            v_n,
            q_nb,
        )
        return NavSolution(
            imu.t,
            lla[:, 0],
            lla[:, 1],
            lla[:, 2],
            v_n,
            q_nb,
            accel_bias=np.tile(start.accel_bias, (n, 1)),
            gyro_bias=np.tile(start.gyro_bias, (n, 1)),
        )
