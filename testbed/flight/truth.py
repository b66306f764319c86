"""Truth from a flight: a `Trajectory` whose position, velocity, attitude and IMU increments agree exactly.

JSBSim's velocity in n and its Euler angles are splined, see `truth_kernels`. JSBSim's accelerations and its gravity are
not used: they would not be consistent with this project's Earth. SI units and radians.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from testbed.data.records import Phase, Trajectory
from testbed.flight import truth_kernels as kernels
from testbed.physics.rotations import eulers_to_quats

Array = NDArray[np.float64]


def make_trajectory(
    v_n: Array,
    euler: Array,
    rate_hz: float,
    start: tuple[float, float, float],
    extra: Mapping[str, Array] | None = None,
    phases: tuple[Phase, ...] = (),
    name: str = "",
) -> Trajectory:
    """Trajectory from velocity (N,3) in n (m/s) and Euler angles (N,3) sampled at ``rate_hz`` from t = 0.

    ``start`` is latitude, longitude (rad) and height (m) at t = 0. Needs N >= 4.
    """
    dt = 1.0 / rate_hz
    v_n, q_nb = np.ascontiguousarray(v_n), eulers_to_quats(euler)
    v_slope, q_slope = kernels.spline_slopes(v_n, dt), kernels.spline_slopes(q_nb, dt)
    place = kernels.integrate_position(v_n, v_slope, dt, *start)
    f_b, w_ib_b = kernels.imu_means(place, v_n, v_slope, q_nb, q_slope, dt)
    lon = np.mod(place[:, 1] + np.pi, 2.0 * np.pi) - np.pi
    t = np.arange(len(v_n)) / rate_hz
    return Trajectory(t, place[:, 0], lon, place[:, 2], v_n, q_nb, f_b, w_ib_b, extra or {}, phases, name)
