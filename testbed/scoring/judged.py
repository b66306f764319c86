"""One solution judged as a Monte Carlo run judges it: lost, and why, or its metrics."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from testbed.data.records import NavSolution, SensorErrors, SensorLog, Trajectory
from testbed.data.shapes import gaps_of
from testbed.scenario.windows import Window
from testbed.scoring import metrics


def judge(
    solution: NavSolution,
    trajectory: Trajectory,
    log: SensorLog,
    errors: SensorErrors | None,
    windows: Sequence[Window],
    divergence_m: float,
) -> tuple[str, list[tuple[str, str, float]]]:
    """Why the solution counts as lost (empty where it does not), and its rows (window, metric, value).

    ``trajectory`` is the truth where the IMU sits (`testbed.pipeline.truth_at_imu`).
    """
    with np.errstate(all="ignore"):
        span = max(trajectory.t[0], log.imu.t[0]), min(trajectory.t[-1], log.imu.t[-1])
        if gap := metrics.coverage(solution, *span, gaps_of(log.imu.t)):
            return gap, []
        series = metrics.error_series(trajectory, solution)
        if reason := metrics.divergence(series, divergence_m):
            return reason, []
        rows = metrics.score_rows(series, metrics.consistency(series, solution, errors), windows)
        if log.gnss is not None:
            rows += metrics.gnss_rows(solution, log.gnss, windows)
    return "", rows
