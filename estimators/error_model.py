"""The 15-state INS error model (phi-angle form) and its discrete propagation of a covariance.

Groves, 2nd ed., section 14.2.4, with position errors in metres. States as `testbed.records.STATE_NAMES`, estimate minus
truth: position, velocity and attitude (C_est = exp([phi x]) C_true) in n, accelerometer and gyro bias in b. SI units.
"""

from __future__ import annotations

import numpy as np
from numba import njit

from testbed import earth
from testbed.rotations import quat_to_matrix

N_STATES = 15


@njit(cache=True)
def coefficients(lat, h, v_n):
    """What the Earth puts into the error equations at (lat, h, v_n): curvatures, rates and gravity gradient.

    Returns (1/(R_M+h), 1/(R_E+h), tan lat, w_ie north, w_ie down, w_en north, w_en east, w_en down, dg/dh).
    """
    rm, rn = earth.principal_radii(lat)
    per_north, per_east = 1.0 / (rm + h), 1.0 / (rn + h)
    sine, cosine = np.sin(lat), np.cos(lat)
    tangent = sine / cosine
    rate_n = v_n[1] * per_east
    gradient = 2.0 * earth.GRAVITY_EQUATOR / earth.A
    return (
        per_north,
        per_east,
        tangent,
        earth.RATE * cosine,
        -earth.RATE * sine,
        rate_n,
        -v_n[0] * per_north,
        -rate_n * tangent,
        gradient,
    )


@njit(cache=True)
def apply_transition(source, target, c, m, force, v_n, keep_accel, keep_gyro, dt):
    """``target`` = Phi @ ``source`` for (15,15) arrays, one column at a time.

    ``c`` from `coefficients`, ``m`` = C_nb, ``force`` mean specific force in n, ``keep_`` = exp(-dt/tau) of the biases.
    Attitude goes first, velocity uses the mean attitude error and position the mean velocity error of the step, so Phi
    is right to second order in dt without its square ever being formed.
    """
    per_n, per_e, tangent, ie_n, ie_d, en_n, en_e, en_d, gradient = c
    in_n, in_e, in_d = ie_n + en_n, en_e, ie_d + en_d
    co_n, co_e, co_d = in_n + ie_n, in_e, in_d + ie_d
    f_n, f_e, f_d = force
    vn, ve, vd = v_n[0], v_n[1], v_n[2]
    m00, m01, m02 = m[0]
    m10, m11, m12 = m[1]
    m20, m21, m22 = m[2]
    half = 0.5 * dt
    for j in range(source.shape[1]):
        rn, re, rd = source[0, j], source[1, j], source[2, j]
        un, ue, ud = source[3, j], source[4, j], source[5, j]
        pn, pe, pd = source[6, j], source[7, j], source[8, j]
        ax, ay, az = source[9, j], source[10, j], source[11, j]
        gx, gy, gz = source[12, j], source[13, j], source[14, j]

        lat_error = rn * per_n
        # Errors of w_en and w_ie that the position and velocity errors make (height error is -rd).
        dn = ue * per_e + en_n * rd * per_e
        de = -un * per_n + en_e * rd * per_n
        dd = -dn * tangent - en_n * (1.0 + tangent * tangent) * lat_error
        wn, wd = ie_d * lat_error, -ie_n * lat_error

        an = pn + dt * (in_d * pe - in_e * pd - dn - wn - (m00 * gx + m01 * gy + m02 * gz))
        ae = pe + dt * (in_n * pd - in_d * pn - de - (m10 * gx + m11 * gy + m12 * gz))
        ad = pd + dt * (in_e * pn - in_n * pe - dd - wd - (m20 * gx + m21 * gy + m22 * gz))
        hn, he, hd = 0.5 * (pn + an), 0.5 * (pe + ae), 0.5 * (pd + ad)

        kn, ke, kd = dn + 2.0 * wn, de, dd + 2.0 * wd
        bn = un + dt * (
            f_d * he - f_e * hd - (m00 * ax + m01 * ay + m02 * az) - (co_e * ud - co_d * ue) - (ke * vd - kd * ve)
        )
        be = ue + dt * (
            f_n * hd - f_d * hn - (m10 * ax + m11 * ay + m12 * az) - (co_d * un - co_n * ud) - (kd * vn - kn * vd)
        )
        bd = ud + dt * (
            f_e * hn
            - f_n * he
            - (m20 * ax + m21 * ay + m22 * az)
            - (co_n * ue - co_e * un)
            - (kn * ve - ke * vn)
            + gradient * rd
        )

        target[0, j] = rn + half * (un + bn) + dt * per_n * (vn * rd - vd * rn)
        target[1, j] = re + half * (ue + be) + dt * per_e * (ve * rd + ve * tangent * rn - (vd + vn * tangent) * re)
        target[2, j] = rd + half * (ud + bd)
        target[3, j], target[4, j], target[5, j] = bn, be, bd
        target[6, j], target[7, j], target[8, j] = an, ae, ad
        target[9, j], target[10, j], target[11, j] = keep_accel * ax, keep_accel * ay, keep_accel * az
        target[12, j], target[13, j], target[14, j] = keep_gyro * gx, keep_gyro * gy, keep_gyro * gz


@njit(cache=True)
def propagate(p, work, c, m, force, v_n, keep_accel, keep_gyro, q, dt):
    """P = Phi P Phi' + Q in place, ``work`` (15,15) scratch. ``q`` (12,): spectral densities, see `add_noise`."""
    apply_transition(p, work, c, m, force, v_n, keep_accel, keep_gyro, dt)
    transpose(work)
    apply_transition(work, p, c, m, force, v_n, keep_accel, keep_gyro, dt)
    add_noise(p, m, q, dt)
    symmetrize(p)


@njit(cache=True)
def add_noise(p, m, q, dt):
    """Add the noise of one step of ``dt``, ``m`` = C_nb.

    ``q`` (12,): spectral densities along b of accelerometer noise ((m/s²)²/Hz), gyro noise ((rad/s)²/Hz), and of the
    noise that drives accelerometer ((m/s³)²/Hz) and gyro bias ((rad/s²)²/Hz). Velocity noise reaches the position
    within the step (van Loan to third order); all other cross terms are below dt² of what they join.
    """
    for i in range(3):
        for j in range(i, 3):
            accel = (m[i][0] * m[j][0] * q[0] + m[i][1] * m[j][1] * q[1] + m[i][2] * m[j][2] * q[2]) * dt
            gyro = (m[i][0] * m[j][0] * q[3] + m[i][1] * m[j][1] * q[4] + m[i][2] * m[j][2] * q[5]) * dt
            p[i, j] += accel * dt * dt / 3.0
            p[i, 3 + j] += 0.5 * accel * dt
            if i != j:
                p[j, 3 + i] += 0.5 * accel * dt
            p[3 + i, 3 + j] += accel
            p[6 + i, 6 + j] += gyro
    for i in range(6):
        p[9 + i, 9 + i] += q[6 + i] * dt


@njit(cache=True)
def transpose(p):
    """Transpose a (15,15) array in place."""
    for i in range(1, N_STATES):
        for j in range(i):
            p[i, j], p[j, i] = p[j, i], p[i, j]


@njit(cache=True)
def symmetrize(p):
    """Copy the upper triangle of P onto the lower one."""
    for i in range(1, N_STATES):
        for j in range(i):
            p[i, j] = p[j, i]


@njit(cache=True)
def transition_matrix(lat, h, v_n, q_nb, force, keep_accel, keep_gyro, dt):
    """Phi (15,15) of one step as a dense matrix: for tests and for filters that want it so."""
    phi = np.empty((N_STATES, N_STATES))
    c = coefficients(lat, h, v_n)
    apply_transition(np.eye(N_STATES), phi, c, quat_to_matrix(q_nb), force, v_n, keep_accel, keep_gyro, dt)
    return phi
