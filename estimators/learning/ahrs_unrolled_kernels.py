"""`ahrs-kf` unrolled: many windows of flights side by side, flown by the filter's own steps, and how a loss runs back through them.

Forward the steps are those of `estimators.methods.ahrs_kernels` at the rate of the samples, with the gain K exp(answer) of
`ahrs_lstm_kernels`. Backward is their adjoint: attitude errors are small turns in b, q exp([theta x]), and a window's errors
are (theta, gyro bias, linear acceleration, magnetic disturbance), 12. H turns with the estimated attitude, and gain and
covariance with it. What `ahrs_kernels.inflate` owes to them is left out: for filters that adapt. SI units, µT.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba.np.unsafe.ndarray import to_fixed_tuple
from numpy.typing import NDArray

from estimators.learning.ahrs_lstm_kernels import LIMIT, gather
from estimators.methods.ahrs_kernels import (
    Array,
    AttitudeFilter,
    Figures,
    Samples,
    Work,
    add_correction,
    carry,
    inflate,
    kalman_gain,
    observe,
    turn,
    weigh,
)
from testbed.kernels import njit
from testbed.physics.rotations import cross, matrix_rotate, quat_to_matrix, quat_to_rotvec, rotvec_to_quat

FIGURES = len(Figures._fields)


class Windows(NamedTuple):
    """Windows of B flights, each with T samples of all sensors at common times."""

    gyro: Array  # (B,T,3) rad/s
    accel: Array  # (B,T,3) m/s²
    mag: Array  # (B,T,3) µT
    down: Array
    """(B,T,3) true direction of down in b"""
    rows: NDArray[np.int64]
    """(T,) 0, 1, ...: the field sample of each IMU sample"""
    field_n: Array  # (3,) µT
    figures: Array
    """(B,15) the fields of `Figures`"""
    state: Array
    """(B,13) of `AttitudeFilter`, overwritten"""
    p: Array
    """(B,12,12), overwritten"""
    slow: Array
    """(B,3) of `ahrs_kernels.Work`, overwritten"""


class Tape(NamedTuple):
    """What the way back needs of up to M steps of the network, each of ``every`` samples."""

    turned: Array
    """(M,B,every,3) rotation vector of each sample's turn in b, rad"""
    seen: Array
    """(M,B,every,6) predicted gravity and field"""
    z: Array  # (M,B,every,6)
    k: Array
    """(M,B,every,6,12) the filter's own gain, transposed"""
    factor: Array
    """(M,B,every,6,6) Cholesky factor of the innovation covariance"""
    p: Array
    """(M,B,every,12,12) the updated covariance"""
    carried: Array
    """(M,B,every,3,12) the part of P's attitude rows that a sample's turn has turned"""
    corrected: Array
    """(M,B,every,3) rotation vector of each correction, rad"""
    lean: Array
    """(M,B,3) half of the loss's gradient for a turn in b: estimated down x true down"""


def make_tape(steps: int, batch: int, every: int) -> Tape:
    """Room for so many steps."""
    shape = (steps, batch, every)
    turned, seen, z, k, factor, p, carried, corrected = (
        np.zeros((*shape, *w)) for w in ((3,), (6,), (6,), (6, 12), (6, 6), (12, 12), (3, 12), (3,))
    )
    return Tape(turned, seen, z, k, factor, p, carried, corrected, np.zeros((steps, batch, 3)))


@njit(cache=True, nogil=True)
def fly(windows, first, answer, tape, m, inputs, loss):
    """One step of the network from sample ``first``, with its last ``answer`` (B,72).

    Writes step ``m`` of the tape, the next ``inputs`` (B,90), and per window the squared sine of the tilt's error at the
    end (chord, rad²) into ``loss`` (B).
    """
    every = tape.z.shape[2]
    z, x, s, factor = np.zeros((2, 6)), np.zeros(12), np.zeros((2, 6, 6)), np.zeros((3, 6, 12))
    change = factor[2]
    for b in range(len(answer)):
        figures = Figures(*to_fixed_tuple(windows.figures[b], 15))
        samples = Samples(windows.gyro[b], windows.accel[b], windows.mag[b], windows.rows, windows.field_n)
        work = Work(z[0], z[1], x, windows.slow[b], s[0], s[1], factor[0], factor[1])
        model = AttitudeFilter(samples, figures, windows.state[b], windows.p[b], work, 0.0, 0.0)
        state = model.state
        inputs[b] = 0.0
        for c in range(6):
            for i in range(12):
                change[c, i] = np.exp(min(LIMIT, max(-LIMIT, np.float64(answer[b, 12 * c + i]))))
        for j in range(every):
            n = first + j
            dq = turn(state, samples.gyro[n], figures)
            carry(model.p, dq, figures)
            for i in range(3):
                for c in range(12):
                    tape.carried[m, b, j, i, c] = model.p[i, c] + figures.interval * model.p[3 + i, c]
            observe(model, n)
            inflate(model.p, samples.gyro[n], samples.accel[n], state, figures, work)
            kalman_gain(model.p, True, figures, work, work.k)
            weigh(work.k, work.z, work.x)
            gather(work.z, work.x, state, work.k, 1.0 / every, inputs[b])
            tape.turned[m, b, j, 0], tape.turned[m, b, j, 1], tape.turned[m, b, j, 2] = quat_to_rotvec(dq)
            for i in range(6):
                tape.seen[m, b, j, i], tape.z[m, b, j, i] = work.seen[i], work.z[i]
            for i in range(12):
                for c in range(12):
                    tape.p[m, b, j, i, c] = model.p[i, c]
            for c in range(6):
                for i in range(6):
                    tape.factor[m, b, j, c, i] = work.factor[c, i]
                for i in range(12):
                    tape.k[m, b, j, c, i] = work.k[c, i]
                    work.k[c, i] *= change[c, i]
            weigh(work.k, work.z, work.x)
            for i in range(3):
                tape.corrected[m, b, j, i] = work.x[i]
            add_correction(state, work.x)
        c = quat_to_matrix((state[0], state[1], state[2], state[3]))
        true = windows.down[b, first + every - 1]
        lean = cross(c[2], (true[0], true[1], true[2]))
        loss[b] = 0.0
        for i in range(3):
            tape.lean[m, b, i] = lean[i]
            loss[b] += (c[2][i] - true[i]) ** 2


@njit(cache=True, nogil=True)
def fly_back(windows, answer, tape, m, back, gradients):
    """The adjoint of `fly`: the gradients ``back`` for the errors (B,12) and the covariance (B,12,12) after step ``m`` become
    those for what was before it.

    ``gradients`` are those for what it gave, inputs (B,90) and loss (B), and (B,72), which gets that for the answer.
    """
    by_inputs, by_loss, by_answer = gradients
    every = tape.z.shape[2]
    share = 1.0 / every
    gx, own, gz = np.empty(12), np.empty(12), np.empty(6)
    change, by_gain, work = (
        np.empty((6, 12)),
        np.empty((6, 12)),
        (np.empty((6, 12)), np.empty((6, 12)), np.empty((6, 6)), np.empty((12, 12))),
    )
    for b in range(len(answer)):
        figures = Figures(*to_fixed_tuple(windows.figures[b], 15))
        by_answer[b] = 0.0
        g, lam, gi = back[0][b], back[1][b], by_inputs[b]
        for c in range(6):
            for i in range(12):
                change[c, i] = np.exp(min(LIMIT, max(-LIMIT, np.float64(answer[b, 12 * c + i]))))
        for i in range(3):
            g[i] += 2.0 * by_loss[b] * tape.lean[m, b, i]
        for j in range(every - 1, -1, -1):
            z, k, seen = tape.z[m, b, j], tape.k[m, b, j], tape.seen[m, b, j]
            r = tape.corrected[m, b, j]
            theta = (g[0], g[1], g[2])
            turned_back = matrix_rotate(quat_to_matrix(rotvec_to_quat((r[0], r[1], r[2]))), theta)
            by_turn = right_jacobian_transposed((r[0], r[1], r[2]), theta)
            for i in range(3):
                gx[i] = by_turn[i]
                g[i] = turned_back[i]
                own[i] = share * gi[6 + i]
            for i in range(3, 12):
                gx[i] = g[i]
                own[i] = share * gi[6 + i]
                g[i] += own[i]
            for c in range(6):
                total = share * gi[c]
                for i in range(12):
                    changed = k[c, i] * change[c, i]
                    total += gx[i] * changed + own[i] * k[c, i]
                    by_gain[c, i] = (gx[i] * change[c, i] + own[i]) * z[c] + share * gi[18 + 12 * c + i]
                    by_answer[b, 12 * c + i] += gx[i] * changed * z[c]
                gz[c] = total
            by_gravity = cross((seen[0], seen[1], seen[2]), (gz[0], gz[1], gz[2]))
            by_field = cross((seen[3], seen[4], seen[5]), (gz[3], gz[4], gz[5]))
            step = (seen, k, tape.factor[m, b, j], tape.p[m, b, j])
            by_h = update_back(lam, by_gain, step, work)
            for i in range(3):
                g[i] += by_gravity[i] + by_field[i] + by_h[i]
                g[6 + i] = (g[6 + i] + gz[i]) * figures.accel_decay
                g[9 + i] = (g[9 + i] - gz[3 + i]) * figures.mag_decay
            t = tape.turned[m, b, j]
            theta = (g[0], g[1], g[2])
            turn_matrix = quat_to_matrix(rotvec_to_quat((t[0], t[1], t[2])))
            by_p = turn_of_covariance(lam, tape.carried[m, b, j])
            carry_back(lam, turn_matrix, figures, work[3])
            turned_back = matrix_rotate(turn_matrix, theta)
            by_turn = right_jacobian_transposed(
                (t[0], t[1], t[2]), (theta[0] + by_p[0], theta[1] + by_p[1], theta[2] + by_p[2])
            )
            for i in range(3):
                g[i] = turned_back[i]
                g[3 + i] -= figures.interval * by_turn[i]
        for i in range(72):
            if abs(answer[b, i]) >= LIMIT:
                by_answer[b, i] = 0.0


@njit(cache=True, nogil=True, forceinline=True)
def right_jacobian_transposed(r, v):
    """J_r(r)' v, exp([r+dr x]) = exp([r x]) exp([J_r dr x]), to the third order in the angle: turns of a sample are small."""
    once = cross(r, v)
    twice = cross(r, once)
    return (
        v[0] + 0.5 * once[0] + twice[0] / 6.0,
        v[1] + 0.5 * once[1] + twice[1] / 6.0,
        v[2] + 0.5 * once[2] + twice[2] / 6.0,
    )


@njit(cache=True, nogil=True)
def update_back(lam, w, step, work):
    """Carry the covariance's gradient ``lam`` (12,12) back over an update; returns the gradient for a turn in b.

    ``w`` (6,12) is the gradient for the gain. With S = H P H' + R, M = 1 - K H and the updated covariance P+
    dK = M dP H' S^-1 + P+ dH' S^-1 - K dH K and dP+ = M dP M' - K dH P+ - (K dH P+)', so that the gradients are
    M' lam M + sym(M' W S^-1 H) for P and S^-1 W' P+ - K' W K' - 2 K' lam P+ for H.
    """
    seen, k, factor, p = step
    n, lk, kw, x = work
    for c in range(6):
        for d in range(6):
            total = 0.0
            for i in range(12):
                total += k[c, i] * w[d, i]
            kw[c, d] = total
        for i in range(12):
            total = 0.0
            for j in range(12):
                total += lam[i, j] * k[c, j]
            lk[c, i] = total
            n[c, i] = w[c, i]
        for d in range(c):
            for i in range(12):
                n[c, i] -= factor[c, d] * n[d, i]
        for i in range(12):
            n[c, i] /= factor[c, c]
    for c in range(5, -1, -1):
        for d in range(c + 1, 6):
            for i in range(12):
                n[c, i] -= factor[d, c] * n[d, i]
        for i in range(12):
            n[c, i] /= factor[c, c]
    by_seen = work_by_h(n, lk, kw, k, p)
    gravity = cross((by_seen[0], by_seen[1], by_seen[2]), (seen[0], seen[1], seen[2]))
    field = cross((by_seen[3], by_seen[4], by_seen[5]), (seen[3], seen[4], seen[5]))
    for i in range(12):
        for j in range(12):
            x[i, j] = lam[i, j]
    add_times_h(x, n, lk, seen)
    for c in range(6):
        for j in range(12):
            total = 0.0
            for i in range(12):
                total += k[c, i] * x[i, j]
            n[c, j] = total
    take_h_times(x, n, seen)
    for i in range(12):
        for j in range(12):
            lam[i, j] = 0.5 * (x[i, j] + x[j, i])
    return gravity[0] + field[0], gravity[1] + field[1], gravity[2] + field[2]


@njit(cache=True, nogil=True)
def work_by_h(n, lk, kw, k, p):
    """Gradient for the six numbers of gravity and field in H = [[g x], 0, -1, 0; [m x], 0, 0, 1]."""
    h = np.empty((6, 3))
    for c in range(6):
        for a in range(3):
            total = 0.0
            for i in range(12):
                total += (n[c, i] - 2.0 * lk[c, i]) * p[i, a]
            for d in range(6):
                total -= kw[c, d] * k[d, a]
            h[c, a] = total
    return (
        h[2, 1] - h[1, 2],
        h[0, 2] - h[2, 0],
        h[1, 0] - h[0, 1],
        h[5, 1] - h[4, 2],
        h[3, 2] - h[5, 0],
        h[4, 0] - h[3, 1],
    )


@njit(cache=True, nogil=True)
def add_times_h(x, n, lk, seen):
    """x += (n - lk)' H."""
    for i in range(12):
        for c in (0, 3):
            f0, f1, f2 = n[c, i] - lk[c, i], n[c + 1, i] - lk[c + 1, i], n[c + 2, i] - lk[c + 2, i]
            x[i, 0] += f1 * seen[c + 2] - f2 * seen[c + 1]
            x[i, 1] += f2 * seen[c] - f0 * seen[c + 2]
            x[i, 2] += f0 * seen[c + 1] - f1 * seen[c]
            sign, first = (-1.0, 6) if c == 0 else (1.0, 9)
            x[i, first] += sign * f0
            x[i, first + 1] += sign * f1
            x[i, first + 2] += sign * f2


@njit(cache=True, nogil=True)
def take_h_times(x, n, seen):
    """x -= H' n."""
    for c in (0, 3):
        for j in range(12):
            f0, f1, f2 = n[c, j], n[c + 1, j], n[c + 2, j]
            x[0, j] -= f1 * seen[c + 2] - f2 * seen[c + 1]
            x[1, j] -= f2 * seen[c] - f0 * seen[c + 2]
            x[2, j] -= f0 * seen[c + 1] - f1 * seen[c]
            sign, first = (-1.0, 6) if c == 0 else (1.0, 9)
            x[first, j] -= sign * f0
            x[first + 1, j] -= sign * f1
            x[first + 2, j] -= sign * f2


@njit(cache=True, nogil=True)
def turn_of_covariance(lam, carried):
    """Gradient for a turn of the rows ``carried`` (3,12) of P, and of its columns alike."""
    x = y = z = 0.0
    for j in range(12):
        x -= 2.0 * (carried[1, j] * lam[2, j] - carried[2, j] * lam[1, j])
        y -= 2.0 * (carried[2, j] * lam[0, j] - carried[0, j] * lam[2, j])
        z -= 2.0 * (carried[0, j] * lam[1, j] - carried[1, j] * lam[0, j])
    return x, y, z


@njit(cache=True, nogil=True)
def carry_back(lam, turned, figures, x):
    """lam = Phi' lam Phi for the sample's turn (matrix) in b: theta' = turned' theta - dt db, the others decay."""
    dt = figures.interval
    for i in range(12):
        l0, l1, l2 = lam[i, 0], lam[i, 1], lam[i, 2]
        for j in range(3):
            x[i, j] = l0 * turned[j][0] + l1 * turned[j][1] + l2 * turned[j][2]
            x[i, 3 + j] = figures.bias_decay * lam[i, 3 + j] - dt * lam[i, j]
            x[i, 6 + j] = figures.accel_decay * lam[i, 6 + j]
            x[i, 9 + j] = figures.mag_decay * lam[i, 9 + j]
    for i in range(12):
        x0, x1, x2 = x[0, i], x[1, i], x[2, i]
        for j in range(3):
            lam[j, i] = turned[j][0] * x0 + turned[j][1] * x1 + turned[j][2] * x2
            lam[3 + j, i] = figures.bias_decay * x[3 + j, i] - dt * x[j, i]
            lam[6 + j, i] = figures.accel_decay * x[6 + j, i]
            lam[9 + j, i] = figures.mag_decay * x[9 + j, i]
