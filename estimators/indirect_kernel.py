"""The loosely coupled 15-state closed-loop error-state filter over a whole log, as one compiled loop.

Groves, 2nd ed., sections 14.2 and 14.3. Kernels only. States as `testbed.records.STATE_NAMES`; SI units and radians;
fixes are taken at their own time, between two IMU samples if need be.
"""

from __future__ import annotations

import numpy as np
from numba import njit

from estimators.error_model import N_STATES, coefficients, propagate, symmetrize, transpose
from estimators.kalman import update
from estimators.strapdown import advance, compensate, coning_sculling, increments
from testbed import earth
from testbed.rotations import (
    cross,
    matrix_rotate,
    quat_multiply,
    quat_normalize,
    quat_to_matrix,
    rotvec_to_quat,
)

MEASUREMENTS = 6
"""Position north, east, down (m) and velocity north, east, down (m/s) of the antenna."""
SAME_TIME = 1e-7
"""Times (s) closer than this are one: a step so short would only add rounding."""


@njit(cache=True)
def filter_log(
    t_start,
    t,
    gyro,
    accel,
    lever,
    fix_t,
    fix_lla,
    fix_v,
    fix_variance,
    start,
    covariance_start,
    q,
    decay,
    bias_mean,
    stride,
    lla,
    velocity,
    quaternion,
    bias,
    std,
    snapshot_stride,
    snapshots,
    innovation,
    innovation_covariance,
):
    """Filter a log. Arrays of N IMU means, M fixes; ``start`` (16,): lat, lon, h, v_n, q_nb, accel and gyro bias.

    ``q`` (12,) as in `error_model.add_noise`, ``decay`` (2,) inverse correlation times of the biases (1/s), which
    return to ``bias_mean`` (6,). Row k // stride of the outputs is the state after every measurement up to
    t[k], written for k = stride - 1, 2 stride - 1, ...; ``snapshots`` take P at every ``snapshot_stride``-th IMU time
    in the same way, ``innovation`` (M,6) and its covariance (M,6,6) keep NaN for fixes outside of the IMU's time.
    """
    lat, lon, h = start[0], start[1], start[2]
    v = (start[3], start[4], start[5])
    qn = (start[6], start[7], start[8], start[9])
    b = start[10:16].copy()
    p = covariance_start.copy()
    work = np.empty((N_STATES, N_STATES))
    x = np.zeros(N_STATES)
    sensitivity = np.zeros((MEASUREMENTS, N_STATES))
    scratch = np.empty((4, N_STATES))
    m = quat_to_matrix(qn)
    now = t_start
    next_fix = 0
    while next_fix < fix_t.shape[0] and fix_t[next_fix] < t_start - SAME_TIME:
        next_fix += 1
    angle_before = (0.0, 0.0, 0.0)
    velocity_before = (0.0, 0.0, 0.0)

    for k in range(t.shape[0]):
        whole = t[k] - now
        angle, dv = increments(gyro[k], accel[k], b[3:], b[:3], whole)
        coning, sculling = coning_sculling(angle, dv, angle_before, velocity_before)
        angle_before, velocity_before = angle, dv
        while True:
            has_fix = next_fix < fix_t.shape[0] and fix_t[next_fix] <= t[k] + SAME_TIME
            target = min(fix_t[next_fix], t[k]) if has_fix else t[k]
            dt = target - now
            if dt > SAME_TIME:
                part = dt / whole
                angle, dv = increments(gyro[k], accel[k], b[3:], b[:3], dt)
                coning_part = (coning[0] * part, coning[1] * part, coning[2] * part)
                sculling_part = (sculling[0] * part, sculling[1] * part, sculling[2] * part)
                c = coefficients(lat, h, v)
                keep_accel, keep_gyro = np.exp(-dt * decay[0]), np.exp(-dt * decay[1])
                rotation, change = compensate(angle, dv, coning_part, sculling_part)
                lat, lon, h, v_end, qn, force = advance(lat, lon, h, v, qn, rotation, change, dt)
                m_end = quat_to_matrix(qn)
                propagate(p, work, c, mean_matrix(m, m_end), force, v, keep_accel, keep_gyro, q, dt)
                for i in range(3):
                    b[i] = bias_mean[i] + keep_accel * (b[i] - bias_mean[i])
                    b[3 + i] = bias_mean[3 + i] + keep_gyro * (b[3 + i] - bias_mean[3 + i])
                v, m = v_end, m_end
                now = target
            if not has_fix:
                break
            residual = innovation[next_fix]
            measure(lat, lon, h, v, m, gyro[k], b, lever, fix_lla[next_fix], fix_v[next_fix], residual, sensitivity)
            x[:] = 0.0
            update(x, p, residual, sensitivity, fix_variance[next_fix], innovation_covariance[next_fix], scratch)
            lat, lon, h, v, qn = correct(lat, lon, h, v, qn, b, x)
            reset(p, (x[3], x[4], x[5]))
            m = quat_to_matrix(qn)
            next_fix += 1
        now = t[k]
        if (k + 1) % stride == 0:
            row = k // stride
            lla[row, 0], lla[row, 1], lla[row, 2] = lat, lon, h
            for i in range(3):
                velocity[row, i] = v[i]
            for i in range(4):
                quaternion[row, i] = qn[i]
            for i in range(6):
                bias[row, i] = b[i]
            for i in range(N_STATES):
                std[row, i] = np.sqrt(p[i, i])
        if (k + 1) % snapshot_stride == 0:
            snapshots[k // snapshot_stride] = p


@njit(cache=True)
def mean_matrix(a, b):
    """Mean of two matrices of nested tuples: C_nb in the middle of a step, to second order."""
    return (
        (0.5 * (a[0][0] + b[0][0]), 0.5 * (a[0][1] + b[0][1]), 0.5 * (a[0][2] + b[0][2])),
        (0.5 * (a[1][0] + b[1][0]), 0.5 * (a[1][1] + b[1][1]), 0.5 * (a[1][2] + b[1][2])),
        (0.5 * (a[2][0] + b[2][0]), 0.5 * (a[2][1] + b[2][1]), 0.5 * (a[2][2] + b[2][2])),
    )


@njit(cache=True)
def measure(lat, lon, h, v_n, m, gyro, b, lever, fix_lla, fix_v, residual, sensitivity):
    """Innovation (6,) = fix minus prediction at the antenna, and its sensitivity (6,15) to the error *in the truth*.

    Truth = estimate - error, so the sensitivity is that of the measurement to minus the error: ``correct`` then adds.
    Groves eq. 14.110 and 14.111 with position in metres; ``lever`` from the IMU to the antenna in b.
    """
    arm = matrix_rotate(m, lever)
    rate = (gyro[0] - b[3], gyro[1] - b[4], gyro[2] - b[5])
    sweep = matrix_rotate(m, cross(rate, lever))
    earth_n, _, earth_d = earth.earth_rate_n(lat)
    drag = cross((earth_n, 0.0, earth_d), arm)
    per_north, per_east = earth.metres_per_radian(lat, h)
    north, east, down = earth.position_difference(
        fix_lla[0], fix_lla[1], fix_lla[2], lat + arm[0] / per_north, lon + arm[1] / per_east, h - arm[2]
    )
    residual[0], residual[1], residual[2] = north, east, down
    for i in range(3):
        residual[3 + i] = fix_v[i] - (v_n[i] + sweep[i] - drag[i])
        sensitivity[i, i] = 1.0
        sensitivity[3 + i, 3 + i] = 1.0
    skew_into(sensitivity, 0, 6, arm)
    skew_into(sensitivity, 3, 6, (sweep[0] - drag[0], sweep[1] - drag[1], sweep[2] - drag[2]))
    for j in range(3):
        # A gyro bias error turns the sweep of the arm: C [l x], column by column.
        column = cross(arm, (m[0][j], m[1][j], m[2][j]))
        for i in range(3):
            sensitivity[3 + i, 12 + j] = column[i]


@njit(cache=True)
def skew_into(target, row, column, a):
    """Write -[a x] at (row, column) of ``target``."""
    target[row, column + 1], target[row, column + 2] = a[2], -a[1]
    target[row + 1, column], target[row + 1, column + 2] = -a[2], a[0]
    target[row + 2, column], target[row + 2, column + 1] = a[1], -a[0]


@njit(cache=True)
def correct(lat, lon, h, v_n, q_nb, b, x):
    """Estimate plus ``x`` (15,), which is minus the estimated error; ``b`` (6,) in place."""
    per_north, per_east = earth.metres_per_radian(lat, h)
    q = quat_normalize(quat_multiply(rotvec_to_quat((x[6], x[7], x[8])), q_nb))
    for i in range(6):
        b[i] += x[9 + i]
    v = (v_n[0] + x[3], v_n[1] + x[4], v_n[2] + x[5])
    return lat + x[0] / per_north, lon + x[1] / per_east, h - x[2], v, q


@njit(cache=True)
def reset(p, change_v):
    """Carry P (in place) to the corrected velocity, which `correct` moved by ``change_v``.

    What stays Gaussian while an attitude error of many degrees shrinks is the velocity error without what the attitude
    error makes of the velocity, dv - phi x v (Barrau and Bonnabel, IEEE TAC 2017; python-ins' modified phi-angle
    model). Held fixed over the correction, it lets dv gain phi x ``change_v``.
    """
    for _ in range(2):
        for j in range(N_STATES):
            north, east, down = p[6, j], p[7, j], p[8, j]
            p[3, j] += east * change_v[2] - down * change_v[1]
            p[4, j] += down * change_v[0] - north * change_v[2]
            p[5, j] += north * change_v[1] - east * change_v[0]
        transpose(p)
    symmetrize(p)
