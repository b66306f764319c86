"""Scores of many candidates of a composed filter on one log, for tuners: `WIDTH` filters side by side in lanes.

The candidates share the recording and differ in process and measurement noise. Root mean square errors at every n-th
sample, and the likelihood of the innovations (Mehra, IEEE TAC 1970; Bar-Shalom, Li & Kirubarajan, 5.4.3), which needs no
truth. SI units and radians.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from estimators.core.composition import Composition, Prepared, imu_of, make_lanes, make_timeline_of, prepare
from estimators.core.recording import keeper
from estimators.core.timeline import require_one_timeline, walk
from testbed.base.errors import InputError
from testbed.data.records import SensorLog, Trajectory
from testbed.kernels import njit
from testbed.kernels.lanes import WIDTH, select
from testbed.kernels.tables import Table, zeros
from testbed.physics import earth
from testbed.physics.rotations import quat_to_euler, quats_to_eulers, wrap

Array = NDArray[np.float64]

SAME_TIME_S = 1e-6


class Candidate(Protocol):
    """A filter that differs from others of its search in noise alone."""

    def noise(self, prepared: Prepared) -> tuple[Array, Array, Array]:
        """Spectral densities (6,) of the IMU and (k,) of what drives the states; noise variances (E,m) of the events."""
        ...


class Score(NamedTuple):
    """What a search keeps of a run: sums over the samples and the updates."""

    stride: int
    truth: Array
    """(K,11) lat, lon, h, v_n, Euler angles, and metres per radian there"""
    squares: Table
    """(9,) of the errors: m N, E, D; m/s; rad"""
    deviance: Table
    """(1,) sum of log det S + v' S^-1 v"""
    used: NDArray[np.int64]
    """(1,) updates"""


def _add_deviance(keep, model, e, count, fading):
    deviance, scalars = keep.deviance, model.work.scalars
    keep.used[0] += 1
    for a in range(count):
        left, variance = scalars[a, 0], scalars[a, 1]
        # An S that is not positive definite has no likelihood.
        deviance[0] += select(variance > 0.0, np.log(variance) + left * left / variance, np.inf)


def _add_squares(keep, model, k):
    if (k + 1) % keep.stride == 0:
        add_squares(model.state, keep.truth[k // keep.stride], keep.squares)


keeper(Score, _add_deviance, _add_squares)


@njit(cache=True, nogil=True, _nrt=False)
def add_squares(state, row, squares):
    """Add the squares of the errors of ``state`` (10+k,) against a row of truth to ``squares`` (9,)."""
    east = np.mod(state[1] - row[1] + np.pi, 2.0 * np.pi) - np.pi
    errors = (
        (state[0] - row[0]) * row[9],
        east * row[10],
        row[2] - state[2],
        state[3] - row[3],
        state[4] - row[4],
        state[5] - row[5],
    )
    for i in range(6):
        squares[i] = squares[i] + errors[i] * errors[i]
    euler = quat_to_euler((state[6], state[7], state[8], state[9]))
    for i in range(3):
        error = wrap(euler[i] - row[6 + i])
        squares[6 + i] += error * error


class Searcher:
    """Scores candidates on one log; threads may do so side by side, as it releases Python's lock.

    A score is the RMSE (9,): m N, E, D; m/s N, E, D; degrees roll, pitch, yaw, of every ``stride``-th sample, and -2 log
    likelihood of the innovations per update, up to a constant; not finite where the filter diverged. Raises InputError when
    ``reference`` has no row at each of these samples, or the log lacks what the composition needs.
    """

    batch_size = WIDTH
    """Candidates that `batch` filters at once, in the time of about one."""
    takes_logs = True
    """Whether `batch` takes a log for each candidate."""

    def __init__(self, composition: Composition, log: SensorLog, reference: Trajectory, stride: int = 10) -> None:
        times = log.imu.t[stride - 1 :: stride]
        rows = np.minimum(np.searchsorted(reference.t, times - SAME_TIME_S), len(reference.t) - 1)
        if len(rows) == 0 or np.abs(reference.t[rows] - times).max() > SAME_TIME_S:
            raise InputError(f"the reference '{reference.name}' has no row at each IMU time of '{log.name}'")
        metres = earth.metres_per_radian(reference.lat, reference.h)
        columns = [reference.lat, reference.lon, reference.h, reference.v_n, quats_to_eulers(reference.q_nb), *metres]
        self._truth = np.column_stack(columns)[rows]
        self._prepared, self._stride = prepare(composition, log), stride
        self._imu = imu_of([self._prepared])

    def __call__(self, candidate: Candidate) -> tuple[Array, float]:
        """RMSE (9,) and deviance of one candidate."""
        rmse, deviance = self.batch([candidate])
        return rmse[0], float(deviance[0])

    def batch(self, candidates: Sequence[Candidate], logs: Sequence[SensorLog] | None = None) -> tuple[Array, Array]:
        """RMSE (n,9) and deviance (n,) of candidates, each as if it were alone; lanes without a candidate repeat one.

        ``logs`` (n): each candidate filters its own, with other noise on the same times, instead of the searcher's.
        """
        rmse, deviance = np.empty((len(candidates), 9)), np.empty(len(candidates))
        for first in range(0, len(candidates), WIDTH):
            part = slice(first, first + WIDTH)
            rmse[part], deviance[part] = self._filter(candidates[part], None if logs is None else logs[part])
        return rmse, deviance

    def _filter(self, candidates: Sequence[Candidate], logs: Sequence[SensorLog] | None) -> tuple[Array, Array]:
        prepared = [self._prepared] * len(candidates)
        if logs is not None:
            prepared = [prepare(self._prepared.composition, log) for log in logs]
            require_one_timeline([make_timeline_of(each) for each in (self._prepared, *prepared)], "search")
        if any(getattr(candidate, "measurement_noise", None) is not None for candidate in candidates):
            # deviations of the candidates' own, without correlations
            prepared = [replace(each, mix=None) for each in prepared]
        noise = [candidate.noise(each) for candidate, each in zip(candidates, prepared, strict=True)]
        filters = [
            replace(each, white=white, drive=drive, r=r)
            for each, (white, drive, r) in zip(prepared, noise, strict=True)
        ]
        score = Score(self._stride, self._truth, zeros(9), zeros(1), np.zeros(1, dtype=np.int64))
        line = make_timeline_of(prepared[0])
        walk(line, make_lanes(filters, score, self._imu if logs is None else None), len(line.t))
        rmse = np.sqrt(score.squares.array / len(self._truth))
        rmse[6:] = np.degrees(rmse[6:])
        with np.errstate(divide="ignore", invalid="ignore"):
            deviance = score.deviance.array[0] / score.used[0] if score.used[0] else np.full(WIDTH, np.inf)
        return rmse.T[: len(candidates)], deviance[: len(candidates)]
