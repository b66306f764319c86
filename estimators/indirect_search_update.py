"""The position and velocity fix of `indirect_kernel` for one candidate per lane, and what it says of their likelihood.

Kernels only; Bierman's sequential scalars in Joseph form as `kalman.update`, on the columns that a measurement touches. SI
units and radians; P as a table (225,WIDTH) of which the upper triangle counts.
"""

from __future__ import annotations

import numpy as np
from numba import njit

from estimators.core.lanes import WIDTH, floor, load, splat, store
from estimators.error_model import N_STATES
from estimators.indirect_kernel import MEASUREMENTS, correct
from testbed import earth
from testbed.rotations import cross, matrix_rotate, quat_to_matrix

TOUCHED = 7
"""A measurement's own state, three of attitude, three of gyro bias."""
RESIDUAL, SENSITIVITY = 0, 6
GAIN, PRODUCT, BRACKET, DONE = 48, 63, 78, 93
LEFT, SPREAD = 108, 114
"""Rows of the scratch table: innovation and sensitivity of each measurement, then work, then scaled innovations."""


@njit(cache=True, nogil=True)
def update_lanes(s, p, scratch, gyro, lever, fix_lla, fix_v, variance, fix, deviance):
    """Correct state ``s`` (16,WIDTH) and ``p`` by one fix; add log det S + nu' S^-1 nu to ``deviance`` (WIDTH,)."""
    measure_lanes(s, scratch, gyro, lever, fix_lla, fix_v)
    for i in range(N_STATES):
        store(scratch, DONE + i, splat(0.0))
    for a in range(MEASUREMENTS):
        scalar_update(p, scratch, a, load(variance, MEASUREMENTS * fix + a))
    for lane in range(WIDTH):
        for a in range(MEASUREMENTS):
            spread = scratch[SPREAD + a, lane]
            # An S that is not positive definite has no likelihood.
            deviance[lane] += np.log(spread) + scratch[LEFT + a, lane] ** 2 / spread if spread > 0.0 else np.inf
    correct_lanes(s, scratch)
    reset_lanes(p, scratch)


@njit(cache=True, nogil=True)
def measure_lanes(s, scratch, gyro, lever, fix_lla, fix_v):
    """`indirect_kernel.measure`: innovation, and per measurement the sensitivity to its own state, attitude, gyro bias."""
    lat, lon, h = load(s, 0), load(s, 1), load(s, 2)
    m = quat_to_matrix((load(s, 6), load(s, 7), load(s, 8), load(s, 9)))
    arm = matrix_rotate(m, lever)
    rate = (gyro[0] - load(s, 13), gyro[1] - load(s, 14), gyro[2] - load(s, 15))
    sweep = matrix_rotate(m, cross(rate, lever))
    drag = cross((earth.RATE * np.cos(lat), splat(0.0), -earth.RATE * np.sin(lat)), arm)
    moving = (sweep[0] - drag[0], sweep[1] - drag[1], sweep[2] - drag[2])
    per_north, per_east = earth.metres_per_radian(lat, h)
    place = (lat + arm[0] / per_north, lon + arm[1] / per_east, h - arm[2])
    here_north, here_east = earth.metres_per_radian(place[0], place[2])
    store(scratch, RESIDUAL, (fix_lla[0] - place[0]) * here_north)
    store(scratch, RESIDUAL + 1, wrapped(fix_lla[1] - place[1]) * here_east)
    store(scratch, RESIDUAL + 2, place[2] - fix_lla[2])
    for i in range(3):
        store(scratch, RESIDUAL + 3 + i, fix_v[i] - (load(s, 3 + i) + moving[i]))
    skew_rows(scratch, SENSITIVITY, arm)
    skew_rows(scratch, SENSITIVITY + 3 * TOUCHED, moving)
    for j in range(3):
        column = cross(arm, (m[0][j], m[1][j], m[2][j]))
        for i in range(3):
            store(scratch, SENSITIVITY + i * TOUCHED + 4 + j, splat(0.0))
            store(scratch, SENSITIVITY + (3 + i) * TOUCHED + 4 + j, column[i])


@njit(cache=True, nogil=True)
def wrapped(angle):
    """Angle into [-pi, pi)."""
    turns = (angle + np.pi) * (1.0 / (2.0 * np.pi))
    return (turns - floor(turns)) * (2.0 * np.pi) - np.pi


@njit(cache=True, nogil=True)
def skew_rows(scratch, first, a):
    """Own state 1, attitude -[a x], for three measurements."""
    zero, one = splat(0.0), splat(1.0)
    rows = ((one, zero, a[2], -a[1]), (one, -a[2], zero, a[0]), (one, a[1], -a[0], zero))
    for i in range(3):
        for j in range(4):
            store(scratch, first + i * TOUCHED + j, rows[i][j])


@njit(cache=True, nogil=True, forceinline=True)
def touched(a, n):
    """State of the n-th sensitivity of measurement ``a``: its own, attitude, gyro bias."""
    return a if n == 0 else 5 + n if n < 4 else 8 + n


@njit(cache=True, nogil=True, forceinline=True)
def entry(i, j):
    """Row of P(i,j) in the table, in the upper triangle."""
    return N_STATES * i + j if i <= j else N_STATES * j + i


@njit(cache=True, nogil=True)
def scalar_update(p, scratch, a, variance):
    """One scalar measurement of `kalman.update`."""
    count = 4 if a < 3 else TOUCHED
    first = SENSITIVITY + a * TOUCHED
    for i in range(N_STATES):
        total = splat(0.0)
        for n in range(count):
            total = total + load(p, entry(i, touched(a, n))) * load(scratch, first + n)
        store(scratch, PRODUCT + i, total)
    spread, left = variance, load(scratch, RESIDUAL + a)
    for n in range(count):
        spread = spread + load(scratch, first + n) * load(scratch, PRODUCT + touched(a, n))
        left = left - load(scratch, first + n) * load(scratch, DONE + touched(a, n))
    store(scratch, SPREAD + a, spread)
    store(scratch, LEFT + a, left)
    for i in range(N_STATES):
        gain = load(scratch, PRODUCT + i) / spread
        store(scratch, GAIN + i, gain)
        store(scratch, DONE + i, load(scratch, DONE + i) + gain * left)
    for i in range(N_STATES):
        gain, total = load(scratch, GAIN + i), splat(0.0)
        for n in range(count):
            j = touched(a, n)
            reduced = load(p, entry(i, j)) - gain * load(scratch, PRODUCT + j)
            total = total + reduced * load(scratch, first + n)
        store(scratch, BRACKET + i, variance * gain - total)
    for i in range(N_STATES):
        gain = load(scratch, GAIN + i)
        for j in range(i, N_STATES):
            reduced = load(p, N_STATES * i + j) - load(scratch, GAIN + j) * load(scratch, PRODUCT + i)
            store(p, N_STATES * i + j, reduced + load(scratch, BRACKET + j) * gain)


@njit(cache=True, nogil=True)
def correct_lanes(s, scratch):
    """`indirect_kernel.correct` of each lane's state by its ``DONE``."""
    bias, x = np.empty(6), np.empty(N_STATES)
    for lane in range(WIDTH):
        for i in range(N_STATES):
            x[i] = scratch[DONE + i, lane]
        for i in range(6):
            bias[i] = s[10 + i, lane]
        v, q = (s[3, lane], s[4, lane], s[5, lane]), (s[6, lane], s[7, lane], s[8, lane], s[9, lane])
        s[0, lane], s[1, lane], s[2, lane], v, q = correct(s[0, lane], s[1, lane], s[2, lane], v, q, bias, x)
        for i in range(3):
            s[3 + i, lane] = v[i]
        for i in range(4):
            s[6 + i, lane] = q[i]
        for i in range(6):
            s[10 + i, lane] = bias[i]


@njit(cache=True, nogil=True)
def reset_lanes(p, scratch):
    """`indirect_kernel.reset` by the corrected velocity, on the upper triangle."""
    change = (load(scratch, DONE + 3), load(scratch, DONE + 4), load(scratch, DONE + 5))
    turned = GAIN
    for j in range(N_STATES):
        gained = cross((load(p, entry(6, j)), load(p, entry(7, j)), load(p, entry(8, j))), change)
        for i in range(3):
            store(scratch, turned + 3 * j + i, load(p, entry(3 + i, j)) + gained[i])
    for j in range(N_STATES):
        if j < 3 or j > 5:
            for i in range(3):
                store(p, entry(3 + i, j), load(scratch, turned + 3 * j + i))
    for i in range(3):
        tilt = (load(scratch, turned + 18 + i), load(scratch, turned + 21 + i), load(scratch, turned + 24 + i))
        gained = cross(tilt, change)
        for j in range(i, 3):
            store(p, N_STATES * (3 + i) + 3 + j, load(scratch, turned + 9 + 3 * j + i) + gained[j])
