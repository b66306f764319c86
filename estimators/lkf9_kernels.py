"""Kernels of the open-loop 9-state Kalman filter: error matrix, propagation and the loop over a log.

Equations: Titterton & Weston, *Strapdown Inertial Navigation Technology*, 2nd ed., eq. 12.28, spherical Earth of radius R.
States: attitude error psi (C_ins = (I - [psi x]) C, rad), velocity error NED (m/s), then R dlat, R dlon (m, the scaled
radians) and dh (m). SI units and radians; INS minus truth.
"""

from __future__ import annotations

import numpy as np
from numba import njit

from estimators.kalman import update
from testbed import earth
from testbed.rotations import quat_multiply, quat_normalize, quat_rotate, rotvec_to_quat

N_STATES = 9
N_ROWS = 6
"""Measurement rows: velocity NED, then R dlat, R dlon and dh."""


@njit(cache=True)
def error_matrix(lat, v_n, force, radius, a):
    """Fill ``a`` (9,9) so that x' = a x, at latitude (rad), velocity ``v_n`` (m/s) and specific force in n (m/s²).

    The printed matrix leaves out what height does to gravity (row 6, last column); it is in here.
    """
    sine, cosine = np.sin(lat), np.cos(lat)
    tangent = sine / cosine
    vn, ve, vd = v_n[0], v_n[1], v_n[2]
    fn, fe, fd = force[0], force[1], force[2]
    rate, per = earth.RATE, 1.0 / radius
    east = ve * per
    secant2 = 1.0 / (cosine * cosine)
    a[:] = 0.0
    a[0, 1], a[0, 2] = -(rate * sine + east * tangent), vn * per
    a[0, 4], a[0, 6], a[0, 8] = per, -rate * sine * per, -east * per
    a[1, 0], a[1, 2] = rate * sine + east * tangent, rate * cosine + east
    a[1, 3], a[1, 8] = -per, vn * per * per
    a[2, 0], a[2, 1] = -vn * per, -rate * cosine - east
    a[2, 4], a[2, 6], a[2, 8] = -tangent * per, (-rate * cosine - east * secant2) * per, east * tangent * per
    a[3, 1], a[3, 2] = -fd, fe
    a[3, 3], a[3, 4], a[3, 5] = vd * per, -2.0 * (rate * sine + east * tangent), vn * per
    a[3, 6], a[3, 8] = -ve * (2.0 * rate * cosine + east * secant2) * per, east * east * tangent - vn * vd * per * per
    a[4, 0], a[4, 2] = fd, -fn
    a[4, 3] = 2.0 * rate * sine + east * tangent
    a[4, 4], a[4, 5] = (vn * tangent + vd) * per, 2.0 * rate * cosine + east
    a[4, 6] = (2.0 * rate * (vn * cosine - vd * sine) + vn * east * secant2) * per
    a[4, 8] = -east * (vn * tangent + vd) * per
    a[5, 0], a[5, 1] = -fe, fn
    a[5, 3], a[5, 4] = -2.0 * vn * per, -2.0 * (rate * cosine + east)
    a[5, 6] = 2.0 * rate * ve * sine * per
    a[5, 8] = (vn * vn + ve * ve) * per * per - 2.0 * earth.GRAVITY_EQUATOR * per
    a[6, 3], a[6, 8] = 1.0, -vn * per
    a[7, 4], a[7, 6], a[7, 8] = 1.0 / cosine, east * tangent / cosine, -east / cosine
    a[8, 5] = -1.0


@njit(cache=True)
def propagate(x, p, a, velocity_noise, attitude_noise, dt, work, state):
    """x = Phi x and P = Phi (P + G Q G' dt) Phi' with Phi = I + a dt, in place.

    The noises are Q's diagonal for accelerometers and gyros, equal on the three axes, so that C drops out of G Q G'.
    ``work`` (9,9) and ``state`` (9,) are overwritten.
    """
    for i in range(3):
        p[i, i] += attitude_noise * dt
        p[3 + i, 3 + i] += velocity_noise * dt
    n = N_STATES
    for i in range(n):
        total = x[i]
        for j in range(n):
            total += dt * a[i, j] * x[j]
            work[i, j] = p[i, j]
        state[i] = total
        for k in range(n):
            step = dt * a[i, k]
            if step != 0.0:
                for j in range(n):
                    work[i, j] += step * p[k, j]
    x[:] = state
    for i in range(n):
        for j in range(i + 1):
            total = work[i, j]
            for k in range(n):
                total += work[i, k] * dt * a[j, k]
            p[i, j] = total
            p[j, i] = total


@njit(cache=True)
def run(t, accel, lla, velocity, quaternion, times, z, r, first, p, noise, radius, every):
    """The filter over a log: free INS rows and measurements in, its error estimates out.

    ``t`` (N+1,) with the start in row 0, as in ``lla``, ``velocity``, ``quaternion`` (radians, metres); ``accel`` (N,3).
    ``times``, ``z``, ``r`` (M,6): measurements INS minus GNSS with noise variances; the rows from ``first`` (M,) on are
    used (0: all, 3: position, 6: none). ``p`` (9,9) initial covariance, changed; ``noise`` (accelerometer, gyro).
    Returns x (N,9), variances (N,9), innovations (M,6) and their covariances (M,6,6) before each update, NaN where a row
    is not used, and covariances (K,9,9) after every ``every``-th IMU sample.
    """
    n, m = accel.shape[0], times.shape[0]
    x = np.zeros(N_STATES)
    states, variances = np.empty((n, N_STATES)), np.empty((n, N_STATES))
    innovations, covariances = np.full((m, N_ROWS), np.nan), np.full((m, N_ROWS, N_ROWS), np.nan)
    snapshots = np.empty((n // every, N_STATES, N_STATES))
    a, work, state = np.empty((N_STATES, N_STATES)), np.empty((N_STATES, N_STATES)), np.empty(N_STATES)
    h = np.zeros((N_ROWS, N_STATES))
    for i in range(N_ROWS):
        h[i, 3 + i] = 1.0
    scratch = np.empty((N_ROWS + 1, N_STATES))
    now, done = t[0], 0
    for k in range(n):
        before, after = quat_rotate(quaternion[k], accel[k]), quat_rotate(quaternion[k + 1], accel[k])
        force = (0.5 * (before[0] + after[0]), 0.5 * (before[1] + after[1]), 0.5 * (before[2] + after[2]))
        error_matrix(lla[k, 0], velocity[k], force, radius, a)
        while done < m and times[done] <= t[k + 1]:
            if times[done] > now:
                propagate(x, p, a, noise[0], noise[1], times[done] - now, work, state)
                now = times[done]
            row = first[done]
            if row < N_ROWS:
                for i in range(row, N_ROWS):
                    innovations[done, i] = z[done, i] - x[3 + i]
                update(x, p, innovations[done, row:], h[row:], r[done, row:], covariances[done, row:, row:], scratch)
            done += 1
        if t[k + 1] > now:
            propagate(x, p, a, noise[0], noise[1], t[k + 1] - now, work, state)
            now = t[k + 1]
        for i in range(N_STATES):
            states[k, i] = x[i]
            variances[k, i] = p[i, i]
        if (k + 1) % every == 0:
            snapshots[(k + 1) // every - 1] = p
    return states, variances, innovations, covariances, snapshots


@njit(cache=True)
def correct_attitudes(quaternion, x):
    """(N,4) attitudes of the INS turned by the estimated errors psi = x[:, :3]."""
    out = np.empty(quaternion.shape)
    for k in range(quaternion.shape[0]):
        q = quat_normalize(quat_multiply(rotvec_to_quat(x[k]), quaternion[k]))
        for i in range(4):
            out[k, i] = q[i]
    return out
