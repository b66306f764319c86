"""Kernels of the open-loop 9-state Kalman filter on the common time line: its error matrix, and steps along a free INS.

Equations: Titterton & Weston, *Strapdown Inertial Navigation Technology*, 2nd ed., eq. 12.28, spherical Earth of radius R.
States: attitude error psi (C_ins = (I - [psi x]) C, rad), velocity error NED (m/s), then R dlat, R dlon (m, the scaled
radians) and dh (m). SI units and radians; INS minus truth.

Time line, update and recording are those of `estimators.core`. The propagation is not: the paper's filter is linear along
an INS that nobody corrects, on a sphere, with I + a dt, and its x grows where the filter from parts always begins at zero.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from estimators.core.recording import Recording, note_sample, note_update
from estimators.core.timeline import inner, steps
from estimators.core.update import innovation_covariance, update
from testbed.kernels import njit
from testbed.physics import earth
from testbed.physics.rotations import quat_multiply, quat_normalize, quat_rotate, rotvec_to_quat

Array = NDArray[np.float64]

N_STATES = 9
N_ROWS = 6
"""Measurement rows: velocity NED, then R dlat, R dlon and dh."""
PLAIN = 1.0
"""What the recording calls an update that no policy changes."""


class FreeRows(NamedTuple):
    """The uncorrected INS; row 0 is its start, row k + 1 the end of IMU sample k."""

    accel: Array
    """(N,3) specific force in b, m/s², mean over the intervals."""
    lla: Array
    """(N+1,3) rad, rad, m."""
    velocity: Array
    """(N+1,3) NED, m/s."""
    quaternion: Array
    """(N+1,4) q_nb."""


class Differences(NamedTuple):
    """Measurements INS minus GNSS."""

    z: Array
    """(M,6)"""
    r: Array
    """(M,6) noise variances."""
    first: NDArray[np.int64]
    """(M,) the rows from here on are used: 0 all, 3 the position, 6 none."""


class Work(NamedTuple):
    """Arrays that are overwritten in every step."""

    a: Array
    """(9,9) error matrix of the present sample."""
    product: Array
    """(9,9)"""
    sum: Array
    """(9,)"""
    residual: Array
    """(6,)"""
    s: Array
    """(36,) innovation covariance, of as many rows as are used."""
    h: Array
    """(6,9)"""
    scalars: Array
    """(6,2) see `update`."""
    scratch: Array
    """(4,9)"""


class ErrorFilter(NamedTuple):
    """The filter of the INS's errors, for `estimators.core.timeline.walk`."""

    ins: FreeRows
    events: Differences
    noise: Array
    """(2,) Q's diagonal for accelerometers and gyros, equal on the three axes, so that C drops out of G Q G'."""
    radius: float
    state: Array
    """(9,) the estimated errors, overwritten."""
    p: Array
    """(9,9), overwritten."""
    work: Work
    keep: Recording


def make_filter(
    ins: FreeRows, events: Differences, noise: Array, radius: float, p: Array, keep: Recording
) -> ErrorFilter:
    """The filter at its start, where it knows of no error; ``p`` (9,9) initial covariance, overwritten."""
    h = np.zeros((N_ROWS, N_STATES))
    h[:, 3:] = np.eye(N_ROWS)
    n, m = N_STATES, N_ROWS
    work = Work(
        a=np.zeros((n, n)),
        product=np.zeros((n, n)),
        sum=np.zeros(n),
        residual=np.zeros(m),
        s=np.zeros(m * m),
        h=h,
        scalars=np.zeros((m, 2)),
        scratch=np.zeros((4, n)),
    )
    return ErrorFilter(ins, events, noise, radius, np.zeros(n), p, work, keep)


@njit(cache=True, nogil=True, _nrt=False)
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


@inner
def begin(model, k, whole):
    """Error matrix of IMU sample ``k``, at the INS's place when it opens and with the mean of its force over the sample."""
    ins = model.ins
    force_b, q = ins.accel[k], ins.quaternion
    before, after = quat_rotate(q[k], force_b), quat_rotate(q[k + 1], force_b)
    force = (0.5 * (before[0] + after[0]), 0.5 * (before[1] + after[1]), 0.5 * (before[2] + after[2]))
    error_matrix(ins.lla[k, 0], ins.velocity[k], force, model.radius, model.work.a)


@inner
def predict(model, k, dt, part):
    """x = Phi x and P = Phi (P + G Q G' dt) Phi' with Phi = I + a dt, in place."""
    x, p, a, product, total_x = model.state, model.p, model.work.a, model.work.product, model.work.sum
    for i in range(3):
        p[i, i] += model.noise[1] * dt
        p[3 + i, 3 + i] += model.noise[0] * dt
    for i in range(N_STATES):
        total = x[i]
        for j in range(N_STATES):
            total += dt * a[i, j] * x[j]
            product[i, j] = p[i, j]
        total_x[i] = total
        for m in range(N_STATES):
            step = dt * a[i, m]
            if step != 0.0:
                for j in range(N_STATES):
                    product[i, j] += step * p[m, j]
    for i in range(N_STATES):
        x[i] = total_x[i]
    for i in range(N_STATES):
        for j in range(i + 1):
            total = product[i, j]
            for m in range(N_STATES):
                total += product[i, m] * dt * a[j, m]
            p[i, j] = total
            p[j, i] = total


@inner
def correct(model, k, e):
    """Use the rows of measurement ``e`` that count."""
    events, work, x = model.events, model.work, model.state
    first = events.first[e]
    if first < N_ROWS:
        count = N_ROWS - first
        residual, h, r = work.residual[:count], work.h[first:], events.r[e, first:]
        for i in range(count):
            residual[i] = events.z[e, first + i] - x[3 + first + i]
        innovation_covariance(model.p, h, r, work.s[: count * count].reshape((count, count)), work.scratch)
        update(x, model.p, residual, h, r, work.scalars, work.scratch)
        note_update(model.keep, model, e, count, PLAIN)


@inner
def record(model, k):
    """Keep what is known at the end of IMU sample ``k``."""
    note_sample(model.keep, model, k)


steps(ErrorFilter, begin, predict, correct, record)


@njit(cache=True)
def correct_attitudes(quaternion, x):
    """(N,4) attitudes of the INS turned by the estimated errors psi = x[:, :3]."""
    out = np.empty(quaternion.shape)
    for k in range(quaternion.shape[0]):
        q = quat_normalize(quat_multiply(rotvec_to_quat(x[k]), quaternion[k]))
        for i in range(4):
            out[k, i] = q[i]
    return out
