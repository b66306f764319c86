"""`indirect-kf` on a receiver whose error lasts: an error that is the same in all fixes is no noise that they average out.

A Gauss-Markov error of half an hour moves by centimetres between two fixes, so that fixes show "position plus slow error" and
nothing tells the two apart. The filter therefore weighs fixes with their white part alone, navigates that sum, and its
covariance of the position is its own plus that of the slow error (the specification's `markov` sigmas).
"""

from dataclasses import replace

import numpy as np

from testbed import NavSolution, make_estimator
from testbed.base.errors import InputError
from testbed.data.records import POSITION_STATES, SensorLog


class SlowGnss:
    """`indirect-kf` with the slow part of the receiver's error considered, not estimated."""

    name = "slow-gnss"
    sensors = ("imu", "gnss")

    def run(self, log: SensorLog) -> NavSolution:
        """Filter the log with the white part of the fixes' errors and add the slow one to the position's covariance."""
        gnss = log.gnss
        if gnss is None:
            raise InputError("slow-gnss needs GNSS fixes, and this log has none")
        spec = gnss.spec
        slow = np.array([spec.horizontal_markov_sigma] * 2 + [spec.vertical_markov_sigma])
        white = np.array([spec.horizontal_sigma] * 2 + [spec.vertical_sigma])
        std = gnss.measurement_std().copy()
        std[:, :3] = np.sqrt(np.maximum(std[:, :3] ** 2 - slow**2, white**2))
        fixes = replace(gnss, std=std, correlation=None)
        parted = SensorLog(log.imu, log.initial, aiding={**log.aiding, "gnss": fixes}, name=log.name, run=log.run)
        solution = make_estimator("indirect-kf").run(parted)
        assert solution.std is not None and solution.covariance is not None  # indirect-kf gives both
        rows = [solution.states.index(name) for name in POSITION_STATES]
        sigmas, covariance = solution.std.copy(), solution.covariance.copy()
        sigmas[:, rows] = np.hypot(sigmas[:, rows], slow)
        covariance[:, rows, rows] += slow**2
        return replace(solution, std=sigmas, covariance=covariance)
