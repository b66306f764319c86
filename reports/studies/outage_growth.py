"""What position error at the end of a GNSS outage is made of, and how well a filter knew the biases and itself.

Each part is a free run of the strapdown through the outage from the truth with one group of the filter's errors put in: what
a network would have to foretell. Metres, m/s², rad/s.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from testbed.data.records import NavSolution, SensorErrors, SensorLog, Trajectory
from testbed.physics import earth
from testbed.physics.rotations import quat_multiply, rotvec_to_quat

CONVERGED_S = 249.0
"""Just before the first outage."""
AXES = ("accel x", "accel y", "accel z", "gyro x", "gyro y", "gyro z")
GROUPS = ("position and velocity", "attitude", "biases", "sensor errors in the outage", "all of it")


def distance_at(one: NavSolution, other: NavSolution, times: Sequence[float]) -> np.ndarray:
    """Distance (m) between two solutions of one log at ``times``."""
    rows = np.searchsorted(one.t, np.asarray(times) + 1e-6) - 1
    place = earth.position_difference(
        *(part[rows] for part in (one.lat, one.lon, one.h, other.lat, other.lon, other.h))
    )
    return np.linalg.norm(np.column_stack(place), axis=1)


def growth(trajectory: Trajectory, log: SensorLog, errors: SensorErrors, solution: NavSolution) -> dict[str, Any]:
    """Position error (outages, groups) in m at the end of each outage, by what it came from (`GROUPS`)."""
    assert log.gnss is not None
    table = [[_coast(trajectory, log, errors, solution, a, b, group) for group in GROUPS] for a, b in log.gnss.outages]
    return {"groups": GROUPS, "outages": log.gnss.outages, "error_m": np.array(table)}


def _coast(
    truth: Trajectory, log: SensorLog, errors: SensorErrors, solution: NavSolution, start: float, end: float, group: str
) -> float:
    """Position error at ``end`` of a free run from the truth at ``start`` with the errors of one group."""
    from estimators.core.strapdown import integrate
    from testbed.physics.rotations import attitude_errors

    imu = log.imu
    rows = slice(int(np.searchsorted(imu.t, start + 1e-6)), int(np.searchsorted(imu.t, end + 1e-6)))
    k = rows.start - 1  # row of the solution; the truth has one row more before it
    j = k + 1
    assert solution.accel_bias is not None and solution.gyro_bias is not None
    whole = group == "all of it"
    take = {name: whole or group == name for name in GROUPS}
    lat, lon, h = (float(x) for x in (truth.lat[j], truth.lon[j], truth.h[j]))
    v, q = truth.v_n[j].copy(), truth.q_nb[j].copy()
    if take["position and velocity"]:
        lat, lon, h = float(solution.lat[k]), float(solution.lon[k]), float(solution.h[k])
        v = solution.v_n[k].copy()
    if take["attitude"]:
        phi = attitude_errors(solution.q_nb[k : k + 1], truth.q_nb[j : j + 1])[0]
        q = np.array(quat_multiply(rotvec_to_quat(phi), q))
    accel_bias, gyro_bias = np.zeros(3), np.zeros(3)
    gyro, accel = truth.w_ib_b[1:][rows], truth.f_b[1:][rows]
    if take["biases"]:
        accel_bias = solution.accel_bias[k] - errors.accel_bias[k]
        gyro_bias = solution.gyro_bias[k] - errors.gyro_bias[k]
    if take["sensor errors in the outage"]:
        gyro = imu.gyro[rows] - errors.gyro_bias[k]
        accel = imu.accel[rows] - errors.accel_bias[k]
    n = rows.stop - rows.start
    lla, velocity, quaternion = np.empty((n, 3)), np.empty((n, 3)), np.empty((n, 4))
    gyro, accel = np.ascontiguousarray(gyro), np.ascontiguousarray(accel)
    integrate(imu.t[k], imu.t[rows], gyro, accel, lat, lon, h, v, q, accel_bias, gyro_bias, lla, velocity, quaternion)
    last = rows.stop
    place = earth.position_difference(*lla[-1], truth.lat[last], truth.lon[last], truth.h[last])
    return float(np.linalg.norm(place))


def bias_table(
    solution: NavSolution, errors: SensorErrors, until: float = CONVERGED_S, within: float = 0.1
) -> dict[str, Any]:
    """How right the bias estimates were with GNSS: truth, estimate and per cent right at ``until``, convergence times.

    An axis has converged when it stays within ``within`` of its final estimate (at ``until``), relative to the true bias.
    """
    assert solution.accel_bias is not None and solution.gyro_bias is not None
    k = int(np.searchsorted(solution.t, until)) - 1
    truth = np.hstack([errors.accel_bias, errors.gyro_bias])
    estimate = np.hstack([solution.accel_bias, solution.gyro_bias])
    right = 100.0 * (1.0 - np.abs(estimate[k] - truth[k]) / np.abs(truth[k]))
    away = np.abs(estimate[:k] - estimate[k]) > within * np.abs(truth[k])
    last = [solution.t[np.flatnonzero(column)[-1]] if column.any() else solution.t[0] for column in away.T]
    return {"truth": truth[k], "estimate": estimate[k], "right_pct": right, "convergence_s": np.array(last)}


def outside_share(trajectory: Trajectory, solution: NavSolution, windows: Any, sigmas: float = 3.0) -> np.ndarray:
    """Share (9,) of the time within ``windows`` that each error is outside its band: position, velocity, attitude."""
    from testbed.scoring.metrics import error_series

    series = error_series(trajectory, solution)
    assert solution.std is not None
    error = np.hstack([series.values[:, :6], series.phi])
    inside = np.zeros(len(series.t), dtype=bool)
    for a, b in windows:
        inside |= (series.t > a) & (series.t <= b)
    return np.mean(np.abs(error[inside]) > sigmas * solution.std[: len(error)][inside][:, :9], axis=0)
