"""The truth between its rows: position, velocity and attitude of a `Trajectory` at any time, and of any point of the body.

Cubic Hermite interpolation; slopes of the position come from the velocity, the others from the parabola through three
rows (de Boor, *A Practical Guide to Splines*, chapter IV). At 50 Hz and 5 g that is exact to micrometres. SI, radians.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from testbed.base.errors import InputError
from testbed.data.records import Trajectory
from testbed.kernels import njit
from testbed.physics.earth import earth_rate_n, metres_per_radian, position_rates
from testbed.physics.rotations import quat_normalize, quats_to_matrices, wrap

Array = NDArray[np.float64]


def state_at(trajectory: Trajectory, t: Array | float) -> tuple[Array, Array, Array, Array, Array]:
    """Latitude, longitude (rad), height (m) (M,), v_n (M,3) and q_nb (M,4) at the times ``t`` (M,).

    Raises InputError when a time lies outside of the trajectory by more than a nanosecond.
    """
    times = np.ascontiguousarray(np.atleast_1d(t), dtype=np.float64)
    rows = trajectory.t
    if len(times) and not (times.min() >= rows[0] - 1e-9 and times.max() <= rows[-1] + 1e-9):
        raise InputError(
            f"time {times.min():.6g} to {times.max():.6g} s is outside of {rows[0]:.6g} to {rows[-1]:.6g} s"
        )
    place, v_n, q_nb = _interpolate(
        times, rows, trajectory.lat, trajectory.lon, trajectory.h, trajectory.v_n, trajectory.q_nb
    )
    return place[:, 0], place[:, 1], place[:, 2], v_n, q_nb


def point_state(trajectory: Trajectory, t: Array, arm_b: Array) -> tuple[Array, Array, Array, Array]:
    """True lat, lon (rad), h (m), v_n (n,3) of a point at ``arm_b`` (m, in b) from the reference point, at times ``t``.

    Groves eq. 2.165 and 2.166: r + C_nb l and v + C_nb (w_eb_b × l).
    """
    lat, lon, h, v_n, q_nb = state_at(trajectory, t)
    if not arm_b.any() or not len(t):
        return lat, lon, h, v_n
    matrices = quats_to_matrices(q_nb)
    arm_n = matrices @ arm_b
    w_ib_b = np.stack([np.interp(t, *_rate_curve(trajectory, axis)) for axis in range(3)], axis=1)
    w_ie_n = np.stack(np.broadcast_arrays(*earth_rate_n(lat)), axis=1)
    w_eb_n = np.einsum("kij,kj->ki", matrices, w_ib_b) - w_ie_n
    north, east = metres_per_radian(lat, h)
    return lat + arm_n[:, 0] / north, lon + arm_n[:, 1] / east, h - arm_n[:, 2], v_n + np.cross(w_eb_n, arm_n)


def _rate_curve(trajectory: Trajectory, axis: int) -> tuple[Array, Array]:
    """Angular rate at moments: an interval's mean belongs to its middle; the ends are extrapolated."""
    t, w = trajectory.t, trajectory.w_ib_b[1:, axis]
    if len(w) < 2:
        return t, np.full(len(t), w[0])
    first, last = 1.5 * w[0] - 0.5 * w[1], 1.5 * w[-1] - 0.5 * w[-2]
    return np.concatenate([t[:1], t[1:] - 0.5 * np.diff(t), t[-1:]]), np.concatenate([[first], w, [last]])


def sample_times(trajectory: Trajectory, rate_hz: float) -> Array:
    """From one interval after the start to the end."""
    start, end = trajectory.t[0], trajectory.t[-1]
    return np.minimum(start + np.arange(1, math.floor((end - start) * rate_hz + 1e-6) + 1) / rate_hz, end)


@njit(cache=True)
def _interpolate(times, t, lat, lon, h, v, q):
    m, last = times.shape[0], t.shape[0] - 2
    place, v_out, q_out = np.empty((m, 3)), np.empty((m, 3)), np.empty((m, 4))
    found = np.searchsorted(t, times, side="right") - 1
    for j in range(m):
        k = min(max(found[j], 0), last)
        dt = t[k + 1] - t[k]
        x = min(max((times[j] - t[k]) / dt, 0.0), 1.0)
        r0 = position_rates(lat[k], h[k], v[k, 0], v[k, 1], v[k, 2])
        r1 = position_rates(lat[k + 1], h[k + 1], v[k + 1, 0], v[k + 1, 1], v[k + 1, 2])
        step = wrap(lon[k + 1] - lon[k])
        place[j, 0] = lat[k] + _cubic(lat[k + 1] - lat[k], r0[0], r1[0], dt, x)
        place[j, 1] = wrap(lon[k] + _cubic(step, r0[1], r1[1], dt, x))
        place[j, 2] = h[k] + _cubic(h[k + 1] - h[k], r0[2], r1[2], dt, x)
        for i in range(3):
            v_out[j, i] = v[k, i] + _cubic(v[k + 1, i] - v[k, i], _slope(t, v, k, i), _slope(t, v, k + 1, i), dt, x)
        unit = quat_normalize(
            (_part(t, q, k, 0, dt, x), _part(t, q, k, 1, dt, x), _part(t, q, k, 2, dt, x), _part(t, q, k, 3, dt, x))
        )
        for i in range(4):
            q_out[j, i] = unit[i]
    return place, v_out, q_out


@njit(cache=True)
def _cubic(rise, s0, s1, dt, x):
    """Rise of the Hermite cubic at the fraction x, from the whole rise and the slopes at both ends."""
    a, b = dt * s0, dt * s1
    return x * (a + x * (3.0 * rise - 2.0 * a - b + x * (a + b - 2.0 * rise)))


@njit(cache=True)
def _slope(t, y, k, i):
    """Slope at row k of the parabola through it and its neighbours (the nearest three rows at the ends)."""
    c = min(max(k, 1), t.shape[0] - 2)
    before, after = t[c] - t[c - 1], t[c + 1] - t[c]
    d0, d1 = (y[c, i] - y[c - 1, i]) / before, (y[c + 1, i] - y[c, i]) / after
    curve = (d1 - d0) / (before + after)
    return d0 + curve * before + 2.0 * curve * (t[k] - t[c])


@njit(cache=True)
def _part(t, q, k, i, dt, x):
    """One component of the quaternion, with the neighbours' signs made equal to row k's."""
    last = t.shape[0] - 1
    s0 = _quat_slope(t, q, k, k, i)
    s1 = _quat_slope(t, q, k + 1, k, i)
    end = _same_sign(q, min(k + 1, last), k) * q[k + 1, i]
    return q[k, i] + _cubic(end - q[k, i], s0, s1, dt, x)


@njit(cache=True)
def _quat_slope(t, q, k, reference, i):
    c = min(max(k, 1), t.shape[0] - 2)
    y0 = _same_sign(q, c - 1, reference) * q[c - 1, i]
    y1 = _same_sign(q, c, reference) * q[c, i]
    y2 = _same_sign(q, c + 1, reference) * q[c + 1, i]
    before, after = t[c] - t[c - 1], t[c + 1] - t[c]
    d0, d1 = (y1 - y0) / before, (y2 - y1) / after
    curve = (d1 - d0) / (before + after)
    return d0 + curve * before + 2.0 * curve * (t[k] - t[c])


@njit(cache=True)
def _same_sign(q, k, reference):
    dot = 0.0
    for i in range(4):
        dot += q[k, i] * q[reference, i]
    return 1.0 if dot >= 0.0 else -1.0
