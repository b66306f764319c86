"""Interacting multiple models: mixing, mode probabilities, moment matching, and the loop over a whole log. Kernels only.

Blom & Bar-Shalom, *IEEE TAC* 33 (1988), with the branches of the IMM-RSTEKF paper (2023). States, models and ``place``
as in `motion_models`. Branches interact when a fix is processed; between fixes they run on their own with the predicted
mode probabilities, which changes nothing in their weighted mean. Likelihoods are logarithms and use the six
measurements that all branches share; angles are averaged as deviations from the most probable branch.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from estimators import kalman
from estimators.direct_kernels import COMMON, SAME_TIME, correct, imu_corrections, predict, store
from estimators.motion_models import N_STATES
from testbed import earth
from testbed.rotations import wrap

Array = NDArray[np.float64]


class Aiding(NamedTuple):
    """When and how far the constant-velocity branch believes its own roll, pitch and yaw."""

    tilt_variance: float
    course_variance: float
    gravity_tolerance: float
    rate_limit: float
    minimum_speed: float


@njit(cache=True)
def log_probabilities(prior, log_likelihood, posterior):
    """``posterior`` (B,) = prior * likelihood, normalised, from log likelihoods of any size."""
    best = -np.inf
    for j in range(prior.shape[0]):
        posterior[j] = np.log(prior[j]) + log_likelihood[j] if prior[j] > 0.0 else -np.inf
        best = max(best, posterior[j])
    total = 0.0
    for j in range(prior.shape[0]):
        posterior[j] = np.exp(posterior[j] - best)
        total += posterior[j]
    for j in range(prior.shape[0]):
        posterior[j] /= total


@njit(cache=True)
def mixture_mean(weights, states, mean):
    """Weighted ``mean`` (15,) of ``states`` (B,15), whose angles are first moved within pi of the likeliest branch's."""
    best = np.argmax(weights)
    for i in range(N_STATES):
        mean[i] = states[best, i]
    for j in range(weights.shape[0]):
        if j != best:
            for i in range(6, 9):
                states[j, i] = states[best, i] + wrap(states[j, i] - states[best, i])
            for i in range(N_STATES):
                mean[i] += weights[j] * (states[j, i] - states[best, i])


@njit(cache=True)
def combine(weights, states, covariances, mean, covariance):
    """Moment match of B Gaussians: ``mean`` (15,), ``covariance`` (15,15) with the spread of the means in it."""
    mixture_mean(weights, states, mean)
    for a in range(N_STATES):
        for b in range(N_STATES):
            covariance[a, b] = 0.0
    for j in range(weights.shape[0]):
        w = weights[j]
        if w > 0.0:
            for a in range(N_STATES):
                spread = w * (states[j, a] - mean[a])
                for b in range(N_STATES):
                    covariance[a, b] += w * covariances[j, a, b] + spread * (states[j, b] - mean[b])
    for i in range(6, 9):
        mean[i] = wrap(mean[i])


@njit(cache=True)
def combine_stored(weights, states, covariances, mean, covariance):
    """`combine` for what a row of output takes: the diagonal and the attitude block of ``covariance``."""
    mixture_mean(weights, states, mean)
    for a in range(N_STATES):
        last = 9 if 6 <= a < 9 else a + 1
        for b in range(a, last):
            total = 0.0
            for j in range(weights.shape[0]):
                spread = (states[j, a] - mean[a]) * (states[j, b] - mean[b])
                total += weights[j] * (covariances[j, a, b] + spread)
            covariance[a, b] = total
    for i in range(6, 9):
        mean[i] = wrap(mean[i])


@njit(cache=True)
def mix(probability, transition, states, covariances, predicted, weights, mixed_states, mixed_covariances):
    """Interaction in place: every branch restarts from the mixture that its model sees; ``predicted`` (B,) = c."""
    count = probability.shape[0]
    for j in range(count):
        total = 0.0
        for i in range(count):
            weights[i] = transition[i, j] * probability[i]
            total += weights[i]
        predicted[j] = total
        if total > 0.0:
            for i in range(count):
                weights[i] /= total
            combine(weights, states, covariances, mixed_states[j], mixed_covariances[j])
        else:
            mixed_states[j] = states[j]
            mixed_covariances[j] = covariances[j]
    states[:] = mixed_states
    covariances[:] = mixed_covariances


@njit(cache=True)
def aid_with_angles(x, p, imu, velocity, velocity_variance, setting, aiding, residual, h, r, covariance, scratch):
    """The constant-velocity branch's roll and pitch from gravity and yaw from the course, where they are valid.

    A second block after the six common measurements, which is the update with all nine since their noises are
    independent. The sensitivity to the accelerometer bias, which the paper leaves out, is kept. Valid: specific force
    within a tolerance of gravity and body rates below a limit (no manoeuvre); for yaw also a least speed. Elsewhere the
    paper gives them a variance so large that they have no weight; here they are left out.
    """
    wx, wy, wz = imu[0] - x[12], imu[1] - x[13], imu[2] - x[14]
    fx, fy, fz = imu[3] - x[9], imu[4] - x[10], imu[5] - x[11]
    g = earth.gravity(setting.place[0] + x[0] / setting.place[2], setting.place[1] - x[2])
    square = fx * fx + fy * fy + fz * fz
    limit = aiding.rate_limit
    if wx * wx + wy * wy + wz * wz > limit * limit or abs(np.sqrt(square) - g) > aiding.gravity_tolerance * g:
        return
    h[:] = 0.0
    yz = fy * fy + fz * fz
    root = np.sqrt(yz)
    if root < 0.1 * g:
        return
    residual[0] = wrap(np.arctan2(-fy, -fz) - x[6])
    h[0, 6], h[0, 10], h[0, 11] = 1.0, fz / yz, -fy / yz
    residual[1] = np.arctan2(fx, root) - x[7]
    h[1, 7], h[1, 9] = 1.0, root / square
    h[1, 10], h[1, 11] = -fx * fy / (root * square), -fx * fz / (root * square)
    r[0] = aiding.tilt_variance
    r[1] = aiding.tilt_variance
    count = 2
    speed_square = velocity[0] * velocity[0] + velocity[1] * velocity[1]
    if speed_square > aiding.minimum_speed * aiding.minimum_speed:
        residual[2] = wrap(np.arctan2(velocity[1], velocity[0]) - x[8])
        h[2, 8] = 1.0
        r[2] = aiding.course_variance + max(velocity_variance[0], velocity_variance[1]) / speed_square
        count = 3
    kalman.update(x, p, residual[:count], h[:count], r, covariance, scratch)
    for i in range(6, 9):
        x[i] = wrap(x[i])


@njit(cache=True)
def mixture_innovation(weights, residuals, covariances, residual, covariance):
    """Innovation and its covariance (6,6) of the mixture of branches, whose predictions differ."""
    residual[:] = 0.0
    covariance[:] = 0.0
    for j in range(weights.shape[0]):
        for a in range(COMMON):
            residual[a] += weights[j] * residuals[j, a]
    for j in range(weights.shape[0]):
        for a in range(COMMON):
            for b in range(COMMON):
                spread = (residuals[j, a] - residual[a]) * (residuals[j, b] - residual[b])
                covariance[a, b] += weights[j] * (covariances[j, a, b] + spread)


@njit(cache=True)
def hold_acceleration(velocity, last, elapsed, manoeuvre_time, held):
    """The acceleration (3,) of the `singer` model: the change of the estimated velocity between fixes, smoothed."""
    if elapsed > SAME_TIME:
        gain = 1.0 - np.exp(-elapsed / manoeuvre_time)
        for i in range(3):
            held[i] += gain * ((velocity[i] - last[i]) / elapsed - held[i])
    for i in range(3):
        last[i] = velocity[i]


@njit(cache=True)
def filter_log(
    start, t, imu, gnss_t, gnss_z, gnss_r, x, p, branches, probability, transition, setting, options, every, out
):
    """B interacting filters over a whole log, all from ``x``, ``p``, which are overwritten.

    ``branches`` = (models (B,), filters (B,), aided (B,), noise (B,13)); ``probability`` (B,) initial and overwritten;
    ``options`` = (tracking, Aiding, manoeuvre time (s)); ``out`` as `direct_kernels.filter_log` with figures (M,3,B):
    mode probability, test statistic, fading factor.
    """
    models, filters, aided, noise = branches
    tracking, aiding, manoeuvre_time = options
    states, variances, snapshots, residuals, covariances, figures = out
    count = models.shape[0]
    xs, ps, memory = np.empty((count, N_STATES)), np.empty((count, N_STATES, N_STATES)), np.zeros((count, COMMON))
    mixed_xs, mixed_ps = np.empty_like(xs), np.empty_like(ps)
    for j in range(count):
        xs[j] = x
        ps[j] = p
    phi, work = np.eye(N_STATES), np.empty((N_STATES + 1, N_STATES))
    corrections, part = np.zeros(6), np.zeros(6)
    held, push, last = np.zeros(3), np.zeros(3), x[3:6].copy()
    branch_residual, branch_covariance = np.empty((count, COMMON)), np.empty((count, COMMON, COMMON))
    white, factor = np.empty(COMMON), np.empty((COMMON, COMMON))
    h, scratch = np.zeros((COMMON, N_STATES)), np.empty((COMMON + 1, N_STATES))
    angles = (np.empty(3), np.zeros((3, N_STATES)), np.empty(3), np.empty((3, 3)), scratch)
    predicted, weights, likelihood = np.empty(count), np.empty(count), np.empty(count)
    mix(probability, transition, xs, ps, predicted, weights, mixed_xs, mixed_ps)
    now, g, last_fix = start, 0, start
    for k in range(t.shape[0]):
        whole = t[k] - now
        imu_corrections(imu, k, whole, x, corrections)
        while True:
            fix = g < gnss_t.shape[0] and gnss_t[g] <= t[k] + SAME_TIME
            dt = min(gnss_t[g], t[k]) - now if fix else t[k] - now
            if dt > SAME_TIME:
                for i in range(6):
                    part[i] = corrections[i] * dt / whole
                fade = np.exp((last_fix - now) / manoeuvre_time)
                for i in range(3):
                    push[i] = held[i] * fade
                for j in range(count):
                    predict(models[j], xs[j], ps[j], imu[k], part, dt, setting, push, noise[j], phi, work)
                now += dt
            if not fix:
                break
            z, r = gnss_z[g], gnss_r[g]
            for j in range(count):
                buffers = (branch_residual[j], h, branch_covariance[j], factor, white, scratch)
                theta, likelihood[j], fading = correct(
                    filters[j], xs[j], ps[j], z, r, imu[k], setting, tracking, g, memory[j], buffers
                )
                figures[g, 1, j], figures[g, 2, j] = theta, fading
                if aided[j]:
                    aid_with_angles(
                        xs[j], ps[j], imu[k], z[3:], r[3:], setting, aiding,
                        angles[0], angles[1], angles[2], angles[3], angles[4],
                    )  # fmt: skip
            mixture_innovation(predicted, branch_residual, branch_covariance, residuals[g], covariances[g])
            log_probabilities(predicted, likelihood, probability)
            figures[g, 0] = probability
            mix(probability, transition, xs, ps, predicted, weights, mixed_xs, mixed_ps)
            mixture_mean(predicted, xs, x)
            hold_acceleration(x[3:6], last, now - last_fix, manoeuvre_time, held)
            last_fix = now
            g += 1
        now = t[k]
        combine_stored(predicted, xs, ps, x, p)
        store(k, x, p, states, variances)
        if (k + 1) % every == 0:
            combine(predicted, xs, ps, x, snapshots[(k + 1) // every - 1])
    return g
