"""`direct-ukf`: loosely coupled INS/GNSS by a 15-state total-state unscented Kalman filter.

The IMM-RSTEKF paper (2023), which compares its filter with it; loop in `ukf_kernels`. Coordinates as `direct`.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from estimators.direct import DirectFilter
from testbed.records import NavSolution, SensorLog


@dataclass(frozen=True)
class DirectUkf(DirectFilter):
    """Unscented Kalman filter, accelerated model, sigma points moved at every IMU sample.

    alpha = 1, beta = kappa = 0 is the symmetric set of 2 n equally weighted points of the paper.
    """

    alpha: float = 1.0
    beta: float = 0.0
    kappa: float = 0.0

    name: ClassVar[str] = "direct-ukf"
    sensors: ClassVar[tuple[str, ...]] = ("imu", "gnss")
    parameter_space: ClassVar[dict[str, tuple[float, float, str]]] = DirectFilter.parameter_space | {
        "alpha": (1e-3, 2.0, "log"),
        "beta": (0.0, 4.0, "linear"),
        "kappa": (-12.0, 12.0, "linear"),
    }

    def run(self, log: SensorLog) -> NavSolution:
        """Filter the log. Raises InputError when it has no GNSS."""
        from estimators.ukf_kernels import filter_log

        task = self.problem(log)
        figures = np.full((len(task.gnss_t), 1), np.nan)
        timeline, fixes = (task.start, task.t, task.imu), (task.gnss_t, task.gnss_z, task.gnss_r)
        parameters = (self.alpha, self.beta, self.kappa)
        arrays = (*task.outputs, figures)
        x, p = task.x.copy(), task.p.copy()
        used = filter_log(*timeline, *fixes, x, p, task.noise, task.setting, parameters, task.every, arrays)
        return task.solution(used, {"test_statistic": (task.gnss_t[:used], figures[:used, 0])})
