"""Scoring of many settings of `indirect-kf` on one log, for tuners: what does not change is prepared once.

Root mean square errors at every n-th sample, and the likelihood of the innovations (Mehra, IEEE TAC 1970; Bar-Shalom,
Li & Kirubarajan, 5.4.3), which needs no truth. SI units and radians.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from estimators.indirect_kf import noise_model, recordings, require_gnss, start_vector
from testbed import earth
from testbed.errors import InputError
from testbed.records import SensorLog, Trajectory
from testbed.rotations import quats_to_eulers

if TYPE_CHECKING:
    from estimators.indirect_kf import IndirectKf

Array = NDArray[np.float64]

SAME_TIME_S = 1e-6


class Searcher:
    """Scores candidates on one log; threads may do so side by side, as it releases Python's lock.

    A score is the RMSE (9,): m N, E, D; m/s N, E, D; degrees roll, pitch, yaw, of every ``stride``-th sample, and -2 log
    likelihood of the innovations per fix, up to a constant; not finite where the filter diverged.
    """

    def __init__(self, log: SensorLog, reference: Trajectory, stride: int = 10) -> None:
        from estimators.core.lanes import WIDTH

        require_gnss(log, "indirect-kf")
        times = log.imu.t[stride - 1 :: stride]
        rows = np.minimum(np.searchsorted(reference.t, times - SAME_TIME_S), len(reference.t) - 1)
        if len(rows) == 0 or np.abs(reference.t[rows] - times).max() > SAME_TIME_S:
            raise InputError(f"the reference '{reference.name}' has no row at each IMU time of '{log.name}'")
        metres = earth.metres_per_radian(reference.lat, reference.h)
        euler = quats_to_eulers(reference.q_nb)
        columns = [reference.lat, reference.lon, reference.h, reference.v_n, euler, *metres]
        self._truth = np.column_stack(columns)[rows]
        self._log, self._stride, self._recorded = log, stride, recordings(log)
        self.batch_size = WIDTH
        """Candidates that `batch` filters at once, in the time of about one."""

    def __call__(self, candidate: IndirectKf) -> tuple[Array, float]:
        """RMSE (9,) and deviance of one candidate."""
        from estimators.indirect_search_kernel import score_candidate

        variance = candidate.measurement_std(self._log) ** 2
        truth, rmse = np.ascontiguousarray(self._truth[:, :9]), np.empty(9)
        model = candidate.model(self._log)
        likelihood = score_candidate(*self._recorded, variance, *model, self._stride, truth, rmse)
        rmse[6:] = np.degrees(rmse[6:])
        return rmse, float(likelihood)

    def batch(self, candidates: Sequence[IndirectKf]) -> tuple[Array, Array]:
        """RMSE (n,9) and deviance (n,) of candidates, each as if it were alone.

        Equal to a call for each but for rounding (parts in 1e8); lanes without a candidate repeat one.
        """
        rmse, deviance = np.empty((len(candidates), 9)), np.empty(len(candidates))
        for first in range(0, len(candidates), self.batch_size):
            part = slice(first, first + self.batch_size)
            rmse[part], deviance[part] = self._filter(candidates[part])
        return rmse, deviance

    def _filter(self, candidates: Sequence[IndirectKf]) -> tuple[Array, Array]:
        from estimators.core.lanes import aligned
        from estimators.indirect_batch_kernel import filter_lanes

        log, noise = self._log, noise_model(self._log)
        covariance, q, rmse = aligned(noise.covariance.size), aligned(len(noise.q)), aligned(9)
        covariance[:] = noise.covariance.reshape(-1, 1)
        variance = aligned(6 * len(self._recorded[5]))
        for lane in range(self.batch_size):
            candidate = candidates[min(lane, len(candidates) - 1)]
            variance[:, lane] = candidate.measurement_std(log).ravel() ** 2
            with np.errstate(over="ignore"):
                q[:, lane] = candidate.process_std(log) ** 2
        arguments = (variance, start_vector(log), q, noise.decay, noise.bias_mean, self._stride, self._truth)
        deviance = filter_lanes(*self._recorded, *arguments, covariance, rmse)
        rmse[6:] = np.degrees(rmse[6:])
        return rmse.T[: len(candidates)], deviance[: len(candidates)]


def searcher(log: SensorLog, reference: Trajectory, stride: int = 10) -> Searcher:
    """Raises InputError when ``reference`` has no row at each IMU time, or the log no GNSS."""
    return Searcher(log, reference, stride)
