"""Kernels of the attitude filters `ahrs-kf` and `ahrs-lstm`: a 12-state indirect filter on gravity and magnetic field.

Error states, all in b: attitude (3, rad), gyro bias (3), linear acceleration (3), magnetic disturbance (3), each "true
minus estimate". z = [g_accel - g_gyro; m_mag - m_gyro] (6) after the AHRS paper (2022). SI units, fields in µT.

Time line, Cholesky factor and the hooks of the recording are those of `estimators.core`; state and step are not, and linear
acceleration and magnetic disturbance are no blocks: a block adds to what moves position and velocity, which this filter
has not, with its attitude error in n, while here both are in b and add to what is measured. Nor is the update, which takes
all six rows at once: it is the whole gain (6,12) that a network corrects, and scalars in a row never form it.

The gain is kept transposed, (6,12), so that every inner loop runs over twelve contiguous numbers.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numba.extending import overload
from numpy.typing import NDArray

from estimators.core.recording import keeper, note_sample
from estimators.core.timeline import INLINED, inner, steps
from estimators.core.update import cholesky
from testbed.kernels import njit
from testbed.physics.rotations import quat_multiply, quat_normalize, quat_to_matrix, rotvec_to_quat

Array = NDArray[np.float64]


class Figures(NamedTuple):
    """What the filter takes the sensors and the motion for; variances are those of one sample, or grow in one."""

    gyro_variance: float  # (rad/s)²
    bias_variance: float
    """(rad/s)², grown per sample."""
    accel_growth: float  # (m/s²)²
    mag_growth: float  # µT²
    accel_variance: float  # (m/s²)²
    mag_variance: float  # µT²
    bias_decay: float
    accel_decay: float
    mag_decay: float
    interval: float  # s
    gravity: float  # m/s²
    turn_inflation: float
    """Variance of new linear acceleration across the speed per (rad/s)² of turn; 0: none."""
    residual_inflation: float
    """The same along x per (m/s²)² that is seen of it; 0: none."""
    averaging: float
    """Weight of a new sample in the means of both."""
    scale_variance: float = 0.0
    """s: variance of the angle that an error of the gyros' scale makes per second, over the square of the rate."""


class Samples(NamedTuple):
    """A log as the filter takes it; the accelerometers are freed of the bias that the calibration gave."""

    gyro: Array  # (N,3) rad/s
    accel: Array  # (N,3) m/s²
    mag: Array  # (M,3) µT
    mag_row: NDArray[np.int64]
    """(N,) the row of the field sample that arrives with an IMU sample, or -1."""
    field_n: Array  # (3,) µT


class Work(NamedTuple):
    """Arrays that are overwritten in every step."""

    z: Array  # (6,)
    seen: Array
    """(6,) gravity and field that the attitude predicts in b."""
    x: Array  # (12,) the correction.
    slow: Array  # (3,) see `inflate`.
    s: Array  # (6,6) innovation covariance.
    factor: Array  # (6,6) its Cholesky factor.
    y: Array  # (6,12)
    k: Array  # (6,12) gain, transposed.


class AttitudeFilter(NamedTuple):
    """The filter on a log, for `estimators.core.timeline.walk`. Its events are the IMU samples themselves, each at its end.

    A field sample is taken with the first of them at or after its time, since the gain is that of both together.
    """

    samples: Samples
    figures: Figures
    state: Array
    """(13,) q_nb, gyro bias, linear acceleration, magnetic disturbance; overwritten."""
    p: Array
    """(12,12), overwritten."""
    work: Work
    gain: Any
    """What changes the gain before it corrects: `OwnGain`, or a class tied by `gain_hook`."""
    keep: Any
    """`AttitudeRecording`, or a class tied by `estimators.core.recording.keeper`."""


class OwnGain(NamedTuple):
    """The filter's own gain is the one that corrects."""

    change: Array
    """(1,) how much a hook changed the gain of the present sample, rms of the logarithm; overwritten."""


class AttitudeRecording(NamedTuple):
    """What a run leaves behind: the state after every sample, and every ``stride``-th sample all else."""

    state: Array
    """(N,13)"""
    std: Array
    """(N,3) of the attitude in n, rad"""
    stride: int
    covariance: Array
    """(M,12,12)"""
    innovation: Array
    """(M,6), NaN where there was no field sample"""
    innovation_covariance: Array
    """(M,6,6)"""
    change: Array
    """(M,) of the gain, see `OwnGain`"""


def make_filter(samples: Samples, figures: Figures, start: tuple[Array, Array], gain: Any, keep: Any) -> AttitudeFilter:
    """The filter at its ``start``: state (13,) and covariance (12,12), both overwritten by a run."""
    return AttitudeFilter(samples, figures, *start, make_work(), gain, keep)


def make_work() -> Work:
    """Room for one gain."""
    return Work(*(np.zeros(shape) for shape in ((6,), (6,), (12,), (3,), (6, 6), (6, 6), (6, 12), (6, 12))))


def empty_recording(samples: int, stride: int) -> AttitudeRecording:
    """Room for a run over so many IMU samples."""
    m = samples // stride
    kept = np.empty((m, 12, 12)), np.empty((m, 6)), np.empty((m, 6, 6)), np.empty(m)
    return AttitudeRecording(np.empty((samples, 13)), np.empty((samples, 3)), stride, *kept)


_HOOKS: dict[type, Any] = {}


def gain_hook(kind: type, function: Any) -> None:
    """Tie to a class of ``gain`` a plain function (gain, model, k) that changes ``model.work.k``, compiled where it is used."""
    _HOOKS[kind] = function


def change_gain(gain, model, k):
    """Change the gain of IMU sample ``k``. Kernels only."""
    raise NotImplementedError("kernels only")


@overload(change_gain, jit_options=INLINED)
def _change_gain(gain, model, k):
    return _HOOKS[gain.instance_class]


def _leave_gain(gain, model, k):
    pass


gain_hook(OwnGain, _leave_gain)


@inner
def begin(model, k, whole):
    """Nothing is to be opened: an event closes each sample."""


@inner
def predict(model, k, dt, part):
    """Carry state and covariance over IMU sample ``k``, which lasts the mean interval: that is what the figures are of."""
    dq = turn(model.state, model.samples.gyro[k], model.figures)
    carry(model.p, dq, model.figures)


@inner
def correct(model, k, e):
    """Gravity, and the field where a sample of it arrives with IMU sample ``k``."""
    samples, work, figures = model.samples, model.work, model.figures
    gyro, accel = samples.gyro[k], samples.accel[k]
    has_mag = observe(model, k)
    inflate(model.p, gyro, accel, model.state, figures, work)
    kalman_gain(model.p, has_mag, figures, work, work.k)
    change_gain(model.gain, model, k)
    weigh(work.k, work.z, work.x)
    add_correction(model.state, work.x)


@inner
def record(model, k):
    """Keep what is known at the end of IMU sample ``k``."""
    note_sample(model.keep, model, k)


steps(AttitudeFilter, begin, predict, correct, record)


@njit(cache=True, nogil=True, _nrt=False, forceinline=True)
def gyro_turn(state, gyro, figures):
    """Quaternion of the turn in b that one gyro sample tells."""
    dt = figures.interval
    return rotvec_to_quat(((gyro[0] - state[4]) * dt, (gyro[1] - state[5]) * dt, (gyro[2] - state[6]) * dt))


@njit(cache=True, nogil=True, _nrt=False, forceinline=True)
def turn(state, gyro, figures):
    """Turn the attitude by one gyro sample and let the disturbances decay; returns the quaternion of the turn."""
    dq = gyro_turn(state, gyro, figures)
    q = quat_normalize(quat_multiply((state[0], state[1], state[2], state[3]), dq))
    for i in range(4):
        state[i] = q[i]
    for i in range(3):
        state[7 + i] *= figures.accel_decay
        state[10 + i] *= figures.mag_decay
    return dq


@njit(cache=True, nogil=True, _nrt=False, forceinline=True)
def carry(p, dq, figures):
    """P = Phi P Phi' + Q for one sample with the turn ``dq``."""
    turned = 4.0 * (dq[1] * dq[1] + dq[2] * dq[2] + dq[3] * dq[3])  # its angle squared: at most pi/2 in a sample
    turning = figures.gyro_variance * figures.interval**2 + figures.scale_variance * turned / figures.interval
    dt, fb, fa, fd = figures.interval, figures.bias_decay, figures.accel_decay, figures.mag_decay
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
        p[i, i] += turning
        p[3 + i, 3 + i] += figures.bias_variance
        p[6 + i, 6 + i] += figures.accel_growth
        p[9 + i, 9 + i] += figures.mag_growth


@inner
def observe(model, k):
    """z and what the attitude predicts, into ``work``; returns whether there is a field sample."""
    state, samples, z, seen = model.state, model.samples, model.work.z, model.work.seen
    row, field = samples.mag_row[k], samples.field_n
    m = quat_to_matrix((state[0], state[1], state[2], state[3]))
    for i in range(3):
        seen[i] = m[2][i] * model.figures.gravity
        z[i] = state[7 + i] - samples.accel[k, i] - seen[i]
        if row >= 0:
            seen[3 + i] = m[0][i] * field[0] + m[1][i] * field[1] + m[2][i] * field[2]
            z[3 + i] = samples.mag[row, i] - state[10 + i] - seen[3 + i]
        else:
            seen[3 + i] = 0.0
            z[3 + i] = 0.0
    return row >= 0


@njit(cache=True, nogil=True, _nrt=False, forceinline=True)
def inflate(p, gyro, accel, state, figures, work):
    """Raise the variance of linear acceleration, axis by axis, by what shows that there is some: turns and residuals.

    In a turn at speed V along x there is V w_z along y and V w_y along z. Along x the residual of the accelerometer tells,
    where it is larger than the filter's doubt about its attitude explains (Suh 2010, doi:10.1109/TIM.2010.2047157).
    ``work.slow`` (3) keeps the means of that residual (m/s²), w_y and w_z (rad/s): the square of a mean leaves noise out.
    """
    seen, slow = work.seen, work.slow
    slow[0] += figures.averaging * (-accel[0] - seen[0] - slow[0])
    slow[1] += figures.averaging * (gyro[1] - state[5] - slow[1])
    slow[2] += figures.averaging * (gyro[2] - state[6] - slow[2])
    doubt = seen[2] ** 2 * p[1, 1] + seen[1] ** 2 * p[2, 2] - 2.0 * seen[1] * seen[2] * p[1, 2]
    p[6, 6] += figures.residual_inflation * max(0.0, slow[0] ** 2 - doubt)
    p[7, 7] += figures.turn_inflation * slow[2] ** 2
    p[8, 8] += figures.turn_inflation * slow[1] ** 2


@njit(cache=True, nogil=True, _nrt=False, forceinline=True)
def kalman_gain(p, has_mag, figures, work, k):
    """Gain (transposed, (6,12)) into ``k``, innovation covariance into ``work.s``; ``p`` becomes the updated covariance.

    H = [[g×], 0, -I, 0; [m×], 0, 0, I]; without a magnetometer sample its three rows are zero. With S = L Lᵀ and
    Y = P Hᵀ L⁻ᵀ the update P - Y Yᵀ is symmetric by construction.
    """
    seen, s, chol, y = work.seen, work.s, work.factor, work.y
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
        s[c, c] += figures.accel_variance if c < 3 else figures.mag_variance
    cholesky(s, chol)
    for c in range(6):
        for j in range(c):
            f = chol[c, j]
            for i in range(12):
                y[c, i] -= f * y[j, i]
        f = 1.0 / chol[c, c] if chol[c, c] > 0.0 else 0.0  # a row that the others say already tells nothing
        for i in range(12):
            y[c, i] *= f
    for c in range(5, -1, -1):
        for i in range(12):
            k[c, i] = y[c, i]
        for j in range(c + 1, 6):
            f = chol[j, c]
            for i in range(12):
                k[c, i] -= f * k[j, i]
        f = 1.0 / chol[c, c] if chol[c, c] > 0.0 else 0.0
        for i in range(12):
            k[c, i] *= f
    for i in range(12):
        for c in range(6):
            f = y[c, i]
            for j in range(12):
                p[i, j] -= f * y[c, j]


@njit(cache=True, nogil=True, _nrt=False)
def weigh(k, z, x):
    """x (12) = K z."""
    for i in range(12):
        x[i] = 0.0
    for c in range(6):
        for i in range(12):
            x[i] += k[c, i] * z[c]


@njit(cache=True, nogil=True, _nrt=False)
def add_correction(state, x):
    """Apply the estimated error to the state."""
    dq = rotvec_to_quat((x[0], x[1], x[2]))
    q = quat_normalize(quat_multiply((state[0], state[1], state[2], state[3]), dq))
    for i in range(4):
        state[i] = q[i]
    for i in range(9):
        state[4 + i] += x[3 + i]


@njit(cache=True, nogil=True, _nrt=False)
def attitude_std_n(state, p, out):
    """1 sigma of the attitude error about north, east and down into ``out`` (3)."""
    m = quat_to_matrix((state[0], state[1], state[2], state[3]))
    for i in range(3):
        a, b, c = m[i][0], m[i][1], m[i][2]
        total = a * a * p[0, 0] + b * b * p[1, 1] + c * c * p[2, 2]
        total += 2.0 * (a * b * p[0, 1] + a * c * p[0, 2] + b * c * p[1, 2])
        out[i] = np.sqrt(total)


def _record_sample(keep, model, k):
    for i in range(13):
        keep.state[k, i] = model.state[i]
    attitude_std_n(model.state, model.p, keep.std[k])
    if (k + 1) % keep.stride == 0:
        _keep_all(keep, model, k)


@njit(cache=True, nogil=True, _nrt=False)
def _keep_all(keep, model, k):
    """Covariance and innovation; channels without a measurement are marked by NaN."""
    row, work, has_mag = k // keep.stride, model.work, model.samples.mag_row[k] >= 0
    keep.change[row] = model.gain.change[0]
    for i in range(12):
        for j in range(12):
            keep.covariance[row, i, j] = model.p[i, j]
    for i in range(6):
        keep.innovation[row, i] = work.z[i] if i < 3 or has_mag else np.nan
        for j in range(6):
            keep.innovation_covariance[row, i, j] = work.s[i, j]


keeper(AttitudeRecording, None, _record_sample)
