"""The direct (total-state) extended Kalman filters: predict and update of one filter, and its steps on a time line.

States, models and ``place`` as in `motion_models`; the IMM-RSTEKF paper (2023). Positions are metres of the scaled
coordinates of ``place``. Kernels only; `estimators.core.timeline` walks a log with them.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from estimators.core import strong_tracking
from estimators.core.lever_arm import lever_arm
from estimators.core.recording import note_sample, note_update
from estimators.core.strapdown import coning_sculling
from estimators.core.timeline import inner, steps
from estimators.core.update import innovation_covariance, update, whiten
from estimators.methods.body_axes import Axes, load, mind_the_pole
from estimators.methods.motion_models import COUPLED, N_STATES, Motion, Step, add_process_noise, advance, transition
from testbed.kernels import njit
from testbed.kernels.lanes import alike, any_of, select
from testbed.physics import earth
from testbed.physics.rotations import euler_error_matrix, euler_to_quat, quat_to_matrix, wrap

Array = NDArray[np.float64]

MEASUREMENTS = 6
"""Position and velocity of a fix."""


class Inputs(NamedTuple):
    """What a direct filter is given: samples of the IMU, and fixes in its own coordinates."""

    imu: Array
    """(N,6): angular rate (rad/s) and specific force (m/s²)."""
    z: Array
    """(E,6): scaled position (m) and velocity (m/s) of the antenna."""
    r: Array
    """(E,6): variances."""


class Tracking(NamedTuple):
    """Strong tracking of one filter (`strong_tracking`)."""

    filter: int
    """EKF, STEKF or RSTEKF."""
    forgetting: float
    threshold: float
    """Of the chi-square test."""
    raw: bool
    """Whether the traces of the fading factor add metres and m/s as they are."""
    ceiling: float
    """Of the faded covariance, in units of `strong_tracking.CEILING`."""
    memory: Array
    """(7,): mean squares of the innovations, overwritten, and how many fixes they have seen."""


class Work(NamedTuple):
    """Arrays that are overwritten in every step."""

    corrections: Array
    """(6,): coning and sculling of the present IMU interval."""
    part: Array
    """(6,): their part of the present stretch."""
    phi: Array
    """(15,15)"""
    rows: Array
    """(16,15)"""
    residual: Array
    """(6,)"""
    s: Array
    """(36,): innovation covariance."""
    h: Array
    """(6,15)"""
    r: Array
    """(6,)"""
    factor: Array
    """(6,6)"""
    white: Array
    """(6,)"""
    scalars: Array
    """(6,2): see `estimators.core.update.update`."""
    scratch: Array
    """(4,15)"""


def make_work() -> Work:
    """Work of one filter, or of filters that take turns."""
    m, n = MEASUREMENTS, N_STATES
    shapes = (6, 6, (n, n), (n + 1, n), m, m * m, (m, n), m, (m, m), m, (m, 2), (4, n))
    work = Work(*(np.zeros(shape) for shape in shapes))
    np.fill_diagonal(work.phi, 1.0)
    return work


class Ekf(NamedTuple):
    """One extended Kalman filter on a log, for `estimators.core.timeline.walk`."""

    inputs: Inputs
    motion: Motion
    tracking: Tracking
    state: Array
    """(15,), overwritten, as is ``p`` (15,15)."""
    p: Array
    work: Work
    axes: Axes
    keep: Any
    """An `estimators.core.recording.Recording`, whose rows are in the axes of the time."""
    theta: Array
    """(E,): test statistic of each fix, overwritten."""


@njit(cache=True, nogil=True, _nrt=False)
def propagate_covariance(p, phi, coupled, work):
    """P = Phi P Phi' in place; ``phi`` as `transition` makes it (diagonal below row 8). ``work`` (15,15) is scratch.

    ``coupled``: the row of `motion_models.COUPLED` of its model.
    """
    for i in range(9):
        for c in range(N_STATES):
            work[i, c] = phi[i, i] * p[i, c]
        for k in range(N_STATES):
            if coupled[i, k]:
                for c in range(N_STATES):
                    work[i, c] += phi[i, k] * p[k, c]
    for i in range(9):
        for j in range(i + 1):
            total = work[i, j] * phi[j, j]
            for k in range(N_STATES):
                if coupled[j, k]:
                    total += work[i, k] * phi[j, k]
            p[i, j] = total
            p[j, i] = total
        for j in range(9, N_STATES):
            p[i, j] = work[i, j] * phi[j, j]
            p[j, i] = p[i, j]
    for i in range(9, N_STATES):
        for j in range(9, N_STATES):
            p[i, j] *= phi[i, i] * phi[j, j]


@njit(cache=True, nogil=True, _nrt=False)
def carry(motion, x, p, step, phi, rows):
    """State and covariance of one filter at the end of a `Step`, in place. ``phi`` (15,15), ``rows`` (16,15) are scratch."""
    transition(motion, x, step, phi)
    advance(motion, x, step, rows[15])
    for i in range(N_STATES):
        x[i] = rows[15, i]
    propagate_covariance(p, phi, COUPLED[motion.model], rows)
    add_process_noise(p, phi, motion.noise, step.dt)


@njit(cache=True, nogil=True, _nrt=False)
def has_lever(setting):
    """Whether the antenna is somewhere else than the IMU."""
    lever = setting.lever
    return lever[0] != 0.0 or lever[1] != 0.0 or lever[2] != 0.0


@njit(cache=True, nogil=True, _nrt=False)
def arm_of(x, imu, setting):
    """C_nb of state ``x``, and `lever_arm` there; metres of the scaled coordinates per metre north, east and down."""
    place = setting.place
    lat = place[0] + x[0] / place[2]
    m = quat_to_matrix(euler_to_quat(x[6], x[7], x[8]))
    north, east = earth.metres_per_radian(lat, place[1] - x[2])
    rate = (imu[0] - x[12], imu[1] - x[13], imu[2] - x[14])
    return m, lever_arm(m, setting.lever, rate, lat), (place[2] / north, place[3] / east, alike(lat, 1.0))


@njit(cache=True, nogil=True, _nrt=False)
def antenna(x, imu, setting, out):
    """Position and velocity (6,) of the antenna at the end of the lever arm: what a fix should read."""
    for i in range(MEASUREMENTS):
        out[i] = x[i]
    if has_lever(setting):
        _, (arm, sweep, drag), scale = arm_of(x, imu, setting)
        for i in range(3):
            out[i] += arm[i] * scale[i]
            out[3 + i] += sweep[i] - drag[i]


@njit(cache=True, nogil=True, _nrt=False)
def antenna_sensitivity(x, imu, setting, h):
    """``h`` (6,15): the Jacobian of `antenna` by the state (Earth curvature and rate over the lever arm left out)."""
    h[:] = 0.0
    for i in range(MEASUREMENTS):
        h[i, i] = 1.0
    if not has_lever(setting):
        return
    m, (arm, sweep, _), scale = arm_of(x, imu, setting)
    lever = setting.lever
    axes = euler_error_matrix(x[6], x[7], x[8])
    for k in range(3):
        a, b, c = axes[0][k], axes[1][k], axes[2][k]
        h[0, 6 + k] = (b * arm[2] - c * arm[1]) * scale[0]
        h[1, 6 + k] = (c * arm[0] - a * arm[2]) * scale[1]
        h[2, 6 + k] = a * arm[1] - b * arm[0]
        h[3, 6 + k] = b * sweep[2] - c * sweep[1]
        h[4, 6 + k] = c * sweep[0] - a * sweep[2]
        h[5, 6 + k] = a * sweep[1] - b * sweep[0]
    for i in range(3):
        row = m[i]
        h[3 + i, 12] = row[1] * lever[2] - row[2] * lever[1]
        h[3 + i, 13] = row[2] * lever[0] - row[0] * lever[2]
        h[3 + i, 14] = row[0] * lever[1] - row[1] * lever[0]


@njit(cache=True, nogil=True, _nrt=False)
def take_fix(tracking, x, p, seen, setting, work):
    """GNSS update in place by EKF, STEKF or RSTEKF. Returns (theta, log likelihood, fading factor).

    ``seen`` = (z (6,), variances (6,), IMU sample (6,)). ``work.residual`` and ``work.s`` keep what the update saw, the
    fading in it. theta is tested before fading, the likelihood taken after.
    """
    z, r, imu = seen
    residual, h, s = work.residual, work.h, work.s.reshape((MEASUREMENTS, MEASUREMENTS))
    antenna(x, imu, setting, work.white)
    for i in range(MEASUREMENTS):
        residual[i] = z[i] - work.white[i]
    antenna_sensitivity(x, imu, setting, h)
    innovation_covariance(p, h, r, s, work.scratch)
    theta = whiten(s, residual, work.factor, work.white)
    fading = alike(theta, 1.0)
    if tracking.filter != strong_tracking.EKF:
        mean_square = tracking.memory[:MEASUREMENTS]
        strong_tracking.smooth_innovations(
            mean_square, residual, tracking.forgetting, tracking.memory[MEASUREMENTS] == 0.0
        )
        tracking.memory[MEASUREMENTS] += 1.0
        least = -np.inf if tracking.filter == strong_tracking.STEKF else tracking.threshold
        fading = select(theta > least, strong_tracking.fading_factor(mean_square, s, r, tracking.raw), fading)
        if any_of(fading > 1.0):
            strong_tracking.fade(p, fading, work.scratch[0], tracking.ceiling)
            innovation_covariance(p, h, r, s, work.scratch)
    update(x, p, residual, h, r, work.scalars, work.scratch)
    wrap_angles(x)
    return theta, log_likelihood(work.scalars), fading


@njit(cache=True, nogil=True, _nrt=False)
def log_likelihood(scalars):
    """Of an innovation: the logarithm of its density, from the ``scalars`` (m,2) of `estimators.core.update.update`."""
    total = alike(scalars[0, 0], scalars.shape[0] * np.log(2.0 * np.pi))
    for a in range(scalars.shape[0]):
        left, variance = scalars[a, 0], scalars[a, 1]
        total += select(variance > 0.0, np.log(variance) + left * left / variance, np.nan)
    return -0.5 * total


@njit(cache=True, nogil=True, _nrt=False)
def wrap_angles(x):
    """Roll, pitch and yaw of a state into [-pi, pi), in place."""
    for i in range(6, 9):
        x[i] = wrap(x[i])


@inner
def begin(model, k, whole):
    """Open IMU sample ``k``: coning and sculling of its interval (s), biases of the state removed."""
    x, corrections = model.state, model.work.corrections
    load(model.axes, model.inputs.imu, k)
    if k == 0:
        corrections[:] = 0.0
        return
    last, now = model.axes.samples[0], model.axes.samples[1]
    coning, sculling = coning_sculling(
        ((now[0] - x[12]) * whole, (now[1] - x[13]) * whole, (now[2] - x[14]) * whole),
        ((now[3] - x[9]) * whole, (now[4] - x[10]) * whole, (now[5] - x[11]) * whole),
        ((last[0] - x[12]) * whole, (last[1] - x[13]) * whole, (last[2] - x[14]) * whole),
        ((last[3] - x[9]) * whole, (last[4] - x[10]) * whole, (last[5] - x[11]) * whole),
    )
    for i in range(3):
        corrections[i] = coning[i]
        corrections[3 + i] = sculling[i]


@inner
def stretch(model, k, dt, part):
    """The `Step` of ``dt`` (s) within IMU sample ``k``, ``part`` of its interval."""
    work = model.work
    for i in range(6):
        work.part[i] = part * work.corrections[i]
    return Step(model.axes.samples[1], work.part, dt)


@inner
def record(model, k):
    """Keep the state, and sigmas with the attitude as a rotation vector in n."""
    x, p, keep = model.state, model.p, model.keep
    note_sample(keep, model, k)
    axes = euler_error_matrix(x[6], x[7], x[8])
    for i in range(3):
        a = axes[i]
        keep.std[k, 6 + i] = np.sqrt(
            a[0] * (a[0] * p[6, 6] + 2.0 * (a[1] * p[6, 7] + a[2] * p[6, 8]))
            + a[1] * (a[1] * p[7, 7] + 2.0 * a[2] * p[7, 8])
            + a[2] * a[2] * p[8, 8]
        )


@inner
def predict(model, k, dt, part):
    """Carry the filter ``dt`` (s) on within IMU sample ``k``."""
    carry(model.motion, model.state, model.p, stretch(model, k, dt, part), model.work.phi, model.work.rows)


@inner
def correct(model, k, e):
    """Use fix ``e``, which lies within IMU sample ``k``."""
    inputs = model.inputs
    seen = inputs.z[e], inputs.r[e], model.axes.samples[1]
    theta, _, fading = take_fix(model.tracking, model.state, model.p, seen, model.motion.setting, model.work)
    model.theta[e] = theta
    note_update(model.keep, model, e, MEASUREMENTS, fading)


@inner
def end(model, k):
    """Keep sample ``k``, and stay away from the pole of the Euler angles."""
    record(model, k)
    mind_the_pole(model, k)


steps(Ekf, begin, predict, correct, end)
