"""Predict and update of the direct (total-state) extended Kalman filters, and the loop over a whole log. Kernels only.

States, models and ``place`` as in `motion_models`; the IMM-RSTEKF paper (2023). A GNSS fix between two IMU samples
splits the interval: predict to the fix, update, predict on. Positions are metres of the scaled coordinates of ``place``.
"""

from __future__ import annotations

import numpy as np
from numba import njit

from estimators import kalman, strong_tracking
from estimators.motion_models import ACCELERATED, N_STATES, add_process_noise, advance, transition
from estimators.strapdown import coning_sculling
from testbed import earth
from testbed.rotations import cross, euler_error_matrix, euler_to_quat, matrix_rotate, quat_to_matrix, wrap

COMMON = 6
"""Measurements that every branch has: position and velocity."""
EXTRA = 3
"""Roll, pitch and yaw of the constant-velocity branch."""
SAME_TIME = 1e-7
"""Times (s) closer than this are one."""


@njit(cache=True)
def propagate_covariance(p, phi, work):
    """P = Phi P Phi' in place; ``phi`` as `transition` makes it (diagonal below row 8). ``work`` (15,15) is scratch."""
    for i in range(9):
        for c in range(N_STATES):
            work[i, c] = phi[i, i] * p[i, c]
        for k in range(N_STATES):
            weight = phi[i, k]
            if weight != 0.0 and k != i:
                for c in range(N_STATES):
                    work[i, c] += weight * p[k, c]
    for i in range(9):
        for j in range(i + 1):
            total = 0.0
            for k in range(N_STATES):
                total += work[i, k] * phi[j, k]
            p[i, j] = total
            p[j, i] = total
        for j in range(9, N_STATES):
            p[i, j] = work[i, j] * phi[j, j]
            p[j, i] = p[i, j]
    for i in range(9, N_STATES):
        for j in range(9, N_STATES):
            p[i, j] *= phi[i, i] * phi[j, j]


@njit(cache=True)
def imu_corrections(imu, k, dt, x, corrections):
    """Coning and sculling of sample ``k`` (a whole interval ``dt``), biases of ``x`` removed, into ``corrections``."""
    if k == 0:
        corrections[:] = 0.0
        return
    now, last = imu[k], imu[k - 1]
    coning, sculling = coning_sculling(
        ((now[0] - x[12]) * dt, (now[1] - x[13]) * dt, (now[2] - x[14]) * dt),
        ((now[3] - x[9]) * dt, (now[4] - x[10]) * dt, (now[5] - x[11]) * dt),
        ((last[0] - x[12]) * dt, (last[1] - x[13]) * dt, (last[2] - x[14]) * dt),
        ((last[3] - x[9]) * dt, (last[4] - x[10]) * dt, (last[5] - x[11]) * dt),
    )
    for i in range(3):
        corrections[i] = coning[i]
        corrections[3 + i] = sculling[i]


@njit(cache=True)
def predict(model, x, p, imu, corrections, dt, setting, held, noise, phi, work):
    """State and covariance of one branch ``dt`` later, in place. ``work`` (16,15) is scratch."""
    transition(model, x, imu, dt, setting, phi)
    advance(model, x, imu, corrections, dt, setting, held, work[15])
    for i in range(N_STATES):
        x[i] = work[15, i]
    propagate_covariance(p, phi, work)
    add_process_noise(p, phi, noise, dt)


@njit(cache=True)
def antenna(x, imu, setting, out):
    """Position and velocity (6,) of the antenna at the end of the lever arm: what a fix should read."""
    place, lever = setting.place, setting.lever
    for i in range(6):
        out[i] = x[i]
    if lever[0] == 0.0 and lever[1] == 0.0 and lever[2] == 0.0:
        return
    m = quat_to_matrix(euler_to_quat(x[6], x[7], x[8]))
    arm = matrix_rotate(m, lever)
    wx, wy, wz = imu[0] - x[12], imu[1] - x[13], imu[2] - x[14]
    swing = (wy * lever[2] - wz * lever[1], wz * lever[0] - wx * lever[2], wx * lever[1] - wy * lever[0])
    velocity = matrix_rotate(m, swing)
    drag = cross(earth.earth_rate_n(place[0] + x[0] / place[2]), arm)
    north, east = earth.metres_per_radian(place[0] + x[0] / place[2], place[1] - x[2])
    out[0] += arm[0] * place[2] / north
    out[1] += arm[1] * place[3] / east
    out[2] += arm[2]
    for i in range(3):
        out[3 + i] += velocity[i] - drag[i]


@njit(cache=True)
def antenna_sensitivity(x, imu, setting, h):
    """Rows 0 to 5 of ``h``: the Jacobian of `antenna` by the state (Earth curvature over the lever arm left out)."""
    place, lever = setting.place, setting.lever
    h[:COMMON] = 0.0
    for i in range(COMMON):
        h[i, i] = 1.0
    if lever[0] == 0.0 and lever[1] == 0.0 and lever[2] == 0.0:
        return
    m = quat_to_matrix(euler_to_quat(x[6], x[7], x[8]))
    arm = matrix_rotate(m, lever)
    wx, wy, wz = imu[0] - x[12], imu[1] - x[13], imu[2] - x[14]
    swing = (wy * lever[2] - wz * lever[1], wz * lever[0] - wx * lever[2], wx * lever[1] - wy * lever[0])
    velocity = matrix_rotate(m, swing)
    axes = euler_error_matrix(x[6], x[7], x[8])
    north, east = earth.metres_per_radian(place[0] + x[0] / place[2], place[1] - x[2])
    scale = (place[2] / north, place[3] / east, 1.0)
    for k in range(3):
        a, b, c = axes[0][k], axes[1][k], axes[2][k]
        h[0, 6 + k] = (b * arm[2] - c * arm[1]) * scale[0]
        h[1, 6 + k] = (c * arm[0] - a * arm[2]) * scale[1]
        h[2, 6 + k] = a * arm[1] - b * arm[0]
        h[3, 6 + k] = b * velocity[2] - c * velocity[1]
        h[4, 6 + k] = c * velocity[0] - a * velocity[2]
        h[5, 6 + k] = a * velocity[1] - b * velocity[0]
    for i in range(3):
        row = m[i]
        h[3 + i, 12] = row[1] * lever[2] - row[2] * lever[1]
        h[3 + i, 13] = row[2] * lever[0] - row[0] * lever[2]
        h[3 + i, 14] = row[0] * lever[1] - row[1] * lever[0]


@njit(cache=True)
def correct(filter_code, x, p, z, r, imu, setting, tracking, fixes, memory, buffers):
    """GNSS update in place by EKF, STEKF or RSTEKF (`strong_tracking`). Returns (theta, log likelihood, fading factor).

    ``tracking`` = (rho, chi-square threshold); ``memory`` (6,) carries Y; ``fixes``: how many came before. ``buffers`` =
    (residual (6,), h (6,15), covariance (6,6), factor (6,6), white (6,), scratch (7,15)): the first three keep what
    the update saw, the covariance with the fading in it. theta is tested before fading, the likelihood taken after.
    """
    residual, h, covariance, factor, white, scratch = buffers
    antenna(x, imu, setting, white)
    for i in range(COMMON):
        residual[i] = z[i] - white[i]
    antenna_sensitivity(x, imu, setting, h)
    kalman.innovation_covariance(p, h, r, covariance, scratch)
    theta, log_det = strong_tracking.whiten(covariance, residual, COMMON, factor, white)
    fading = 1.0
    square = theta
    if filter_code != strong_tracking.EKF:
        strong_tracking.smooth_innovations(memory, residual, tracking[0], fixes == 0)
        if filter_code == strong_tracking.STEKF or theta > tracking[1]:
            fading = strong_tracking.fading_factor(memory, covariance, r)
        if fading > 1.0:
            strong_tracking.fade(p, fading, scratch[0])
            kalman.innovation_covariance(p, h, r, covariance, scratch)
            square, log_det = strong_tracking.whiten(covariance, residual, COMMON, factor, white)
    kalman.update(x, p, residual, h, r, covariance, scratch)
    for i in range(6, 9):
        x[i] = wrap(x[i])
    likelihood = -0.5 * (square + log_det + COMMON * np.log(2.0 * np.pi))
    return theta, likelihood, fading


@njit(cache=True)
def store(k, x, p, states, variances):
    """Row ``k``: the state, and the variances with the attitude as a rotation vector in n."""
    axes = euler_error_matrix(x[6], x[7], x[8])
    for i in range(N_STATES):
        states[k, i] = x[i]
        variances[k, i] = p[i, i]
    for i in range(3):
        a = axes[i]
        variances[k, 6 + i] = (
            a[0] * (a[0] * p[6, 6] + 2.0 * (a[1] * p[6, 7] + a[2] * p[6, 8]))
            + a[1] * (a[1] * p[7, 7] + 2.0 * a[2] * p[7, 8])
            + a[2] * a[2] * p[8, 8]
        )


@njit(cache=True)
def filter_log(start, t, imu, gnss_t, gnss_z, gnss_r, x, p, filter_code, noise, setting, tracking, every, out):
    """One extended Kalman filter with the accelerated model over a whole log; ``x``, ``p`` start it and are overwritten.

    ``out`` = (states (N,15), variances (N,15), snapshots (K,15,15), residuals (M,6), innovation covariances (M,6,6),
    figures (M,2): test statistic and fading factor). Snapshots follow every ``every``-th sample.
    """
    states, variances, snapshots, residuals, covariances, figures = out
    phi, work = np.eye(N_STATES), np.empty((N_STATES + 1, N_STATES))
    corrections, part, held, memory = np.zeros(6), np.zeros(6), np.zeros(3), np.zeros(COMMON)
    buffers = (
        np.empty(COMMON),
        np.zeros((COMMON, N_STATES)),
        np.empty((COMMON, COMMON)),
        np.empty((COMMON, COMMON)),
        np.empty(COMMON),
        np.empty((COMMON + 1, N_STATES)),
    )
    now, g = start, 0
    for k in range(t.shape[0]):
        whole = t[k] - now
        imu_corrections(imu, k, whole, x, corrections)
        while True:
            fix = g < gnss_t.shape[0] and gnss_t[g] <= t[k] + SAME_TIME
            dt = min(gnss_t[g], t[k]) - now if fix else t[k] - now
            if dt > SAME_TIME:
                for i in range(6):
                    part[i] = corrections[i] * dt / whole
                predict(ACCELERATED, x, p, imu[k], part, dt, setting, held, noise, phi, work)
                now += dt
            if not fix:
                break
            theta, _, fading = correct(
                filter_code, x, p, gnss_z[g], gnss_r[g], imu[k], setting, tracking, g, memory, buffers
            )
            residuals[g] = buffers[0]
            covariances[g] = buffers[2]
            figures[g, 0] = theta
            figures[g, 1] = fading
            g += 1
        now = t[k]
        store(k, x, p, states, variances)
        if (k + 1) % every == 0:
            snapshots[(k + 1) // every - 1] = p
    return g
