"""Kernels of `ahrs-eskf`: attitude by inertial navigation of the horizontal velocity, which stays bounded.

States: attitude error (3, in n, rad), gyro bias (3, in b, rad/s), horizontal velocity (2, m/s), each "true minus estimate";
C_true = (1 + [phi x]) C. With an airspeed the velocity is that in the frame of the steady wind, and the gusts (2, m/s), in
which the aircraft moves with its airspeed, are states too: a first-order process of Dryden's scale (MIL-F-8785C).
The covariance takes a step every `Settings.stride` samples. SI units, fields in µT.

Time line, scalar update and the hooks of the recording are those of `estimators.core`. State and step are not: the composed
filter carries position and a vertical channel, in which an error of the accelerometers' scale of 1 % would grow without
anything to hold it, and a heading that corrects the heading alone is no Kalman update of the full state.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from estimators.core.recording import keeper, note_sample
from estimators.core.timeline import inner, steps
from estimators.core.update import update
from estimators.methods.ahrs_field import FieldWatch, doubt_of_field
from testbed.kernels import njit
from testbed.physics.rotations import (
    cross,
    matrix_rotate,
    quat_multiply,
    quat_normalize,
    quat_to_matrix,
    rotvec_to_quat,
    wrap,
)

Array = NDArray[np.float64]

FIELD, AIRSPEED, GROUND_VELOCITY = 0, 1, 2
"""Kinds of events."""
FORCE, LEVERS, RATE, FIELD_SUM, FIELD_COUNT, SPAN, SINCE, SPEED = 0, 3, 12, 13, 16, 17, 18, 19
"""Places in ``Work.sums``: see there."""


class Settings(NamedTuple):
    """What the filter takes sensors and motion for. Densities are variances of a mean over 1 s."""

    stride: int
    """Samples between two steps of the covariance."""
    interval: float  # s
    gyro_density: float  # (rad/s)² s
    scale_density: float
    """s: the density of angular rate over the square of the rate."""
    bias_walk: float  # (rad/s)²/s
    bias_limit: float
    """(rad/s)², the variance of a bias never grows beyond it."""
    velocity_walk: float  # (m/s)²/s
    velocity_density: float
    """(m/s)² s of the zero velocity while the carrier moves; 0: none is measured."""
    still_density: float
    """The same at rest."""
    heading_density: float  # rad² s
    declination: float  # rad
    direction: tuple[float, float, float]
    """Unit vector of the field in n where that corrects the tilt too; else zeros."""
    rest_rate: float  # rad/s
    rest_force: float  # m/s²
    rest_time: float  # s
    rest_weight: float
    """Of a new sample in the means that a sample at rest stays close to."""
    rest_bias: float
    """(rad/s)², variance of a bias that was seen at rest."""
    slip_density: float
    """rad² s of the angle between the air's flow and the x axis."""
    gust_variance: float
    """(m/s)² of a component of the gusts."""
    gust_length: float
    """m through which the gusts stay alike."""
    lever_arm: tuple[float, float, float]
    """From the IMU to the antenna, m, in b."""


class Inputs(NamedTuple):
    """The samples of the IMU, and those of all else in the order of time."""

    gyro: Array  # (N,3) rad/s
    accel: Array  # (N,3) m/s²
    kind: NDArray[np.int64]  # (E,)
    z: Array
    """(E,3) field (µT), airspeed and two zeros, or velocity in n (m/s)."""
    r: Array
    """(E,) variance of a speed, (m/s)²."""


class Work(NamedTuple):
    """Arrays that are overwritten in every step."""

    sums: Array
    """(20,) since the last step of the covariance: specific force in n times dt (3), C times dt (9), square of the rate times
    dt, field in n (3) and how many, time (s); time since the last corrections (s); the last airspeed (m/s)."""
    rest: Array
    """(8,) means of rate and specific force, time at rest, and whether (1) it is."""
    x: Array  # (8 or 10,) correction
    h: Array  # (3,8 or 10)
    residual: Array  # (3,)
    r: Array  # (3,)
    scalars: Array  # (3,2)
    scratch: Array  # (4,8 or 10)
    noted: Array
    """(5,) the last heading innovation, its variance, whether (1) it was used; the last velocity innovation's square and S."""


class HeadingFilter(NamedTuple):
    """The filter on a log, for `estimators.core.timeline.walk`."""

    inputs: Inputs
    settings: Settings
    watch: FieldWatch
    state: Array
    """(9 or 11,) q_nb, gyro bias, velocity north and east, and with an airspeed gusts north and east; overwritten."""
    p: Array
    """(8,8) or (10,10), overwritten."""
    work: Work
    keep: Any


class AttitudeRecording(NamedTuple):
    """What a run leaves behind: the state after every sample, and every ``stride``-th sample all else."""

    state: Array  # (N,9)
    std: Array  # (N,6) of attitude in n and gyro bias
    stride: int
    covariance: Array  # (M,6,6)
    heading: Array
    """(M,3) innovation (rad), variance, and whether it was used."""
    at_rest: Array
    """(M,) 1 at rest."""


def make_work(states: int = 8) -> Work:
    """Room for one filter with so many error states."""
    shapes = (20, 8, states, (3, states), 3, 3, (3, 2), (4, states), 5)
    return Work(*(np.zeros(shape) for shape in shapes))


def empty_recording(samples: int, stride: int) -> AttitudeRecording:
    """Room for a run over so many IMU samples."""
    m = samples // stride
    return AttitudeRecording(
        np.empty((samples, 9)), np.empty((samples, 6)), stride, np.empty((m, 6, 6)), np.empty((m, 3)), np.empty(m)
    )


@inner
def begin(model, k, whole):
    """Nothing: the rate is taken as constant over a sample, and the attitude at its half turns the specific force."""


@inner
def predict(model, k, dt, part):
    """Turn the attitude by ``dt`` (s) of sample ``k``, add its specific force to the velocity, and sum what the covariance needs."""
    state, gyro, accel, sums = model.state, model.inputs.gyro, model.inputs.accel, model.work.sums
    w = (gyro[k, 0] - state[4], gyro[k, 1] - state[5], gyro[k, 2] - state[6])
    half = rotvec_to_quat((0.5 * dt * w[0], 0.5 * dt * w[1], 0.5 * dt * w[2]))
    middle = quat_multiply((state[0], state[1], state[2], state[3]), half)
    c = quat_to_matrix(middle)
    f = matrix_rotate(c, (accel[k, 0], accel[k, 1], accel[k, 2]))
    q = quat_normalize(quat_multiply(middle, half))
    for i in range(4):
        state[i] = q[i]
    state[7] += f[0] * dt
    state[8] += f[1] * dt
    for i in range(3):
        sums[FORCE + i] += f[i] * dt
        for j in range(3):
            sums[LEVERS + 3 * i + j] += c[i][j] * dt
    sums[RATE] += (w[0] * w[0] + w[1] * w[1] + w[2] * w[2]) * dt
    sums[SPAN] += dt
    sums[SINCE] += dt


@inner
def correct(model, k, e):
    """A field sample waits for the next step of the covariance; a speed is used at once."""
    z, kind, sums = model.inputs.z, model.inputs.kind[e], model.work.sums
    if kind == FIELD:
        state = model.state
        m = matrix_rotate(quat_to_matrix((state[0], state[1], state[2], state[3])), (z[e, 0], z[e, 1], z[e, 2]))
        for i in range(3):
            sums[FIELD_SUM + i] += m[i]
        sums[FIELD_COUNT] += 1.0
    else:
        spread(model.p, model.state, model.settings, model.work)
        use_speed(model, k, e)


@inner
def record(model, k):
    """End IMU sample ``k``: watch for rest; every `Settings.stride` samples carry the covariance and correct."""
    watch_rest(model.inputs, k, model.settings, model.work.rest)
    if (k + 1) % model.settings.stride == 0:
        spread(model.p, model.state, model.settings, model.work)
        use_pause(model.p, model.state, model.settings, model.work)
        use_heading(model)
        model.work.sums[SINCE] = 0.0
    note_sample(model.keep, model, k)


steps(HeadingFilter, begin, predict, correct, record)


@njit(cache=True, nogil=True, _nrt=False)
def spread(p, state, settings, work):
    """P = Phi P Phi' + Q over the time that ``work.sums`` holds, which begin anew.

    phi' = phi - sum(C dt) db;  dv_N' = dv_N + f_D phi_E - f_E phi_D;  dv_E' = dv_E + f_N phi_D - f_D phi_N, f times dt.
    Where the velocity is measured as zero, its error is taken in a frame that turns with the heading, and phi_D falls out:
    a turn of a velocity is none of zero. Left in, it would be "seen" in whatever the carrier's own motion is.
    """
    sums, t, n = work.sums, work.sums[SPAN], len(p)
    f_n, f_e, f_d = sums[FORCE], sums[FORCE + 1], sums[FORCE + 2]
    if settings.velocity_density > 0.0:  # zero is zero in every frame: see above
        f_n = f_e = 0.0
    if n > 8:
        carry_gusts(p, state, settings, sums[SPEED] * t)
    for j in range(n):  # rows of Phi P: velocity first, which needs the attitude as it was
        p[6, j] += f_d * p[1, j] - f_e * p[2, j]
        p[7, j] += f_n * p[2, j] - f_d * p[0, j]
        for i in range(3):
            a = LEVERS + 3 * i
            p[i, j] -= sums[a] * p[3, j] + sums[a + 1] * p[4, j] + sums[a + 2] * p[5, j]
    for j in range(n):
        p[j, 6] += f_d * p[j, 1] - f_e * p[j, 2]
        p[j, 7] += f_n * p[j, 2] - f_d * p[j, 0]
        for i in range(3):
            a = LEVERS + 3 * i
            p[j, i] -= sums[a] * p[j, 3] + sums[a + 1] * p[j, 4] + sums[a + 2] * p[j, 5]
    for i in range(n):
        for j in range(i):
            p[i, j] = p[j, i] = 0.5 * (p[i, j] + p[j, i])
    turning = settings.gyro_density * t + settings.scale_density * sums[RATE]
    for i in range(3):
        p[i, i] += turning
        p[3 + i, 3 + i] += settings.bias_walk * t
        limit_variance(p, 3 + i, settings.bias_limit)
    p[6, 6] += settings.velocity_walk * t
    p[7, 7] += settings.velocity_walk * t
    for i in range(FIELD_SUM):
        sums[i] = 0.0
    sums[SPAN] = 0.0


@njit(cache=True, nogil=True, _nrt=False)
def carry_gusts(p, state, settings, way):
    """Gusts decay over the ``way`` (m) through the air, and others come."""
    decay = np.exp(-way / settings.gust_length)
    for i in range(8, 10):
        state[1 + i] *= decay
        for j in range(10):
            p[i, j] *= decay
        for j in range(10):
            p[j, i] *= decay
        p[i, i] += settings.gust_variance * (1.0 - decay * decay)


@njit(cache=True, nogil=True, _nrt=False)
def limit_variance(p, i, limit):
    """Scale row and column ``i`` so that its variance is at most ``limit``: correlations stay as they are."""
    if p[i, i] > limit:
        factor = np.sqrt(limit / p[i, i])
        for j in range(p.shape[0]):
            p[i, j] *= factor
            p[j, i] *= factor


@njit(cache=True, nogil=True, _nrt=False)
def watch_rest(inputs, k, settings, rest):
    """Whether rate and specific force have stayed close to their means, and the rate to zero, for `Settings.rest_time`."""
    gyro, accel, still = inputs.gyro, inputs.accel, True
    weight = settings.rest_weight if k > 0 else 1.0
    for i in range(3):
        rest[i] += weight * (gyro[k, i] - rest[i])
        rest[3 + i] += weight * (accel[k, i] - rest[3 + i])
        still = still and abs(gyro[k, i] - rest[i]) < settings.rest_rate and abs(rest[i]) < settings.rest_rate
        still = still and abs(accel[k, i] - rest[3 + i]) < settings.rest_force
    rest[6] = rest[6] + settings.interval if still else 0.0
    rest[7] = 1.0 if rest[6] >= settings.rest_time else 0.0


@njit(cache=True, nogil=True, _nrt=False)
def use_pause(p, state, settings, work):
    """Velocity is zero as far as the carrier's kind of motion keeps it so; at rest it is, and the gyros show their bias."""
    t, at_rest = work.sums[SINCE], work.rest[7] == 1.0
    density = settings.still_density if at_rest else settings.velocity_density
    if density > 0.0:
        work.h[:] = 0.0
        for i in range(2):
            work.h[i, 6 + i], work.residual[i], work.r[i] = 1.0, -state[7 + i], density / t
        apply(p, state, work, 2)
    if at_rest:
        r = settings.rest_bias**2 / (settings.bias_walk * t) + settings.rest_bias
        work.h[:] = 0.0
        for i in range(3):
            work.h[i, 3 + i], work.residual[i], work.r[i] = 1.0, work.rest[i] - state[4 + i], r
        apply(p, state, work, 3)


@njit(cache=True, nogil=True, _nrt=False)
def apply(p, state, work, rows):
    """Correct by the first ``rows`` of ``work.h``, ``residual`` and ``r``."""
    work.x[:] = 0.0
    update(work.x, p, work.residual[:rows], work.h[:rows], work.r[:rows], work.scalars, work.scratch)
    add_correction(state, work.x)


@njit(cache=True, nogil=True, _nrt=False)
def add_correction(state, x):
    """Add an error (8,), true minus estimate, to the state."""
    q = quat_multiply(rotvec_to_quat((x[0], x[1], x[2])), (state[0], state[1], state[2], state[3]))
    q = quat_normalize(q)
    for i in range(4):
        state[i] = q[i]
    for i in range(len(x) - 3):
        state[4 + i] += x[3 + i]


@inner
def use_heading(model):
    """The mean field since the last step corrects the heading alone: the row of the gain that is the heading's.

    The full gain would hand an error of the field on to tilt and bias, which the field here is too uncertain to tell of.
    """
    p, settings, sums, noted, x = model.p, model.settings, model.work.sums, model.work.noted, model.work.x
    if sums[FIELD_COUNT] == 0.0:
        return
    n = sums[FIELD_COUNT]
    m = (sums[FIELD_SUM] / n, sums[FIELD_SUM + 1] / n, sums[FIELD_SUM + 2] / n)
    rate = np.sqrt(model.work.rest[0] ** 2 + model.work.rest[1] ** 2 + model.work.rest[2] ** 2)
    doubt = doubt_of_field(model.watch, m, rate, sums[SINCE])
    residual = wrap(settings.declination - np.arctan2(m[1], m[0]))
    # d azimuth = phi_D - (m_N phi_N + m_E phi_E) m_D / (m_N² + m_E²): an error of tilt is one of the heading
    slope = -m[2] / max(m[0] * m[0] + m[1] * m[1], 1e-12)
    h_n, h_e = slope * m[0], slope * m[1]
    scratch = model.work.scratch
    for j in range(len(p)):
        scratch[0, j] = h_n * p[0, j] + h_e * p[1, j] + p[2, j]
    known = h_n * scratch[0, 0] + h_e * scratch[0, 1] + scratch[0, 2]
    r = settings.heading_density / sums[SINCE] * max(doubt, 1.0)
    noted[0], noted[1], noted[2] = residual, known + r, 0.0
    if doubt > 0.0 and settings.direction[2] != 0.0:
        noted[2] = 1.0
        use_direction(p, model.state, settings, model.work, m, r)
    elif doubt > 0.0:
        gain = scratch[0, 2] / (known + r)
        noted[2] = 1.0
        turn_heading(p, scratch[0], gain, known + r)
        x[:] = 0.0
        x[2] = gain * residual
        if settings.velocity_density > 0.0:
            x[6], x[7] = -x[2] * model.state[8], x[2] * model.state[7]
        add_correction(model.state, x)
    for i in range(FIELD_SUM, FIELD_COUNT + 1):
        sums[i] = 0.0


@njit(cache=True, nogil=True, _nrt=False)
def use_direction(p, state, settings, work, m, r):
    """The field ``m`` (3, in n) points where the field of the place does, u = u_est + phi x u_est.

    ``r`` (rad²) is the variance of the heading that it shows; the field turns by as much about any other axis.
    """
    size = np.sqrt(m[0] * m[0] + m[1] * m[1] + m[2] * m[2])
    u, d, h = (m[0] / size, m[1] / size, m[2] / size), settings.direction, work.h
    h[:] = 0.0
    h[0, 1], h[0, 2] = u[2], -u[1]
    h[1, 0], h[1, 2] = -u[2], u[0]
    h[2, 0], h[2, 1] = u[1], -u[0]
    for i in range(3):
        work.residual[i], work.r[i] = d[i] - u[i], r * (d[0] * d[0] + d[1] * d[1])
    apply(p, state, work, 3)


@njit(cache=True, nogil=True, _nrt=False, forceinline=True)
def turn_heading(p, ph, gain, variance):
    """P = (1 - K h) P (1 - K h)' + K r K' for a gain on phi_D alone, from ``ph`` = P h' and the innovation's variance."""
    for j in range(len(p)):
        if j != 2:
            p[2, j] -= gain * ph[j]
            p[j, 2] = p[2, j]
    p[2, 2] += gain * (gain * variance - 2.0 * ph[2])


@inner
def use_speed(model, k, e):
    """Horizontal velocity from an airspeed along x in gusts, in the steady wind's frame, or from a receiver at its antenna."""
    inputs, settings, state, work = model.inputs, model.settings, model.state, model.work
    z, h, residual, r, gyro = inputs.z, work.h, work.residual, work.r, inputs.gyro
    c = quat_to_matrix((state[0], state[1], state[2], state[3]))
    h[:] = 0.0
    h[0, 6], h[1, 7] = 1.0, 1.0
    if inputs.kind[e] == AIRSPEED:
        speed = z[e, 0]
        x_n, x_e, x_d = speed * c[0][0], speed * c[1][0], speed * c[2][0]
        residual[0], residual[1] = x_n + state[9] - state[7], x_e + state[10] - state[8]
        h[0, 8], h[1, 9] = -1.0, -1.0
        model.work.sums[SPEED] = speed
        h[0, 1], h[0, 2] = -x_d, x_e
        h[1, 0], h[1, 2] = x_d, -x_n
        r[0] = r[1] = inputs.r[e] + speed * speed * settings.slip_density
    else:
        w = (gyro[k, 0] - state[4], gyro[k, 1] - state[5], gyro[k, 2] - state[6])
        lever = matrix_rotate(c, cross(w, settings.lever_arm))
        residual[0], residual[1] = z[e, 0] - lever[0] - state[7], z[e, 1] - lever[1] - state[8]
        r[0] = r[1] = inputs.r[e]
    apply(model.p, state, work, 2)


def _record_sample(keep, model, k):
    p = model.p
    for i in range(9):
        keep.state[k, i] = model.state[i]
    for i in range(6):
        keep.std[k, i] = np.sqrt(p[i, i])
    if (k + 1) % keep.stride == 0:
        row = k // keep.stride
        for i in range(6):
            for j in range(6):
                keep.covariance[row, i, j] = p[i, j]
        for i in range(3):
            keep.heading[row, i] = model.work.noted[i]
        keep.at_rest[row] = model.work.rest[7]


keeper(AttitudeRecording, None, _record_sample)
