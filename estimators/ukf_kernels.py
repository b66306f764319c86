"""The unscented transform and the direct unscented Kalman filter over a whole log. Kernels only.

Julier & Uhlmann, *Proc. IEEE* 92 (2004); symmetric sigma points, scaled form, additive noise, as the IMM-RSTEKF paper
(2023) sets it beside its own filter. States, models and ``place`` as in `motion_models`; angles are averaged as
deviations from the central point, so that no average crosses ±pi.
"""

from __future__ import annotations

import numpy as np
from numba import njit

from estimators.direct_kernels import COMMON, SAME_TIME, antenna, imu_corrections, store
from estimators.motion_models import ACCELERATED, N_STATES, add_process_noise, advance, transition
from estimators.strong_tracking import whiten
from testbed.rotations import wrap


@njit(cache=True)
def cholesky(p, factor):
    """Lower ``factor`` with factor factor' = P for a positive semidefinite P: a column without variance is zero."""
    n = p.shape[0]
    for j in range(n):
        for i in range(j):
            factor[i, j] = 0.0
        pivot = p[j, j]
        for k in range(j):
            pivot -= factor[j, k] * factor[j, k]
        root = np.sqrt(pivot) if pivot > 1e-14 * p[j, j] or np.isnan(pivot) else 0.0
        factor[j, j] = root
        for i in range(j + 1, n):
            total = p[i, j]
            for k in range(j):
                total -= factor[i, k] * factor[j, k]
            factor[i, j] = total / root if root != 0.0 else 0.0


@njit(cache=True)
def sigma_points(x, p, spread, factor, points):
    """``points`` (2n+1,n): x, then x plus and minus ``spread`` times each column of the Cholesky factor of P."""
    n = x.shape[0]
    cholesky(p, factor)
    for i in range(n):
        points[0, i] = x[i]
    for j in range(n):
        for i in range(n):
            step = spread * factor[i, j]
            points[1 + j, i] = x[i] + step
            points[1 + n + j, i] = x[i] - step


@njit(cache=True)
def unscented_moments(points, weights, first_angle, last_angle, mean, covariance):
    """Weighted ``mean`` (m,) and ``covariance`` (m,m) of ``points``, which become deviations from the mean, in place.

    ``weights`` = (central for the mean, central for the covariance, every other). Columns from ``first_angle`` up to,
    not including, ``last_angle`` are angles (rad).
    """
    count, m = points.shape
    shift = np.zeros(m)
    for j in range(m):
        shift[j] = 0.0
        mean[j] = points[0, j]
    for s in range(count):
        for j in range(m):
            points[s, j] -= mean[j]
        for j in range(first_angle, last_angle):
            points[s, j] = wrap(points[s, j])
        if s > 0:
            for j in range(m):
                shift[j] += weights[2] * points[s, j]
    for j in range(m):
        mean[j] += shift[j]
    for i in range(m):
        for j in range(m):
            covariance[i, j] = 0.0
    for s in range(count):
        weight = weights[1] if s == 0 else weights[2]
        for j in range(m):
            points[s, j] -= shift[j]
        for i in range(m):
            a = weight * points[s, i]
            for j in range(m):
                covariance[i, j] += a * points[s, j]
    for j in range(first_angle, last_angle):
        mean[j] = wrap(mean[j])


@njit(cache=True)
def unscented_weights(n, alpha, beta, kappa):
    """Spread (in Cholesky columns) and weights for `unscented_moments` of an n-dimensional state."""
    scale = alpha * alpha * (n + kappa)
    central = 1.0 - n / scale
    return np.sqrt(scale), (central, central + 1.0 - alpha * alpha + beta, 0.5 / scale)


@njit(cache=True)
def unscented_correct(x, p, residual, deviations, readings, weights, covariance, factor, scratch):
    """Kalman update in place from state ``deviations`` (2n+1,n) and measurement deviations ``readings`` (2n+1,m).

    ``covariance`` (m,m) is S with the noise in it and ``factor`` its Cholesky factor; ``scratch`` (m,n).
    """
    count, n = deviations.shape
    m = readings.shape[1]
    # scratch = factor^-1 (cross covariance)', so that P loses scratch' scratch: symmetric by construction.
    for a in range(m):
        for i in range(n):
            scratch[a, i] = 0.0
    for s in range(count):
        weight = weights[1] if s == 0 else weights[2]
        for a in range(m):
            for i in range(n):
                scratch[a, i] += weight * readings[s, a] * deviations[s, i]
    for a in range(m):
        for b in range(a):
            for i in range(n):
                scratch[a, i] -= factor[a, b] * scratch[b, i]
        for i in range(n):
            scratch[a, i] /= factor[a, a]
    white = np.empty(m)
    whiten(covariance, residual, m, factor, white)
    for a in range(m):
        for i in range(n):
            x[i] += scratch[a, i] * white[a]
    for i in range(n):
        for j in range(i + 1):
            total = p[i, j]
            for a in range(m):
                total -= scratch[a, i] * scratch[a, j]
            p[i, j] = total
            p[j, i] = total


@njit(cache=True)
def predict(x, p, imu, corrections, dt, setting, noise, shape, buffers):
    """State and covariance ``dt`` later, in place: every sigma point through the accelerated model."""
    points, moved, factor, phi, held = buffers
    spread, weights = shape
    transition(ACCELERATED, x, imu, dt, setting, phi)
    sigma_points(x, p, spread, factor, points)
    for s in range(points.shape[0]):
        advance(ACCELERATED, points[s], imu, corrections, dt, setting, held, moved[s])
    unscented_moments(moved, weights, 6, 9, x, p)
    add_process_noise(p, phi, noise, dt)


@njit(cache=True)
def correct(x, p, z, r, imu, setting, shape, buffers, readings, residual, covariance):
    """GNSS update in place with fresh sigma points. Returns the test statistic v' S^-1 v."""
    points, _, factor, _, _ = buffers
    spread, weights = shape
    sigma_points(x, p, spread, factor, points)
    for s in range(points.shape[0]):
        antenna(points[s], imu, setting, readings[s])
    predicted = np.empty(COMMON)
    unscented_moments(readings, weights, 0, 0, predicted, covariance)
    for i in range(COMMON):
        covariance[i, i] += r[i]
        residual[i] = z[i] - predicted[i]
    for s in range(points.shape[0]):
        for i in range(N_STATES):
            points[s, i] -= x[i]
    root, white, scratch = np.empty((COMMON, COMMON)), np.empty(COMMON), np.empty((COMMON, N_STATES))
    theta, _ = whiten(covariance, residual, COMMON, root, white)
    unscented_correct(x, p, residual, points, readings, weights, covariance, root, scratch)
    for i in range(6, 9):
        x[i] = wrap(x[i])
    return theta


@njit(cache=True)
def filter_log(start, t, imu, gnss_t, gnss_z, gnss_r, x, p, noise, setting, parameters, every, out):
    """The unscented filter over a whole log; arguments and ``out`` as `direct_kernels.filter_log`.

    ``parameters`` = (alpha, beta, kappa) of the scaled unscented transform. The figures have one column, theta.
    """
    states, variances, snapshots, residuals, covariances, figures = out
    shape = unscented_weights(N_STATES, parameters[0], parameters[1], parameters[2])
    count = 2 * N_STATES + 1
    buffers = (
        np.empty((count, N_STATES)),
        np.empty((count, N_STATES)),
        np.empty((N_STATES, N_STATES)),
        np.zeros((N_STATES, N_STATES)),
        np.zeros(3),
    )
    readings, corrections, part = np.empty((count, COMMON)), np.zeros(6), np.zeros(6)
    now, g = start, 0
    for k in range(t.shape[0]):
        whole = t[k] - now
        imu_corrections(imu, k, whole, x, corrections)
        while True:
            fix = g < gnss_t.shape[0] and gnss_t[g] <= t[k] + SAME_TIME
            dt = min(gnss_t[g], t[k]) - now if fix else t[k] - now
            if dt > SAME_TIME:
                for i in range(6):
                    part[i] = corrections[i] * dt / whole
                predict(x, p, imu[k], part, dt, setting, noise, shape, buffers)
                now += dt
            if not fix:
                break
            figures[g, 0] = correct(
                x, p, gnss_z[g], gnss_r[g], imu[k], setting, shape, buffers, readings, residuals[g], covariances[g]
            )
            g += 1
        now = t[k]
        store(k, x, p, states, variances)
        if (k + 1) % every == 0:
            snapshots[(k + 1) // every - 1] = p
    return g
