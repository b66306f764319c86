"""Interacting multiple models: mixing, mode probabilities, moment matching, and the bank's steps on a time line.

Blom & Bar-Shalom, *IEEE TAC* 33 (1988), with the branches of the IMM-RSTEKF paper (2023). States, models and ``place``
as in `motion_models`. Branches interact when a fix is processed; between fixes they run on their own with the predicted
mode probabilities, which changes nothing in their weighted mean. Likelihoods are logarithms and use the six
measurements that all branches share; angles are averaged as deviations from the most probable branch. Kernels only.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from estimators.core.recording import note_update
from estimators.core.timeline import SAME_TIME, inner, steps
from estimators.core.update import update
from estimators.methods.body_axes import Axes, may_turn, near_pole, turn_noise, turn_setting, turn_state
from estimators.methods.direct_kernels import (
    MEASUREMENTS,
    Inputs,
    Tracking,
    Work,
    begin,
    carry,
    stretch,
    take_fix,
)
from estimators.methods.direct_kernels import record as record_state
from estimators.methods.motion_models import N_STATES, Motion, Setting
from testbed.kernels import njit
from testbed.kernels.lanes import alike, any_of, select
from testbed.physics import earth
from testbed.physics.rotations import wrap

Array = NDArray[np.float64]


class Aiding(NamedTuple):
    """When and how far the constant-velocity branch believes its own roll, pitch and yaw."""

    tilt_variance: float
    course_variance: float
    gravity_tolerance: float
    rate_limit: float
    minimum_speed: float


class Branches(NamedTuple):
    """The B filters of a bank: what each believes and remembers, the last three overwritten."""

    models: NDArray[np.int64]
    filters: NDArray[np.int64]
    aided: NDArray[np.bool_]
    """Whether a branch takes its own angles as measurements."""
    noise: Array
    """(B,13): see `motion_models.add_process_noise`."""
    states: Array
    """(B,15)"""
    covariances: Array
    """(B,15,15)"""
    memory: Array
    """(B,7): see `direct_kernels.Tracking`."""


class Modes(NamedTuple):
    """Which branch is right: probabilities, overwritten but for the transition."""

    transition: Array
    """(B,B)"""
    probability: Array
    """(B,) after the last fix."""
    predicted: Array
    """(B,) for the next one: the weights between fixes."""


class Mixing(NamedTuple):
    """Arrays that are overwritten at every fix."""

    weights: Array
    """(B,)"""
    states: Array
    """(B,15)"""
    covariances: Array
    """(B,15,15)"""
    likelihood: Array
    """(B,) logarithms."""
    residuals: Array
    """(B,6)"""
    s: Array
    """(B,6,6)"""


class Acceleration(NamedTuple):
    """What the `singer` model carries on: an acceleration that fades from fix to fix."""

    time_constant: float
    """s"""
    held: Array
    """(3,) at the last fix, m/s² in n."""
    now: Array
    """(3,) in the present stretch."""
    last: Array
    """(3,) velocity at the last fix."""
    since: Array
    """(1,) time since then, s."""


class Bank(NamedTuple):
    """Interacting filters on a log, for `estimators.core.timeline.walk`. ``state`` and ``p`` are those of the mixture."""

    inputs: Inputs
    setting: Setting
    branches: Branches
    modes: Modes
    options: tuple[Tracking, Aiding]
    """Strong tracking (with a filter and memory of its own for each branch), angles."""
    acceleration: Acceleration
    state: Array
    p: Array
    mixing: Mixing
    work: Work
    axes: Axes
    keep: Any
    figures: Array
    """(E,3,B): mode probability, test statistic, fading factor of each fix, overwritten."""


@njit(cache=True, nogil=True, _nrt=False)
def log_probabilities(prior, log_likelihood, posterior):
    """``posterior`` (B,) = prior * likelihood, normalised, from log likelihoods of any size."""
    best = alike(prior[0], -np.inf)
    for j in range(prior.shape[0]):
        posterior[j] = select(prior[j] > 0.0, np.log(prior[j]) + log_likelihood[j], -np.inf)
        best = select(posterior[j] > best, posterior[j], best)
    total = alike(best, 0.0)
    for j in range(prior.shape[0]):
        posterior[j] = np.exp(posterior[j] - best)
        total += posterior[j]
    for j in range(prior.shape[0]):
        posterior[j] /= total


@njit(cache=True, nogil=True, _nrt=False)
def mixture_mean(weights, states, mean):
    """Weighted ``mean`` (15,) of ``states`` (B,15), whose angles are first moved within pi of the likeliest branch's."""
    for i in range(N_STATES):
        most, best = weights[0], states[0, i]
        for j in range(1, weights.shape[0]):
            likelier = weights[j] > most
            most, best = select(likelier, weights[j], most), select(likelier, states[j, i], best)
        mean[i] = best
        for j in range(weights.shape[0]):
            if 6 <= i < 9:
                states[j, i] = best + wrap(states[j, i] - best)
            mean[i] += weights[j] * (states[j, i] - best)


@njit(cache=True, nogil=True, _nrt=False)
def combine(weights, states, covariances, mean, covariance):
    """Moment match of B Gaussians: ``mean`` (15,), ``covariance`` (15,15) with the spread of the means in it."""
    mixture_mean(weights, states, mean)
    for a in range(N_STATES):
        for b in range(N_STATES):
            covariance[a, b] = 0.0
    for j in range(weights.shape[0]):
        w = weights[j]
        if any_of(w > 0.0):
            for a in range(N_STATES):
                spread = w * (states[j, a] - mean[a])
                for b in range(N_STATES):
                    added = w * covariances[j, a, b] + spread * (states[j, b] - mean[b])
                    covariance[a, b] += select(w > 0.0, added, 0.0)
    for i in range(6, 9):
        mean[i] = wrap(mean[i])


@njit(cache=True, nogil=True, _nrt=False)
def combine_stored(weights, states, covariances, mean, covariance):
    """`combine` for what a row of output takes: the diagonal and the attitude block of ``covariance``."""
    mixture_mean(weights, states, mean)
    for a in range(N_STATES):
        last = 9 if 6 <= a < 9 else a + 1
        for b in range(a, last):
            total = alike(weights[0], 0.0)
            for j in range(weights.shape[0]):
                spread = (states[j, a] - mean[a]) * (states[j, b] - mean[b])
                total += weights[j] * (covariances[j, a, b] + spread)
            covariance[a, b] = total
    for i in range(6, 9):
        mean[i] = wrap(mean[i])


@njit(cache=True, nogil=True, _nrt=False)
def put_row(target, source):
    """Copy a row; a slice assigned to a slice would ask for memory."""
    for i in range(source.shape[0]):
        target[i] = source[i]


@njit(cache=True, nogil=True, _nrt=False)
def put_rows(target, source):
    """Copy a matrix."""
    for i in range(source.shape[0]):
        put_row(target[i], source[i])


@njit(cache=True, nogil=True, _nrt=False)
def mix(probability, transition, states, covariances, predicted, weights, mixed_states, mixed_covariances):
    """Interaction in place: every branch restarts from the mixture that its model sees; ``predicted`` (B,) = c."""
    count = probability.shape[0]
    for j in range(count):
        total = alike(probability[0], 0.0)
        for i in range(count):
            weights[i] = transition[i, j] * probability[i]
            total += weights[i]
        predicted[j] = total
        reached = total > 0.0
        for i in range(count):
            weights[i] = select(reached, weights[i] / select(reached, total, 1.0), 1.0 if i == j else 0.0)
        combine(weights, states, covariances, mixed_states[j], mixed_covariances[j])
    put_rows(states, mixed_states)
    for j in range(count):
        put_rows(covariances[j], mixed_covariances[j])


@njit(cache=True, nogil=True, _nrt=False)
def aid_with_angles(x, p, seen, setting, aiding, work):
    """The constant-velocity branch's roll and pitch from gravity and yaw from the course, where they are valid.

    ``seen`` as in `direct_kernels.take_fix`. A second block after the six common measurements, which is the update with all
    nine since their noises are independent. The sensitivity to the accelerometer bias, which the paper leaves out, is
    kept. Valid: specific force within a tolerance of gravity and body rates below a limit (no manoeuvre); for yaw also a
    least speed. Elsewhere the paper gives them a variance so large that they have no weight; here they are left out.
    """
    z, variances, imu = seen
    wx, wy, wz = imu[0] - x[12], imu[1] - x[13], imu[2] - x[14]
    fx, fy, fz = imu[3] - x[9], imu[4] - x[10], imu[5] - x[11]
    g = earth.gravity(setting.place[0] + x[0] / setting.place[2], setting.place[1] - x[2])
    square = fx * fx + fy * fy + fz * fz
    limit = aiding.rate_limit
    slow = wx * wx + wy * wy + wz * wz <= limit * limit
    yz = fy * fy + fz * fz
    root = np.sqrt(yz)
    valid = slow & (abs(np.sqrt(square) - g) <= aiding.gravity_tolerance * g) & (root >= 0.1 * g)
    if not any_of(valid):
        return
    residual, h, r = work.white, work.h, work.r
    h[:] = 0.0
    # without a weight in H an update leaves all as it is, to the last bit
    one, by_yz, by_all = select(valid, 1.0, 0.0), select(valid, 1.0 / yz, 0.0), select(valid, 1.0 / square, 0.0)
    by_both = by_all * select(valid, 1.0 / root, 0.0)
    residual[0] = select(valid, wrap(np.arctan2(-fy, -fz) - x[6]), 0.0)
    h[0, 6], h[0, 10], h[0, 11] = one, fz * by_yz, -fy * by_yz
    residual[1] = select(valid, np.arctan2(fx, root) - x[7], 0.0)
    h[1, 7], h[1, 9] = one, root * by_all
    h[1, 10], h[1, 11] = -fx * fy * by_both, -fx * fz * by_both
    r[0] = aiding.tilt_variance
    r[1] = aiding.tilt_variance
    count = 2
    speed_square = z[3] * z[3] + z[4] * z[4]
    moving = valid & (speed_square > aiding.minimum_speed * aiding.minimum_speed)
    if any_of(moving):
        residual[2] = select(moving, wrap(np.arctan2(z[4], z[3]) - x[8]), 0.0)
        h[2, 8] = select(moving, 1.0, 0.0)
        worst = select(variances[3] > variances[4], variances[3], variances[4])
        r[2] = select(moving, aiding.course_variance + worst / speed_square, 1.0)
        count = 3
    update(x, p, residual[:count], h[:count], r[:count], work.scalars, work.scratch)
    for i in range(6, 9):
        x[i] = select(valid, wrap(x[i]), x[i])


@njit(cache=True, nogil=True, _nrt=False, forceinline=True)
def without_course(aiding):
    """The same, but for the yaw, which no speed is enough for."""
    return Aiding(aiding.tilt_variance, aiding.course_variance, aiding.gravity_tolerance, aiding.rate_limit, np.inf)


@njit(cache=True, nogil=True, _nrt=False)
def mixture_innovation(weights, residuals, covariances, residual, covariance):
    """Innovation and its covariance (6,6) of the mixture of branches, whose predictions differ."""
    residual[:] = 0.0
    covariance[:] = 0.0
    for j in range(weights.shape[0]):
        for a in range(MEASUREMENTS):
            residual[a] += weights[j] * residuals[j, a]
    for j in range(weights.shape[0]):
        for a in range(MEASUREMENTS):
            for b in range(MEASUREMENTS):
                spread = (residuals[j, a] - residual[a]) * (residuals[j, b] - residual[b])
                covariance[a, b] += weights[j] * (covariances[j, a, b] + spread)


@njit(cache=True, nogil=True, _nrt=False)
def hold_acceleration(acceleration, velocity):
    """At a fix: the change of the estimated velocity (3,) since the last one, smoothed."""
    held, last, elapsed = acceleration.held, acceleration.last, acceleration.since[0]
    if elapsed > SAME_TIME:
        gain = 1.0 - np.exp(-elapsed / acceleration.time_constant)
        for i in range(3):
            held[i] += gain * ((velocity[i] - last[i]) / elapsed - held[i])
    for i in range(3):
        last[i] = velocity[i]
    acceleration.since[0] = 0.0


@njit(cache=True, nogil=True, _nrt=False)
def interact(modes, branches, mixing):
    """`mix` the branches of a bank in place."""
    states, covariances = branches.states, branches.covariances
    work = mixing.weights, mixing.states, mixing.covariances
    mix(modes.probability, modes.transition, states, covariances, modes.predicted, work[0], work[1], work[2])


@inner
def predict(model, k, dt, part):
    """Carry every branch ``dt`` (s) on within IMU sample ``k``."""
    step, branches, acceleration, work = stretch(model, k, dt, part), model.branches, model.acceleration, model.work
    fade = np.exp(-acceleration.since[0] / acceleration.time_constant)
    for i in range(3):
        acceleration.now[i] = acceleration.held[i] * fade
    for j in range(branches.models.shape[0]):
        motion = Motion(branches.models[j], model.setting, branches.noise[j], acceleration.now)
        carry(motion, branches.states[j], branches.covariances[j], step, work.phi, work.rows)
    acceleration.since[0] += dt


@inner
def correct(model, k, e):
    """Use fix ``e``, which lies within IMU sample ``k``, in every branch; then the branches interact."""
    inputs, branches, modes, mixing, work = model.inputs, model.branches, model.modes, model.mixing, model.work
    tracking, aiding = model.options
    seen, figures = (inputs.z[e], inputs.r[e], model.axes.samples[1]), model.figures[e]
    if model.axes.turned[0]:  # the course is an angle of b only
        aiding = without_course(aiding)
    s = work.s.reshape((MEASUREMENTS, MEASUREMENTS))
    for j in range(branches.models.shape[0]):
        x, p = branches.states[j], branches.covariances[j]
        shared = tracking.forgetting, tracking.threshold, tracking.raw, tracking.ceiling
        mine = Tracking(branches.filters[j], *shared, branches.memory[j])
        figures[1, j], mixing.likelihood[j], figures[2, j] = take_fix(mine, x, p, seen, model.setting, work)
        put_row(mixing.residuals[j], work.residual)
        put_rows(mixing.s[j], s)
        if branches.aided[j]:
            aid_with_angles(x, p, seen, model.setting, aiding, work)
    mixture_innovation(modes.predicted, mixing.residuals, mixing.s, work.residual, s)
    log_probabilities(modes.predicted, mixing.likelihood, modes.probability)
    put_row(figures[0], modes.probability)
    interact(modes, branches, mixing)
    mixture_mean(modes.predicted, branches.states, model.state)
    hold_acceleration(model.acceleration, model.state[3:6])
    note_update(model.keep, model, e, MEASUREMENTS, 1.0)


@inner
def record(model, k):
    """Keep the mixture; all of its covariance where a snapshot is taken."""
    states, covariances, weights = model.branches.states, model.branches.covariances, model.modes.predicted
    if (k + 1) % model.keep.snapshot_stride == 0:
        combine(weights, states, covariances, model.state, model.p)
    else:
        combine_stored(weights, states, covariances, model.state, model.p)
    record_state(model, k)
    _mind_the_pole(model, k)


@inner
def _mind_the_pole(model, k):
    """As `body_axes.mind_the_pole`: all branches change over where their mixture is near the pole of its angles."""
    axes, x, branches = model.axes, model.state, model.branches
    axes.history[k] = axes.turned[0]
    near = near_pole(axes.turned[0], x[6], x[7])
    if any_of(near) and may_turn(branches.states[0], near):
        sign = -1.0 if axes.turned[0] else 1.0
        for j in range(branches.models.shape[0]):
            turn_state(branches.states[j], branches.covariances[j], sign)
            turn_noise(branches.noise[j])
        turn_setting(model.setting, sign)
        axes.turned[0] = 1 - axes.turned[0]


steps(Bank, begin, predict, correct, record)
