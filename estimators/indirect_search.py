"""Scoring of many settings of `indirect-kf` on one log, for tuners: what does not change is prepared once.

Root mean square errors at every n-th sample, and the likelihood of the innovations (Mehra, IEEE TAC 1970; Bar-Shalom,
Li & Kirubarajan, 5.4.3), which needs no truth. SI units and radians.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from estimators.indirect_kf import recordings, require_gnss
from testbed.errors import InputError
from testbed.records import SensorLog, Trajectory
from testbed.rotations import quats_to_eulers

if TYPE_CHECKING:
    from estimators.indirect_kf import IndirectKf

Array = NDArray[np.float64]

SAME_TIME_S = 1e-6


def searcher(log: SensorLog, reference: Trajectory, stride: int = 10) -> Callable[[IndirectKf], tuple[Array, float]]:
    """A function of an `IndirectKf` that filters ``log``; threads may call it side by side, as it releases the lock.

    It returns the RMSE (9,): m N, E, D; m/s N, E, D; degrees roll, pitch, yaw, of every ``stride``-th sample, and -2 log
    likelihood of the innovations per fix; not finite where the filter diverged. Raises InputError when ``reference`` has
    no row at each IMU time, or the log no GNSS.
    """
    from estimators.indirect_search_kernel import score_candidate

    require_gnss(log, "indirect-kf")
    times = log.imu.t[stride - 1 :: stride]
    rows = np.minimum(np.searchsorted(reference.t, times - SAME_TIME_S), len(reference.t) - 1)
    if len(rows) == 0 or np.abs(reference.t[rows] - times).max() > SAME_TIME_S:
        raise InputError(f"the reference '{reference.name}' has no row at each IMU time of '{log.name}'")
    euler = quats_to_eulers(reference.q_nb)
    truth = np.column_stack([reference.lat, reference.lon, reference.h, reference.v_n, euler])[rows]
    recorded = recordings(log)

    def score(candidate: IndirectKf) -> tuple[Array, float]:
        start, covariance, q, decay, mean = candidate.model(log)
        variance = candidate.measurement_std(log) ** 2
        rmse = np.empty(9)
        likelihood = score_candidate(*recorded, variance, start, covariance, q, decay, mean, stride, truth, rmse)
        rmse[6:] = np.degrees(rmse[6:])
        return rmse, float(likelihood)

    return score
