"""One solution judged as a Monte Carlo run judges it: lost, and why, or its metrics."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np

from testbed.base.errors import InputError
from testbed.data.records import NavSolution, SensorErrors, SensorLog, Trajectory
from testbed.data.shapes import gaps_of
from testbed.scenario.windows import Window
from testbed.scoring import metrics


class Judged(NamedTuple):
    """What a solution is worth."""

    lost: str
    """Why it counts as diverged; empty where it does not."""
    rows: list[tuple[str, str, float]]
    """Window, metric, value; none of a solution that is lost."""
    series: metrics.ErrorSeries
    tests: Mapping[str, metrics.Consistency]


def judge(
    solution: NavSolution,
    trajectory: Trajectory,
    log: SensorLog,
    errors: SensorErrors | None,
    windows: Sequence[Window],
    divergence_m: float,
) -> Judged:
    """Raises InputError for a solution that does not cover the log.

    ``trajectory`` is the truth where the IMU sits (`testbed.pipeline.truth_at_imu`).
    """
    with np.errstate(all="ignore"):
        span = max(trajectory.t[0], log.imu.t[0]), min(trajectory.t[-1], log.imu.t[-1])
        if gap := metrics.coverage(solution, *span, gaps_of(log.imu.t)):
            raise InputError(gap)
        series = metrics.error_series(trajectory, solution)
        if lost := metrics.divergence(series, divergence_m):
            return Judged(lost, [], series, {})
        tests = metrics.consistency(series, solution, errors)
        rows = metrics.score_rows(series, tests, windows)
        if log.gnss is not None:
            rows += metrics.gnss_rows(solution, log.gnss, windows)
    return Judged("", rows, series, tests)
