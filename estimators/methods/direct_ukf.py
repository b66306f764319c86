"""`direct-ukf`: loosely coupled INS/GNSS by a 15-state total-state unscented Kalman filter.

The IMM-RSTEKF paper (2023), which compares its filter with it; steps in `ukf_kernels`. Coordinates as `direct`.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from estimators.methods.direct import DirectFilter, DirectProblem
from estimators.methods.direct_kernels import make_work
from estimators.methods.ukf_kernels import Ukf, make_points, make_spread
from testbed.data.records import NavSolution


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

    def model(self, task: DirectProblem) -> Ukf:
        return make_ukf(task, self.alpha, self.beta, self.kappa)

    def answer(self, task: DirectProblem, model: Ukf, used: int) -> NavSolution:
        return task.solution(used, {"test_statistic": (task.gnss_t[:used], model.theta[:used])})


def make_ukf(task: DirectProblem, alpha: float = 1.0, beta: float = 0.0, kappa: float = 0.0) -> Ukf:
    """The filter at the start of a task."""
    spread, theta = make_spread(15, alpha, beta, kappa), np.full(len(task.gnss_t), np.nan)
    arrays = (task.x.copy(), task.p.copy(), make_work(), make_points(), task.axes_of_run(), task.keep, theta)
    return Ukf(task.inputs, task.motion_of_run(), spread, *arrays)
