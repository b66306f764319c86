"""Errors of a solution against truth, and the metrics of the tables: accuracy per window and consistency (NEES, NIS).

Bar-Shalom, Li & Kirubarajan, *Estimation with Applications to Tracking and Navigation*, 5.4 (NEES, NIS). Errors are
estimate minus truth: metres and m/s along n, Euler angles in degrees, the attitude error a rotation vector in n.

Metric names are a statistic and a quantity. With e the error over the samples of a window:

- ``rmse_``  root mean square of e
- ``max_``   largest absolute error
- ``final_`` absolute error at the end of the window (root mean square over the ends of a window of several intervals)
- ``mean_``  mean of e, signed for an axis, of the magnitude for ``position_2d_m`` and the like

of `quantities.QUANTITIES`. ``nees_position``, ``nees_velocity``, ``nees_attitude``, ``nees_bias`` (degrees of freedom: the
states of that name that the estimator has) and ``nis`` are averages over time. ``rmse_gnss_`` and ``mean_gnss_`` compare with the GNSS fixes instead of truth, as papers
do that have no reference: at the time that each fix describes, at the antenna.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from testbed.data.records import (
    ACCEL_BIAS_STATES,
    GYRO_BIAS_STATES,
    NAVIGATION_STATES,
    Array,
    GnssFixes,
    Innovations,
    NavSolution,
    SensorErrors,
    Trajectory,
)
from testbed.physics import earth, rotations
from testbed.scenario.windows import Window
from testbed.scoring.error_kernels import quadratic_forms
from testbed.scoring.error_series import TIME_TOLERANCE, ErrorSeries, error_series, nearest_rows
from testbed.scoring.error_series import truth_at as truth_at  # plug-ins of 0.1 have it from here
from testbed.scoring.quantities import (
    AGAINST_FIXES,
    FIX_STATISTICS,
    NEES,
    NIS,
    STATISTICS,
    scored_quantities,
)

if TYPE_CHECKING:
    import pandas as pd

UNCOVERED = 0.01
"""Share of a flight that a solution may leave out at either end, or between two samples."""


@dataclass(frozen=True)
class Consistency:
    """One test statistic over time: ``t`` (K,), ``value`` (K,) and its degrees of freedom ``dof`` (K,)."""

    t: Array
    value: Array
    dof: Array


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
    rows: list[tuple[str, str, float]] = []
    names = [(statistic, q.name) for statistic in STATISTICS for q in series.scored]
    for window in windows:
        if (found := series.statistics(_spans(series.t, window))) is not None:
            rows += [
                (window.name, f"{statistic}_{name}", value)
                for (statistic, name), value in zip(names, found.ravel().tolist(), strict=True)
            ]
        for name, test in tests.items():
            inside = np.concatenate([test.value[a:b] for a, b in _spans(test.t, window)])
            if len(inside):
                rows.append((window.name, name, float(inside.mean())))
    return rows


def consistency(
    series: ErrorSeries, solution: NavSolution, errors: SensorErrors | None = None
) -> dict[str, Consistency]:
    """NEES of each group of states at the covariance snapshots, and NIS of the innovations, as far as the solution tells.

    A group is tested on the states of it that the solution names and whose truth is known.
    """
    out: dict[str, Consistency] = {}
    if solution.covariance is not None and solution.covariance_t is not None and len(series.t):
        keep = _at_rows(series.t, solution.covariance_t, solution.t)
        t, at = solution.covariance_t[keep], np.flatnonzero(keep)
        known = _state_errors(series, solution, errors, t) if len(t) else {}
        for name, test in NEES.items():
            rows = [k for k, s in enumerate(solution.states) if s in known and s.startswith(test.prefixes)]
            if rows:
                error = np.column_stack([known[solution.states[k]] for k in rows])
                value = quadratic_forms(error, solution.covariance, at, np.array(rows))
                out[name] = Consistency(t, value, np.full(len(t), float(len(rows))))
    return out | _innovation_tests(solution)


def _at_rows(rows: Array, t: Array, grid: Array) -> NDArray[np.bool_]:
    """Which of the times ``t`` (K,) lie within ``rows``, and no further from one of them than a step of ``grid``."""
    near = np.abs(rows[nearest_rows(rows, t)] - t) <= float(np.median(np.diff(grid))) + TIME_TOLERANCE
    return (t >= rows[0]) & (t <= rows[-1]) & near


def _state_errors(
    series: ErrorSeries, solution: NavSolution, errors: SensorErrors | None, t: Array
) -> dict[str, Array]:
    """Errors (K,) of the states whose truth is known, at times ``t`` (K,)."""
    values, phi = series.at(nearest_rows(series.t, t))
    found = dict(zip(NAVIGATION_STATES, np.column_stack([values[:, :6], phi]).T, strict=True))
    found = {state: error for state, error in found.items() if state.startswith(series.known)}
    if errors is None:
        return found
    own, true = nearest_rows(solution.t, t), nearest_rows(errors.t, t)
    if solution.accel_bias is not None:
        found |= zip(ACCEL_BIAS_STATES, (solution.accel_bias[own] - errors.accel_bias[true]).T, strict=True)
    if solution.gyro_bias is not None:
        found |= zip(GYRO_BIAS_STATES, (solution.gyro_bias[own] - errors.gyro_bias[true]).T, strict=True)
    return found


def _innovation_tests(solution: NavSolution) -> dict[str, Consistency]:
    """``nis`` of all updates that were taken, in time order; also ``nis_AIDING`` where there are several aidings."""
    parts = {name: _nis(nu.taken()) for name, nu in solution.innovations.items()}
    parts = {name: part for name, part in parts.items() if len(part.t)}
    if len(parts) < 2:
        return dict(zip([NIS], parts.values(), strict=False))
    joined = [np.concatenate([getattr(part, key) for part in parts.values()]) for key in ("t", "value", "dof")]
    order = np.argsort(joined[0], kind="stable")
    return {NIS: Consistency(*(column[order] for column in joined))} | {f"{NIS}_{n}": part for n, part in parts.items()}


def _nis(nu: Innovations) -> Consistency:
    """nu' S^-1 nu of each update; a channel that is NaN had no measurement and does not count."""
    used = np.isfinite(nu.value)
    each, channels = np.arange(len(used)), np.arange(used.shape[1])
    value = quadratic_forms(np.where(used, nu.value, 0.0), _only(nu.covariance, used), each, channels)
    some = used.any(axis=1)
    return Consistency(nu.t[some], value[some], used.sum(axis=1).astype(float)[some])


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
    error = np.column_stack([ned, np.column_stack(v) - gnss.v_n[inside]])
    compared = [q for q in scored_quantities(solution.states) if q.name in AGAINST_FIXES]
    if not compared:
        return []
    values = np.column_stack([q.of(error, error) for q in compared])
    rows: list[tuple[str, str, float]] = []
    for window in windows:
        part = np.concatenate([values[a:b] for a, b in _spans(t, window)])
        if len(part):
            for statistic, row in zip(FIX_STATISTICS, (_rms(part), part.mean(axis=0)), strict=True):
                rows += [
                    (window.name, f"{statistic}_gnss_{q.name}", float(x)) for q, x in zip(compared, row, strict=True)
                ]
    return rows


def divergence(series: ErrorSeries, limit_m: float) -> str:
    """Why a solution counts as diverged, or an empty string: a value that is not finite, or position off by ``limit_m``."""
    if len(series.t) == 0:
        return "no sample within the flight"
    if series.stays_within(limit_m):
        return ""
    axes = series.axes()
    finite = np.isfinite(series.values[:, axes]).all(axis=1)
    if not finite.all():
        return f"not finite from {series.t[np.argmin(finite)]:.6g} s"
    far = np.linalg.norm(series.values[:, [k for k in axes if k < 3]], axis=1) > limit_m
    return f"position off by more than {limit_m:g} m from {series.t[np.argmax(far)]:.6g} s" if far.any() else ""


def coverage(solution: NavSolution, start: float, end: float, gaps: Sequence[tuple[float, float]] = ()) -> str:
    """What of the flight from ``start`` to ``end`` (s) a solution leaves out, or an empty string.

    Up to `UNCOVERED` of it, and a second more, may lack at either end or between two samples: an estimator may align first, or
    answer once a second, but not pick the part of the flight that it is scored on. ``gaps`` (s) are those of the recorded IMU,
    in which nobody can say anything.
    """
    allowed = UNCOVERED * (end - start) + 1.0
    t = solution.t[(solution.t >= start - allowed) & (solution.t <= end + allowed)]
    told = f"covers {solution.t[0]:.6g} to {solution.t[-1]:.6g} s of a flight from {start:.6g} to {end:.6g} s"
    if len(t) == 0 or t[0] - start > allowed or end - t[-1] > allowed:
        return told
    silent = np.diff(t)
    for before, after in gaps:
        silent -= np.clip(np.minimum(t[1:], after) - np.maximum(t[:-1], before), 0.0, None)
    gap = int(np.argmax(silent)) if len(t) > 1 else 0
    if len(t) > 1 and silent[gap] > allowed:
        return f"says nothing between {t[gap]:.6g} and {t[gap + 1]:.6g} s"
    return ""


def _spans(t: Array, window: Window) -> list[tuple[int, int]]:
    """Row ranges of the times in each interval (start, end]."""
    return [
        (int(np.searchsorted(t, a + TIME_TOLERANCE, "right")), int(np.searchsorted(t, b + TIME_TOLERANCE, "right")))
        for a, b in window.intervals
    ]


def _rms(values: Array) -> Array:
    return np.sqrt(np.einsum("ij,ij->j", values, values) / len(values))


def _only(covariance: Array, used: NDArray[np.bool_]) -> Array:
    """Covariance with the unused channels taken out: zero off the diagonal, one on it."""
    both = used[:, :, None] & used[:, None, :]
    return np.where(both, covariance, np.eye(used.shape[1]))
