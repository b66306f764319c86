"""Kernels of the attitude filters `ahrs-kf` and `ahrs-lstm`: a 12-state indirect filter on gravity and magnetic field.

Error states, all in b: attitude (3, rad), gyro bias (3), linear acceleration (3), magnetic disturbance (3), each "true
minus estimate". z = [g_accel - g_gyro; m_mag - m_gyro] (6) after the AHRS paper (2022). SI units, fields in µT.

``state`` is [q_nb (4), gyro bias, linear acceleration, magnetic disturbance]; ``model`` (14) is `MODEL`'s columns. The
gain is kept transposed, (6,12), so that every inner loop runs over twelve contiguous numbers.
"""

from __future__ import annotations

import numpy as np
from numba import njit

from testbed.rotations import quat_multiply, quat_normalize, quat_to_matrix, rotvec_to_quat

MODEL = (
    "gyro_variance",  # (rad/s)², per sample
    "bias_variance",  # (rad/s)², grown per sample
    "accel_growth",  # (m/s²)²
    "mag_growth",  # µT²
    "accel_variance",  # (m/s²)², of one sample
    "mag_variance",  # µT²
    "bias_decay",
    "accel_decay",
    "mag_decay",
    "interval",  # s
    "gravity",  # m/s²
    "turn_inflation",  # variance of new linear acceleration across the speed per (rad/s)² of turn; 0: none
    "residual_inflation",  # the same along x per (m/s²)² that is seen of it; 0: none
    "averaging",  # weight of a new sample in the means of both
)


@njit(cache=True)
def predict(state, p, gyro, model):
    """Turn the attitude by one gyro sample, let the disturbances decay, and carry the covariance along."""
    dt, fb, fa, fd = model[9], model[6], model[7], model[8]
    turn = ((gyro[0] - state[4]) * dt, (gyro[1] - state[5]) * dt, (gyro[2] - state[6]) * dt)
    dq = rotvec_to_quat(turn)
    q = quat_normalize(quat_multiply((state[0], state[1], state[2], state[3]), dq))
    for i in range(4):
        state[i] = q[i]
    for i in range(3):
        state[7 + i] *= fa
        state[10 + i] *= fd
    (a00, a10, a20), (a01, a11, a21), (a02, a12, a22) = quat_to_matrix(dq)  # A is its transpose: old b into new b
    for j in range(12):  # attitude rows of Phi P
        x, y, z = p[0, j], p[1, j], p[2, j]
        p[0, j] = a00 * x + a01 * y + a02 * z - dt * p[3, j]
        p[1, j] = a10 * x + a11 * y + a12 * z - dt * p[4, j]
        p[2, j] = a20 * x + a21 * y + a22 * z - dt * p[5, j]
    for i in range(3):  # their attitude columns times Phi transposed
        x, y, z = p[i, 0], p[i, 1], p[i, 2]
        p[i, 0] = a00 * x + a01 * y + a02 * z - dt * p[i, 3]
        p[i, 1] = a10 * x + a11 * y + a12 * z - dt * p[i, 4]
        p[i, 2] = a20 * x + a21 * y + a22 * z - dt * p[i, 5]
    for i in range(3):
        for j in range(i):
            p[i, j] = p[j, i] = 0.5 * (p[i, j] + p[j, i])
    for i in range(12):
        f = 1.0 if i < 3 else (fb if i < 6 else (fa if i < 9 else fd))
        for j in range(3, 6):
            p[i, j] *= f * fb
        for j in range(6, 9):
            p[i, j] *= f * fa
        for j in range(9, 12):
            p[i, j] *= f * fd
    for i in range(3):
        for j in range(3, 12):
            p[j, i] = p[i, j]
        p[i, i] += model[0] * dt * dt
        p[3 + i, 3 + i] += model[1]
        p[6 + i, 6 + i] += model[2]
        p[9 + i, 9 + i] += model[3]


@njit(cache=True)
def observe(state, accel, mag, has_mag, field_n, model, z, seen):
    """z (6), and into ``seen`` (6) the gravity and field that the attitude predicts in b."""
    m = quat_to_matrix((state[0], state[1], state[2], state[3]))
    for i in range(3):
        seen[i] = m[2][i] * model[10]
        z[i] = state[7 + i] - accel[i] - seen[i]
        if has_mag:
            seen[3 + i] = m[0][i] * field_n[0] + m[1][i] * field_n[1] + m[2][i] * field_n[2]
            z[3 + i] = mag[i] - state[10 + i] - seen[3 + i]
        else:
            seen[3 + i] = 0.0
            z[3 + i] = 0.0


@njit(cache=True)
def inflate(p, gyro, accel, state, seen, model, slow):
    """Raise the variance of linear acceleration, axis by axis, by what shows that there is some: turns and residuals.

    In a turn at speed V along x there is V w_z along y and V w_y along z. Along x the residual of the accelerometer tells,
    where it is larger than the filter's doubt about its attitude explains (Suh 2010, doi:10.1109/TIM.2010.2047157).
    ``slow`` (3) keeps the means of that residual (m/s²), w_y and w_z (rad/s): the square of a mean leaves noise out.
    """
    slow[0] += model[13] * (-accel[0] - seen[0] - slow[0])
    slow[1] += model[13] * (gyro[1] - state[5] - slow[1])
    slow[2] += model[13] * (gyro[2] - state[6] - slow[2])
    doubt = seen[2] ** 2 * p[1, 1] + seen[1] ** 2 * p[2, 2] - 2.0 * seen[1] * seen[2] * p[1, 2]
    p[6, 6] += model[12] * max(0.0, slow[0] ** 2 - doubt)
    p[7, 7] += model[11] * slow[2] ** 2
    p[8, 8] += model[11] * slow[1] ** 2


@njit(cache=True)
def kalman_gain(p, seen, has_mag, model, s, y, k):
    """Gain (transposed, (6,12)) into ``k``, innovation covariance into ``s``; ``p`` becomes the updated covariance.

    H = [[g×], 0, -I, 0; [m×], 0, 0, I]; without a magnetometer sample its three rows are zero. With S = L Lᵀ and
    Y = P Hᵀ L⁻ᵀ the update P - Y Yᵀ is symmetric by construction.
    """
    sign_d = 1.0 if has_mag else 0.0
    for i in range(12):
        x0, x1, x2 = p[0, i], p[1, i], p[2, i]
        y[0, i] = seen[1] * x2 - seen[2] * x1 - p[6, i]
        y[1, i] = seen[2] * x0 - seen[0] * x2 - p[7, i]
        y[2, i] = seen[0] * x1 - seen[1] * x0 - p[8, i]
        y[3, i] = seen[4] * x2 - seen[5] * x1 + sign_d * p[9, i]
        y[4, i] = seen[5] * x0 - seen[3] * x2 + sign_d * p[10, i]
        y[5, i] = seen[3] * x1 - seen[4] * x0 + sign_d * p[11, i]
    for c in range(6):
        x0, x1, x2 = y[c, 0], y[c, 1], y[c, 2]
        s[c, 0] = seen[1] * x2 - seen[2] * x1 - y[c, 6]
        s[c, 1] = seen[2] * x0 - seen[0] * x2 - y[c, 7]
        s[c, 2] = seen[0] * x1 - seen[1] * x0 - y[c, 8]
        s[c, 3] = seen[4] * x2 - seen[5] * x1 + sign_d * y[c, 9]
        s[c, 4] = seen[5] * x0 - seen[3] * x2 + sign_d * y[c, 10]
        s[c, 5] = seen[3] * x1 - seen[4] * x0 + sign_d * y[c, 11]
        s[c, c] += model[4] if c < 3 else model[5]
    chol = np.empty((6, 6))
    for c in range(6):
        for r in range(c, 6):
            total = s[r, c]
            for i in range(c):
                total -= chol[r, i] * chol[c, i]
            chol[r, c] = np.sqrt(total) if r == c else total / chol[c, c]
    for c in range(6):
        for j in range(c):
            f = chol[c, j]
            for i in range(12):
                y[c, i] -= f * y[j, i]
        f = 1.0 / chol[c, c]
        for i in range(12):
            y[c, i] *= f
    for c in range(5, -1, -1):
        for i in range(12):
            k[c, i] = y[c, i]
        for j in range(c + 1, 6):
            f = chol[j, c]
            for i in range(12):
                k[c, i] -= f * k[j, i]
        f = 1.0 / chol[c, c]
        for i in range(12):
            k[c, i] *= f
    for i in range(12):
        for c in range(6):
            f = y[c, i]
            for j in range(12):
                p[i, j] -= f * y[c, j]


@njit(cache=True)
def weigh(k, z, x):
    """x (12) = K z."""
    for i in range(12):
        x[i] = 0.0
    for c in range(6):
        for i in range(12):
            x[i] += k[c, i] * z[c]


@njit(cache=True)
def correct(state, x):
    """Apply the estimated error to the state."""
    dq = rotvec_to_quat((x[0], x[1], x[2]))
    q = quat_normalize(quat_multiply((state[0], state[1], state[2], state[3]), dq))
    for i in range(4):
        state[i] = q[i]
    for i in range(9):
        state[4 + i] += x[3 + i]


@njit(cache=True)
def attitude_std_n(state, p, out):
    """1 sigma of the attitude error about north, east and down into ``out`` (3)."""
    m = quat_to_matrix((state[0], state[1], state[2], state[3]))
    for i in range(3):
        a, b, c = m[i][0], m[i][1], m[i][2]
        total = a * a * p[0, 0] + b * b * p[1, 1] + c * c * p[2, 2]
        total += 2.0 * (a * b * p[0, 1] + a * c * p[0, 2] + b * c * p[1, 2])
        out[i] = np.sqrt(total)


@njit(cache=True)
def filter_log(gyro, accel, mag, mag_row, field_n, model, state, p, stride, states, std, snapshot, z_kept, s_kept):
    """Run the filter over N samples; ``state`` and ``p`` are its start and are overwritten.

    ``mag_row`` (N,) is the row of ``mag`` that arrives with a sample, or -1. Out: ``states`` (N,13), ``std`` (N,3)
    attitude in n; every ``stride``-th sample ``snapshot`` (M,12,12), ``z_kept`` (M,6), ``s_kept`` (M,6,6).
    """
    z, seen, x, slow = np.zeros(6), np.zeros(6), np.zeros(12), np.zeros(3)
    s, y, k = np.zeros((6, 6)), np.zeros((6, 12)), np.zeros((6, 12))
    for n in range(len(gyro)):
        has_mag = mag_row[n] >= 0
        predict(state, p, gyro[n], model)
        observe(state, accel[n], mag[max(mag_row[n], 0)], has_mag, field_n, model, z, seen)
        inflate(p, gyro[n], accel[n], state, seen, model, slow)
        kalman_gain(p, seen, has_mag, model, s, y, k)
        weigh(k, z, x)
        correct(state, x)
        for i in range(13):
            states[n, i] = state[i]
        attitude_std_n(state, p, std[n])
        if (n + 1) % stride == 0:
            keep(n // stride, p, z, s, has_mag, snapshot, z_kept, s_kept)


@njit(cache=True)
def keep(row, p, z, s, has_mag, snapshot, z_kept, s_kept):
    """Store one snapshot; channels without a measurement are marked by NaN."""
    snapshot[row] = p
    for i in range(6):
        z_kept[row, i] = z[i] if i < 3 or has_mag else np.nan
        for j in range(6):
            s_kept[row, i, j] = s[i, j]
