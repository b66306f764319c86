"""Errors of a solution against truth, and the metrics of the tables: accuracy per window and consistency (NEES, NIS).

Bar-Shalom, Li & Kirubarajan, *Estimation with Applications to Tracking and Navigation*, 5.4 (NEES, NIS). Errors are
estimate minus truth: metres and m/s along n, Euler angles in degrees, the attitude error a rotation vector in n.

Metric names are a statistic and a quantity. With e the error over the samples of a window:

- ``rmse_``  root mean square of e
- ``max_``   largest absolute error
- ``final_`` absolute error at the end of the window (root mean square over the ends of a window of several intervals)
- ``mean_``  mean of e, signed for an axis, of the magnitude for ``position_2d_m`` and the like

of `QUANTITIES`. ``nees_position``, ``nees_velocity``, ``nees_attitude`` (3 degrees of freedom), ``nees_bias`` (6) and
``nis`` are averages over time. ``rmse_gnss_`` and ``mean_gnss_`` compare with the GNSS fixes instead of truth, as papers
do that have no reference: at the time that each fix describes, at the antenna.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numba import njit
from numpy.typing import NDArray

from testbed import earth, rotations
from testbed.records import Array, GnssFixes, NavSolution, SensorErrors, Trajectory
from testbed.windows import Window

if TYPE_CHECKING:
    import pandas as pd

AXES = (
    *("north_m", "east_m", "down_m"),
    *("v_north_mps", "v_east_mps", "v_down_mps"),
    *("roll_deg", "pitch_deg", "yaw_deg"),
)
"""Columns of `ErrorSeries.values`."""
QUANTITIES = (
    *("north_m", "east_m", "down_m", "position_2d_m", "position_3d_m"),
    *("v_north_mps", "v_east_mps", "v_down_mps", "velocity_3d_mps"),
    *("roll_deg", "pitch_deg", "yaw_deg", "attitude_deg"),
)
STATISTICS = ("rmse", "max", "final", "mean")
NEES_GROUPS = {
    "nees_position": slice(0, 3),
    "nees_velocity": slice(3, 6),
    "nees_attitude": slice(6, 9),
    "nees_bias": slice(9, 15),
}
"""Metric names and the error states (order of `records.STATE_NAMES`) that each one tests."""
TIME_METRIC = "us_per_sample"
"""Computation time of an estimator per IMU sample."""

UNCOVERED = 0.01
"""Share of a flight that a solution may leave out at either end, or between two samples."""
_TIME_TOLERANCE = 1e-9
_GNSS_QUANTITIES = QUANTITIES[:9]


def metric_names() -> list[str]:
    """Every metric that a table may hold."""
    plain = [f"{s}_{q}" for s in STATISTICS for q in QUANTITIES]
    return [
        *plain,
        *NEES_GROUPS,
        "nis",
        *(f"{s}_gnss_{q}" for s in ("rmse", "mean") for q in _GNSS_QUANTITIES),
        "diverged",
    ]


@dataclass(frozen=True)
class ErrorSeries:
    """Errors of a solution at its own times ``t`` (N,): ``values`` (N,9) as `AXES`, ``phi`` (N,3) rotation vector, rad."""

    t: Array
    values: Array
    phi: Array

    def quantities(self) -> Array:
        """(N,13): the errors and their magnitudes in the order of `QUANTITIES`."""
        return np.column_stack([_with_magnitudes(self.values[:, :6]), self.values[:, 6:], _norm(np.degrees(self.phi))])


@dataclass(frozen=True)
class Consistency:
    """One test statistic over time: ``t`` (K,), ``value`` (K,) and its degrees of freedom ``dof`` (K,)."""

    t: Array
    value: Array
    dof: Array


def error_series(trajectory: Trajectory, solution: NavSolution) -> ErrorSeries:
    """Errors at the solution's times that lie within the trajectory; truth is interpolated where the grids differ."""
    inside = (solution.t >= trajectory.t[0] - _TIME_TOLERANCE) & (solution.t <= trajectory.t[-1] + _TIME_TOLERANCE)
    t = solution.t[inside]
    lat, lon, h, v_n, q_nb = truth_at(trajectory, t)
    ned = earth.position_difference(solution.lat[inside], solution.lon[inside], solution.h[inside], lat, lon, h)
    q_est = solution.q_nb[inside]
    euler = rotations.wrap(rotations.quats_to_eulers(q_est) - rotations.quats_to_eulers(q_nb))
    values = np.column_stack([*ned, solution.v_n[inside] - v_n, np.degrees(euler)])
    return ErrorSeries(t, values, rotations.attitude_errors(q_est, q_nb))


def truth_at(trajectory: Trajectory, t: Array) -> tuple[Array, Array, Array, Array, Array]:
    """``lat, lon, h, v_n, q_nb`` of the truth at times ``t``: its own rows where they match, else interpolated."""
    k = np.clip(np.searchsorted(trajectory.t, t - _TIME_TOLERANCE), 0, len(trajectory.t) - 1)
    if len(t) == 0 or np.abs(trajectory.t[k] - t).max() <= _TIME_TOLERANCE:
        if len(k) and k[-1] - k[0] == len(k) - 1:
            k = slice(k[0], k[-1] + 1)  # type: ignore[assignment]
        return trajectory.lat[k], trajectory.lon[k], trajectory.h[k], trajectory.v_n[k], trajectory.q_nb[k]
    from testbed.interpolate import state_at

    return state_at(trajectory, np.clip(t, trajectory.t[0], trajectory.t[-1]))


def score(
    trajectory: Trajectory,
    solution: NavSolution,
    windows: Sequence[Window],
    errors: SensorErrors | None = None,
    gnss: GnssFixes | None = None,
) -> pd.DataFrame:
    """Table (window, metric, value) of a solution. Windows without a sample of the solution are left out.

    ``errors`` (the true biases) adds ``nees_bias``, ``gnss`` the ``_gnss_`` metrics.
    """
    import pandas as pd

    series = error_series(trajectory, solution)
    rows = score_rows(series, consistency(series, solution, errors), windows)
    if gnss is not None:
        rows += gnss_rows(solution, gnss, windows)
    return pd.DataFrame(rows, columns=["window", "metric", "value"])


def score_rows(
    series: ErrorSeries, tests: dict[str, Consistency], windows: Sequence[Window]
) -> list[tuple[str, str, float]]:
    """Rows (window, metric, value) of errors and consistency tests."""
    quantities = series.quantities()
    rows: list[tuple[str, str, float]] = []
    for window in windows:
        spans = np.array([(a, b) for a, b in _spans(series.t, window) if b > a], dtype=np.int64)
        if len(spans):
            for statistic, row in zip(STATISTICS, _described(quantities, spans), strict=True):
                rows += [(window.name, f"{statistic}_{q}", float(v)) for q, v in zip(QUANTITIES, row, strict=True)]
        for name, test in tests.items():
            inside = np.concatenate([test.value[a:b] for a, b in _spans(test.t, window)])
            if len(inside):
                rows.append((window.name, name, float(inside.mean())))
    return rows


@njit(cache=True)
def _described(values, spans):
    """(4,n): root mean square, largest size, root mean square of the last rows, and mean of (N,n) over spans (M,2) of rows."""
    n = values.shape[1]
    out = np.zeros((4, n))
    count = 0
    for j in range(spans.shape[0]):
        a, b = spans[j, 0], spans[j, 1]
        count += b - a
        for k in range(a, b):
            for i in range(n):
                x = values[k, i]
                out[0, i] += x * x
                out[3, i] += x
                if abs(x) > out[1, i] or x != x:
                    out[1, i] = abs(x)
        for i in range(n):
            out[2, i] += values[b - 1, i] ** 2
    for i in range(n):
        out[0, i] = np.sqrt(out[0, i] / count)
        out[2, i] = np.sqrt(out[2, i] / spans.shape[0])
        out[3, i] /= count
    return out


def consistency(
    series: ErrorSeries, solution: NavSolution, errors: SensorErrors | None = None
) -> dict[str, Consistency]:
    """NEES of each state group at the covariance snapshots, and NIS of each innovation, as far as the solution tells."""
    out: dict[str, Consistency] = {}
    if (
        solution.covariance is not None
        and solution.covariance_t is not None
        and len(solution.covariance_t)
        and len(series.t)
    ):
        keep = (solution.covariance_t >= series.t[0]) & (solution.covariance_t <= series.t[-1])
        t, covariance = solution.covariance_t[keep], solution.covariance[keep]
        k = nearest_rows(series.t, t)
        error = np.column_stack([series.values[k, :6], series.phi[k]])
        groups = ["nees_position", "nees_velocity", "nees_attitude"]
        if errors is not None and solution.accel_bias is not None and solution.gyro_bias is not None:
            error = np.column_stack([error, _bias_errors(solution, errors, t)])
            groups.append("nees_bias")
        for name in groups:
            states = NEES_GROUPS[name]
            value = _quadratic(error[:, states], covariance[:, states, states])
            out[name] = Consistency(t, value, np.full(len(t), float(states.stop - states.start)))
    if (nu := solution.innovations) is not None and len(nu.t):
        used = np.isfinite(nu.value)
        value = _quadratic(np.where(used, nu.value, 0.0), _only(nu.covariance, used))
        some = used.any(axis=1)
        out["nis"] = Consistency(nu.t[some], value[some], used.sum(axis=1).astype(float)[some])
    return out


def gnss_rows(solution: NavSolution, gnss: GnssFixes, windows: Sequence[Window]) -> list[tuple[str, str, float]]:
    """Rows of ``rmse_gnss_`` and ``mean_gnss_``: the solution at the antenna minus each fix, at the time it describes."""
    t = gnss.t - gnss.spec.latency_s
    inside = (t >= solution.t[0]) & (t <= solution.t[-1])
    if not inside.any():
        return []
    t = t[inside]
    lat, lon, h, *v = (
        np.interp(t, solution.t, x) for x in (solution.lat, np.unwrap(solution.lon), solution.h, *solution.v_n.T)
    )
    ned = np.column_stack(earth.position_difference(lat, lon, h, gnss.lat[inside], gnss.lon[inside], gnss.h[inside]))
    if any(gnss.spec.lever_arm_b):
        matrices = rotations.quats_to_matrices(solution.q_nb[nearest_rows(solution.t, t)])
        ned = ned + matrices @ np.array(gnss.spec.lever_arm_b)
    values = _with_magnitudes(np.column_stack([ned, np.column_stack(v) - gnss.v_n[inside]]))
    rows: list[tuple[str, str, float]] = []
    for window in windows:
        part = np.concatenate([values[a:b] for a, b in _spans(t, window)])
        if len(part):
            rows += [
                (window.name, f"rmse_gnss_{q}", float(x)) for q, x in zip(_GNSS_QUANTITIES, _rms(part), strict=True)
            ]
            mean = part.mean(axis=0)
            rows += [(window.name, f"mean_gnss_{q}", float(x)) for q, x in zip(_GNSS_QUANTITIES, mean, strict=True)]
    return rows


def divergence(series: ErrorSeries, limit_m: float) -> str:
    """Why a solution counts as diverged, or an empty string: a value that is not finite, or position off by ``limit_m``."""
    if len(series.t) == 0:
        return "no sample within the flight"
    finite = np.isfinite(series.values).all(axis=1)
    if not finite.all():
        return f"not finite from {series.t[np.argmin(finite)]:.6g} s"
    far = _norm(series.values[:, :3]) > limit_m
    if far.any():
        return f"position off by more than {limit_m:g} m from {series.t[np.argmax(far)]:.6g} s"
    return ""


def coverage(solution: NavSolution, start: float, end: float) -> str:
    """What of the flight from ``start`` to ``end`` (s) a solution leaves out, or an empty string.

    Up to `UNCOVERED` of it, and a second more, may lack at either end or between two samples: an estimator may align first, or
    answer once a second, but not pick the part of the flight that it is scored on.
    """
    allowed = UNCOVERED * (end - start) + 1.0
    t = solution.t[(solution.t >= start - allowed) & (solution.t <= end + allowed)]
    told = f"covers {solution.t[0]:.6g} to {solution.t[-1]:.6g} s of a flight from {start:.6g} to {end:.6g} s"
    if len(t) == 0 or t[0] - start > allowed or end - t[-1] > allowed:
        return told
    gap = int(np.argmax(np.diff(t))) if len(t) > 1 else 0
    if len(t) > 1 and t[gap + 1] - t[gap] > allowed:
        return f"says nothing between {t[gap]:.6g} and {t[gap + 1]:.6g} s"
    return ""


def nearest_rows(grid: Array, t: Array) -> NDArray[np.intp]:
    """Index of the grid time nearest to each ``t``."""
    k = np.clip(np.searchsorted(grid, t), 1, max(1, len(grid) - 1))
    k = np.minimum(k, len(grid) - 1)
    return k - (t - grid[k - 1] < grid[k] - t)


def _bias_errors(solution: NavSolution, errors: SensorErrors, t: Array) -> Array:
    k, m = nearest_rows(solution.t, t), nearest_rows(errors.t, t)
    assert solution.accel_bias is not None and solution.gyro_bias is not None
    return np.column_stack([solution.accel_bias[k] - errors.accel_bias[m], solution.gyro_bias[k] - errors.gyro_bias[m]])


def _spans(t: Array, window: Window) -> list[tuple[int, int]]:
    """Row ranges of the times in each interval (start, end]."""
    return [
        (int(np.searchsorted(t, a + _TIME_TOLERANCE, "right")), int(np.searchsorted(t, b + _TIME_TOLERANCE, "right")))
        for a, b in window.intervals
    ]


def _with_magnitudes(pv: Array) -> Array:
    """(N,6) position and velocity errors to the first nine of `QUANTITIES`."""
    return np.column_stack([pv[:, :3], _norm(pv[:, :2]), _norm(pv[:, :3]), pv[:, 3:6], _norm(pv[:, 3:6])])


def _norm(values: Array) -> Array:
    return np.sqrt(np.einsum("ij,ij->i", values, values))


def _rms(values: Array) -> Array:
    return np.sqrt(np.einsum("ij,ij->j", values, values) / len(values))


def _only(covariance: Array, used: NDArray[np.bool_]) -> Array:
    """Covariance with the unused channels taken out: zero off the diagonal, one on it."""
    both = used[:, :, None] & used[:, None, :]
    return np.where(both, covariance, np.eye(used.shape[1]))


def _quadratic(error: Array, covariance: Array) -> Array:
    """(K,m), (K,m,m) to e' P^-1 e; infinite where P is singular, as an estimator that is certain of an error deserves."""
    try:
        solved = np.linalg.solve(covariance, error[:, :, None])[:, :, 0]
    except np.linalg.LinAlgError:
        out = np.full(len(error), np.inf)
        for k in range(len(error)):
            try:
                out[k] = error[k] @ np.linalg.solve(covariance[k], error[k])
            except np.linalg.LinAlgError:
                continue
        return out
    return np.einsum("ij,ij->i", error, solved)
