"""Satellites from broadcast ephemerides: position, velocity and clock, and what an antenna sees of them.

IS-GPS-200, tables 20-III and 20-IV; the Galileo OS ICD uses the same algorithm with its own gravitational constant. The
velocity is the analytic derivative. e; m, m/s, rad; times in seconds from the start of the flight.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from testbed.kernels import njit
from testbed.physics.ranging import OMEGA, C, sight

Array = NDArray[np.float64]

MU_GPS = 3.986005e14
MU_GALILEO = 3.986004418e14
"""Gravitational constants of the two systems, m³/s²: confusing them costs a metre after an hour."""
WEEK_S = 604800.0

FIELDS = (
    "toe toe_of_week sqrt_a e i0 omega0 omega m0 delta_n i_dot omega_dot cuc cus crc crs cic cis toc af0 af1 af2 tgd mu"
).split()
"""Columns of an ephemeris: ``toe`` and ``toc`` from the start of the flight, ``toe_of_week`` as broadcast (s); SI, rad."""
(TOE, TOE_OF_WEEK, SQRT_A, ECC, I0, OMEGA0, ARGP, M0, DELTA_N, I_DOT, OMEGA_DOT) = range(11)
(CUC, CUS, CRC, CRS, CIC, CIS, TOC, AF0, AF1, AF2, TGD, MU) = range(11, 23)

LIGHT_TIME = 0.075
"""s, about that of a satellite in mid-sky; the true one is within 20 ms."""


@njit(cache=True)
def orbit(eph, t):
    """Position (m), velocity (m/s) and eccentric anomaly (rad) at time ``t`` of the satellite with ephemeris ``eph``."""
    tk = np.mod(t - eph[TOE] + 0.5 * WEEK_S, WEEK_S) - 0.5 * WEEK_S
    a, e = eph[SQRT_A] * eph[SQRT_A], eph[ECC]
    n = np.sqrt(eph[MU] / (a * a * a)) + eph[DELTA_N]
    m = eph[M0] + n * tk
    ea = m
    for _ in range(8):
        step = (ea - e * np.sin(ea) - m) / (1.0 - e * np.cos(ea))
        ea -= step
        if np.abs(step) < 1e-13:
            break
    se, ce = np.sin(ea), np.cos(ea)
    root = np.sqrt(1.0 - e * e)
    ea_dot = n / (1.0 - e * ce)
    phi = np.arctan2(root * se, ce - e) + eph[ARGP]
    phi_dot = ea_dot * root / (1.0 - e * ce)
    s2, c2 = np.sin(2.0 * phi), np.cos(2.0 * phi)
    u = phi + eph[CUS] * s2 + eph[CUC] * c2
    r = a * (1.0 - e * ce) + eph[CRS] * s2 + eph[CRC] * c2
    i = eph[I0] + eph[I_DOT] * tk + eph[CIS] * s2 + eph[CIC] * c2
    u_dot = phi_dot * (1.0 + 2.0 * (eph[CUS] * c2 - eph[CUC] * s2))
    r_dot = a * e * se * ea_dot + 2.0 * phi_dot * (eph[CRS] * c2 - eph[CRC] * s2)
    i_dot = eph[I_DOT] + 2.0 * phi_dot * (eph[CIS] * c2 - eph[CIC] * s2)
    o_dot = eph[OMEGA_DOT] - OMEGA
    o = eph[OMEGA0] + o_dot * tk - OMEGA * eph[TOE_OF_WEEK]
    su, cu, si, ci, so, co = np.sin(u), np.cos(u), np.sin(i), np.cos(i), np.sin(o), np.cos(o)
    x, y = r * cu, r * su
    x_dot, y_dot = r_dot * cu - y * u_dot, r_dot * su + x * u_dot
    place = (x * co - y * ci * so, x * so + y * ci * co, y * si)
    across = y_dot * ci - y * si * i_dot
    velocity = (
        x_dot * co - across * so - place[1] * o_dot,
        x_dot * so + across * co + place[0] * o_dot,
        y_dot * si + y * ci * i_dot,
    )
    return place, velocity, ea


@njit(cache=True)
def clock(eph, t, ea):
    """Satellite clock error (m) and its rate (m/s) for a user of one frequency: polynomial, relativity, group delay."""
    dt = np.mod(t - eph[TOC] + 0.5 * WEEK_S, WEEK_S) - 0.5 * WEEK_S
    a = eph[SQRT_A] * eph[SQRT_A]
    n = np.sqrt(eph[MU] / (a * a * a)) + eph[DELTA_N]
    factor = -2.0 * np.sqrt(eph[MU]) / (C * C) * eph[ECC] * eph[SQRT_A]
    offset = eph[AF0] + dt * (eph[AF1] + dt * eph[AF2]) + factor * np.sin(ea) - eph[TGD]
    rate = eph[AF1] + 2.0 * dt * eph[AF2] + factor * np.cos(ea) * n / (1.0 - eph[ECC] * np.cos(ea))
    return C * offset, C * rate


@njit(cache=True)
def received(eph, t, r):
    """What an antenna at ``r`` receives at time ``t``: place and velocity of the satellite at transmission in the e of
    reception, the range (m), and the clock (m, m/s).

    One orbit a light time of 75 ms back, then carried over the 20 ms that may be missing by its acceleration, whose
    change in that time is worth a nanometre; the fixed point for the light time gains five digits a round.
    """
    at = t - LIGHT_TIME
    x, v, ea = orbit(eph, at)
    square = x[0] * x[0] + x[1] * x[1] + x[2] * x[2]
    pull = -eph[MU] / (square * np.sqrt(square)) + OMEGA * OMEGA
    acc = (pull * x[0] + 2.0 * OMEGA * v[1], pull * x[1] - 2.0 * OMEGA * v[0], (pull - OMEGA * OMEGA) * x[2])
    tau, distance, place = LIGHT_TIME, 0.0, x
    for _ in range(4):
        place = turned(carried(x, v, acc, LIGHT_TIME - tau), OMEGA * tau)
        distance, _u = sight(place, r)
        tau = distance / C
    rest = LIGHT_TIME - tau
    place = turned(carried(x, v, acc, rest), OMEGA * tau)
    velocity = turned((v[0] + rest * acc[0], v[1] + rest * acc[1], v[2] + rest * acc[2]), OMEGA * tau)
    offset, rate = clock(eph, at, ea)
    return place, velocity, distance, (offset + rate * rest, rate)


@njit(cache=True)
def carried(x, v, acc, dt):
    """Position after ``dt`` at constant acceleration."""
    half = 0.5 * dt
    return (
        x[0] + dt * (v[0] + half * acc[0]),
        x[1] + dt * (v[1] + half * acc[1]),
        x[2] + dt * (v[2] + half * acc[2]),
    )


@njit(cache=True)
def turned(x, angle):
    """Coordinates of ``x`` after e has turned by ``angle`` (rad)."""
    s, c = np.sin(angle), np.cos(angle)
    return c * x[0] + s * x[1], c * x[1] - s * x[0], x[2]
