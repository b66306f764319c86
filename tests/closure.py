"""Perfect increments through strapdowns: this project's, and python-ins' integrator on the same increments."""

from __future__ import annotations

import numpy as np

from estimators.core.strapdown import compensate, coning_sculling, integrate
from testbed.physics import earth
from testbed.physics.rotations import quat_rotate_inverse, quats_to_eulers


def strapdown_errors(truth):
    """North, east and down errors (3,N-1) in m of the strapdown over the true increments from the true initial state."""
    lla, v, q = (np.empty((len(truth.t) - 1, n)) for n in (3, 3, 4))
    start = truth.lat[0], truth.lon[0], truth.h[0], truth.v_n[0], truth.q_nb[0]
    integrate(truth.t[0], truth.t[1:], truth.w_ib_b[1:], truth.f_b[1:], *start, np.zeros(3), np.zeros(3), lla, v, q)
    return _errors(truth, *lla.T)


def python_ins_errors(truth):
    """The same through python-ins' integrator.

    Its gravity stops at first order in height: it is given the difference along the truth.
    """
    import pandas as pd
    from pyins import _numba_integrate, strapdown

    rows, zero = [], (0.0, 0.0, 0.0)
    before = (zero, zero)
    for k, dt in enumerate(np.diff(truth.t)):
        h = 0.5 * (truth.h[k] + truth.h[k + 1])
        lacks = earth.gravity(truth.lat[k], h) - _numba_integrate.gravity(np.degrees(truth.lat[k]), h)
        angle, dv = tuple(truth.w_ib_b[k + 1] * dt), tuple(truth.f_b[k + 1] * dt)
        rotation, change = compensate(angle, dv, *coning_sculling(angle, dv, *before))
        change = np.array(change) + np.array(quat_rotate_inverse(truth.q_nb[k], (0.0, 0.0, lacks))) * dt
        rows.append([dt, *rotation, *change])
        before = (angle, dv)
    names = ["dt", "theta_x", "theta_y", "theta_z", "dv_x", "dv_y", "dv_z"]
    start = [np.degrees(truth.lat[0]), np.degrees(truth.lon[0]), truth.h[0], *truth.v_n[0]]
    start += list(np.degrees(quats_to_eulers(truth.q_nb[:1])[0]))
    pva = pd.Series(start, index=["lat", "lon", "alt", "VN", "VE", "VD", "roll", "pitch", "heading"], name=truth.t[0])
    increments = pd.DataFrame(rows, index=truth.t[1:], columns=names)
    flown = strapdown.Integrator(pva).integrate(increments).iloc[1:]
    return _errors(truth, np.radians(flown.lat.to_numpy()), np.radians(flown.lon.to_numpy()), flown.alt.to_numpy())


def _errors(truth, lat, lon, h):
    return np.array(earth.position_difference(lat, lon, h, truth.lat[1:], truth.lon[1:], truth.h[1:]))
