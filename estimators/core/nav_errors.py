"""The error model of inertial navigation, once: nine numbers in, nine out. A number is a float64 or a lane.

Groves, 2nd ed., section 14.2.4 (phi-angle form), with position errors in metres. Errors are estimate minus truth, position,
velocity and attitude (C_est = exp([phi x]) C_true) in n. SI units and radians. Kernels only.
"""

from __future__ import annotations

import numpy as np

from testbed.kernels import njit
from testbed.physics import earth


@njit(cache=True, nogil=True, _nrt=False)
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


@njit(cache=True, nogil=True, _nrt=False, forceinline=True)
def nav_errors(errors, gyro, accel, motion, dt):
    """Position, velocity and attitude errors (three triples) a step of ``dt`` later.

    ``errors`` = the three triples before it; ``gyro`` and ``accel`` the errors of angular rate and specific force in n that
    the sensors add; ``motion`` = (what `coefficients` gives, mean specific force in n, velocity in n at the step's start).
    Attitude goes first, velocity uses the mean attitude error and position the mean velocity error of the step, so the
    transition is right to second order in dt without its square ever being formed.
    """
    r, u, p = errors
    (per_n, per_e, tangent, ie_n, ie_d, en_n, en_e, en_d, gradient), f, v = motion
    in_n, in_e, in_d = ie_n + en_n, en_e, ie_d + en_d
    co_n, co_e, co_d = in_n + ie_n, in_e, in_d + ie_d
    half = 0.5 * dt

    # Errors of w_en and w_ie that the position and velocity errors make (height error is -r[2]).
    lat_error = r[0] * per_n
    dn = u[1] * per_e + (en_n * per_e) * r[2]
    de = (en_e * per_n) * r[2] - u[0] * per_n
    dd = -(dn * tangent) - (en_n * (1.0 + tangent * tangent)) * lat_error
    wn, wd = ie_d * lat_error, (-ie_n) * lat_error

    an = p[0] + dt * (in_d * p[1] - in_e * p[2] - dn - wn - gyro[0])
    ae = p[1] + dt * (in_n * p[2] - in_d * p[0] - de - gyro[1])
    ad = p[2] + dt * (in_e * p[0] - in_n * p[1] - dd - wd - gyro[2])
    hn, he, hd = 0.5 * (p[0] + an), 0.5 * (p[1] + ae), 0.5 * (p[2] + ad)

    kn, ke, kd = dn + 2.0 * wn, de, dd + 2.0 * wd
    bn = f[2] * he - f[1] * hd - accel[0] - (co_e * u[2] - co_d * u[1]) - (v[2] * ke - v[1] * kd)
    be = f[0] * hd - f[2] * hn - accel[1] - (co_d * u[0] - co_n * u[2]) - (v[0] * kd - v[2] * kn)
    bd = f[1] * hn - f[0] * he - accel[2] - (co_n * u[1] - co_e * u[0]) - (v[1] * kn - v[0] * ke) + gradient * r[2]
    bn, be, bd = u[0] + dt * bn, u[1] + dt * be, u[2] + dt * bd

    cn = r[0] + half * (u[0] + bn) + (dt * per_n) * (v[0] * r[2] - v[2] * r[0])
    curve = v[1] * r[2] + (v[1] * tangent) * r[0] - (v[2] + v[0] * tangent) * r[1]
    ce = r[1] + half * (u[1] + be) + (dt * per_e) * curve
    return (cn, ce, r[2] + half * (u[2] + bd)), (bn, be, bd), (an, ae, ad)
