"""One solution against the truth in one call: errors over time beside the filter's own sigma, as a table and as a figure."""

from __future__ import annotations

from typing import TYPE_CHECKING

from testbed.data.records import NavSolution, SensorLog, Trajectory
from testbed.pipeline import truth_at_imu

if TYPE_CHECKING:
    import pandas as pd
    from matplotlib.figure import Figure


def solution_errors(trajectory: Trajectory, solution: NavSolution, log: SensorLog | None = None) -> pd.DataFrame:
    """Error of a solution over time beside the filter's own sigma, a row for each time of the solution.

    Columns ``time_s``; ``north_m`` to ``yaw_deg``, estimate minus truth; ``sigma_`` and each of these, 1 sigma, where the filter
    states it; NaN for what it does not estimate. ``log`` matters where the IMU has a lever arm or the filter aligns first.
    """
    from testbed.montecarlo.first_run import errors_frame
    from testbed.scoring.metrics import error_series

    truth = trajectory if log is None else truth_at_imu(trajectory, log)
    return errors_frame(solution, error_series(truth, solution))


def plot_errors(trajectory: Trajectory, solution: NavSolution, log: SensorLog | None = None) -> Figure:
    """Figure (matplotlib) of `solution_errors` with the band of three sigma, a panel for each axis that the filter estimates."""
    import matplotlib

    from testbed.base.figure_style import STYLE
    from testbed.report.figures import error_traces
    from testbed.scoring.quantities import AXES

    frame = solution_errors(trajectory, solution, log)
    shown = [axis for axis in AXES if not frame[axis].isna().all()]
    with matplotlib.rc_context(STYLE):
        return error_traces(
            {"estimate": frame}, shown, log.gnss.outages if log is not None and log.gnss else (), band="estimate"
        )
