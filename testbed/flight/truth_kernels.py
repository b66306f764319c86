"""Spline kinematics: from sampled velocity and attitude to positions and to the increments of a perfect IMU.

Velocity in n and the attitude quaternion are C2 cubic splines in time; position is the integral of the velocity over
WGS-84; specific force and angular rate follow by differentiation (Groves, 2nd ed., eq. 5.53, 5.44 and 2.66), so the
three are kinematically exact. Frames n and b, SI units and radians.
"""

from __future__ import annotations

import numpy as np

from testbed.kernels import njit
from testbed.physics.earth import earth_rate_n, gravity, metres_per_radian, transport_rate_n
from testbed.physics.rotations import cross, quat_conjugate, quat_multiply, quat_normalize, quat_rotate_inverse

GAUSS_NODES = np.array([0.5 - np.sqrt(0.15), 0.5, 0.5 + np.sqrt(0.15)])
GAUSS_WEIGHTS = np.array([5.0 / 18.0, 8.0 / 18.0, 5.0 / 18.0])
"""Gauss-Legendre with three nodes on (0, 1): exact for degree 5, two more than the cubic that it integrates."""


@njit(cache=True)
def spline_slopes(y, dt):
    """Slopes (N,m) at the knots of the C2 cubic spline through ``y`` (N,m), uniform step, not-a-knot ends (N >= 4).

    De Boor, *A Practical Guide to Splines*, chapter IV, eq. 5 and 7; Thomas algorithm, which needs N extra numbers.
    """
    n, m = y.shape
    out = np.empty((n, m))
    ratio = np.empty(n)
    for j in range(m):
        # first row: s0 + 2 s1 = (5 d0 + d1) / 2, d the divided differences
        ratio[0] = 2.0
        out[0, j] = (5.0 * (y[1, j] - y[0, j]) + (y[2, j] - y[1, j])) / (2.0 * dt)
    for k in range(1, n - 1):
        pivot = 1.0 / (4.0 - ratio[k - 1])
        ratio[k] = pivot
        for j in range(m):
            out[k, j] = (3.0 * (y[k + 1, j] - y[k - 1, j]) / dt - out[k - 1, j]) * pivot
    for j in range(m):
        # last row: 2 s[n-2] + s[n-1] = (d[n-3] + 5 d[n-2]) / 2
        last = (5.0 * (y[n - 1, j] - y[n - 2, j]) + (y[n - 2, j] - y[n - 3, j])) / (2.0 * dt)
        out[n - 1, j] = (last - 2.0 * out[n - 2, j]) / (1.0 - 2.0 * ratio[n - 2])
    for k in range(n - 2, -1, -1):
        for j in range(m):
            out[k, j] -= ratio[k] * out[k + 1, j]
    return out


@njit(cache=True)
def hermite(y0, y1, s0, s1, dt, x):
    """Value and time derivative of the cubic between two knots at the fraction x of the interval."""
    d = y1 - y0
    a = dt * s0
    c2 = 3.0 * d - 2.0 * a - dt * s1
    c3 = a + dt * s1 - 2.0 * d
    return y0 + x * (a + x * (c2 + x * c3)), (a + x * (2.0 * c2 + 3.0 * x * c3)) / dt


@njit(cache=True)
def hermite_integral(y0, y1, s0, s1, dt, x):
    """Integral of the cubic from the first knot to the fraction x of the interval."""
    d = y1 - y0
    a = dt * s0
    c2 = 3.0 * d - 2.0 * a - dt * s1
    c3 = a + dt * s1 - 2.0 * d
    return dt * x * (y0 + x * (a / 2.0 + x * (c2 / 3.0 + x * c3 / 4.0)))


@njit(cache=True)
def resample(y, slope, dt, at, out):
    """Fill ``out`` (M,n) with the splines of ``y`` (N,n) at the places ``at`` (M,), in knots from the first one."""
    last = y.shape[0] - 2
    for j in range(at.shape[0]):
        k = min(int(at[j]), last)
        for i in range(y.shape[1]):
            out[j, i], _ = hermite(y[k, i], y[k + 1, i], slope[k, i], slope[k + 1, i], dt, at[j] - k)


@njit(cache=True)
def integrate_position(v, slope, dt, lat, lon, h):
    """Latitude, longitude (rad) and height (m) at every knot from the start; v and slope (N,3).

    Radii are those at the middle of each interval: the error per step is of third order in its length over the Earth's
    radius, far below a nanometre.
    """
    n = v.shape[0]
    place = np.empty((n, 3))
    place[0, 0], place[0, 1], place[0, 2] = lat, lon, h
    for k in range(n - 1):
        north, east, down = _displacement(v, slope, k, dt, 1.0)
        half_north, _, half_down = _displacement(v, slope, k, dt, 0.5)
        rn, _ = metres_per_radian(place[k, 0], place[k, 2])
        rn, re = metres_per_radian(place[k, 0] + half_north / rn, place[k, 2] - half_down)
        place[k + 1, 0] = place[k, 0] + north / rn
        place[k + 1, 1] = place[k, 1] + east / re
        place[k + 1, 2] = place[k, 2] - down
    return place


@njit(cache=True)
def _displacement(v, slope, k, dt, x):
    return (
        hermite_integral(v[k, 0], v[k + 1, 0], slope[k, 0], slope[k + 1, 0], dt, x),
        hermite_integral(v[k, 1], v[k + 1, 1], slope[k, 1], slope[k + 1, 1], dt, x),
        hermite_integral(v[k, 2], v[k + 1, 2], slope[k, 2], slope[k + 1, 2], dt, x),
    )


@njit(cache=True)
def imu_means(place, v, v_slope, q, q_slope, dt):
    """Means over (t[k-1], t[k]] of specific force and angular rate in b, both (N,3); row 0 repeats row 1."""
    n = v.shape[0]
    force, rate = np.zeros((n, 3)), np.zeros((n, 3))
    for k in range(n - 1):
        for node in range(GAUSS_NODES.shape[0]):
            f, w = _inertial(place, v, v_slope, q, q_slope, k, dt, GAUSS_NODES[node])
            for i in range(3):
                force[k + 1, i] += GAUSS_WEIGHTS[node] * f[i]
                rate[k + 1, i] += GAUSS_WEIGHTS[node] * w[i]
    for i in range(3):  # element by element: numba takes seconds to compile the assignment of a row
        force[0, i], rate[0, i] = force[1, i], rate[1, i]
    return force, rate


@njit(cache=True)
def _inertial(place, v, v_slope, q, q_slope, k, dt, x):
    """Specific force and inertial angular rate in b at the fraction x of interval k."""
    vn, an = hermite(v[k, 0], v[k + 1, 0], v_slope[k, 0], v_slope[k + 1, 0], dt, x)
    ve, ae = hermite(v[k, 1], v[k + 1, 1], v_slope[k, 1], v_slope[k + 1, 1], dt, x)
    vd, ad = hermite(v[k, 2], v[k + 1, 2], v_slope[k, 2], v_slope[k + 1, 2], dt, x)
    q0, d0 = hermite(q[k, 0], q[k + 1, 0], q_slope[k, 0], q_slope[k + 1, 0], dt, x)
    q1, d1 = hermite(q[k, 1], q[k + 1, 1], q_slope[k, 1], q_slope[k + 1, 1], dt, x)
    q2, d2 = hermite(q[k, 2], q[k + 1, 2], q_slope[k, 2], q_slope[k + 1, 2], dt, x)
    q3, d3 = hermite(q[k, 3], q[k + 1, 3], q_slope[k, 3], q_slope[k + 1, 3], dt, x)
    lat = place[k, 0] + x * (place[k + 1, 0] - place[k, 0])
    h = place[k, 2] + x * (place[k + 1, 2] - place[k, 2])
    ie, en = earth_rate_n(lat), transport_rate_n(lat, h, vn, ve)
    coriolis = cross((2.0 * ie[0] + en[0], 2.0 * ie[1] + en[1], 2.0 * ie[2] + en[2]), (vn, ve, vd))
    unit = quat_normalize((q0, q1, q2, q3))
    f = quat_rotate_inverse(unit, (an + coriolis[0], ae + coriolis[1], ad + coriolis[2] - gravity(lat, h)))
    frame = quat_rotate_inverse(unit, (ie[0] + en[0], ie[1] + en[1], ie[2] + en[2]))
    # q is not exactly of unit length between knots; the vector part of conj(q) dq over |q|² does not see its length
    turn = quat_multiply(quat_conjugate((q0, q1, q2, q3)), (d0, d1, d2, d3))
    scale = 2.0 / (q0 * q0 + q1 * q1 + q2 * q2 + q3 * q3)
    return f, (scale * turn[1] + frame[0], scale * turn[2] + frame[1], scale * turn[3] + frame[2])
