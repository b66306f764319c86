"""The unscented transform, and the direct unscented Kalman filter's steps on a time line. Kernels only.

Julier & Uhlmann, *Proc. IEEE* 92 (2004); symmetric sigma points, scaled form, additive noise, as the IMM-RSTEKF paper
(2023) sets it beside its own filter. States, models and ``place`` as in `motion_models`; angles are averaged as
deviations from the central point, so that no average crosses ±pi.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from estimators.core.recording import note_update
from estimators.core.timeline import inner, steps
from estimators.core.update import cholesky, whiten
from estimators.methods.body_axes import Axes
from estimators.methods.direct_kernels import MEASUREMENTS, Inputs, Work, antenna, begin, end, stretch, wrap_angles
from estimators.methods.motion_models import N_STATES, Motion, add_process_noise, advance, transition
from testbed.kernels import njit
from testbed.kernels.lanes import select
from testbed.physics.rotations import wrap

Array = NDArray[np.float64]


class Spread(NamedTuple):
    """The scaled unscented transform: how far the points lie from the centre, and what they weigh."""

    width: float
    """In columns of the Cholesky factor."""
    weights: tuple[float, float, float]
    """Central for the mean, central for the covariance, every other."""


class Points(NamedTuple):
    """Arrays of the sigma points, overwritten in every step."""

    points: Array
    """(31,15)"""
    moved: Array
    """(31,15)"""
    readings: Array
    """(31,6)"""
    factor: Array
    """(15,15)"""


def make_points() -> Points:
    """Arrays for 15 states."""
    n, m, count = N_STATES, MEASUREMENTS, 2 * N_STATES + 1
    return Points(np.zeros((count, n)), np.zeros((count, n)), np.zeros((count, m)), np.zeros((n, n)))


class Ukf(NamedTuple):
    """One unscented Kalman filter on a log, for `estimators.core.timeline.walk`; fields as `direct_kernels.Ekf`."""

    inputs: Inputs
    motion: Motion
    spread: Spread
    state: Array
    p: Array
    work: Work
    points: Points
    axes: Axes
    keep: Any
    theta: Array


@njit(cache=True, nogil=True, _nrt=False)
def sigma_points(x, p, width, factor, points):
    """``points`` (2n+1,n): x, then x plus and minus ``width`` times each column of the Cholesky factor of P."""
    n = x.shape[0]
    cholesky(p, factor)
    for i in range(n):
        points[0, i] = x[i]
    for j in range(n):
        for i in range(n):
            step = width * factor[i, j]
            points[1 + j, i] = x[i] + step
            points[1 + n + j, i] = x[i] - step


@njit(cache=True, nogil=True, _nrt=False)
def unscented_moments(points, weights, first_angle, last_angle, mean, covariance):
    """Weighted ``mean`` (m,) and ``covariance`` (m,m) of ``points``, which become deviations from the mean, in place.

    ``weights`` = (central for the mean, central for the covariance, every other). Columns from ``first_angle`` up to,
    not including, ``last_angle`` are angles (rad).
    """
    count, m = points.shape[0], points.shape[1]
    for j in range(m):
        mean[j] = points[0, j]
        points[0, j] = 0.0
    for s in range(1, count):
        for j in range(m):
            points[s, j] -= mean[j]
        for j in range(first_angle, last_angle):
            points[s, j] = wrap(points[s, j])
        for j in range(m):
            points[0, j] += weights[2] * points[s, j]
    for j in range(m):
        mean[j] += points[0, j]
    for j in range(first_angle, last_angle):
        mean[j] = wrap(mean[j])
    for s in range(1, count):
        for j in range(m):
            points[s, j] -= points[0, j]
    for j in range(m):
        points[0, j] = -points[0, j]
    for i in range(m):
        for j in range(m):
            covariance[i, j] = 0.0
    for s in range(count):
        weight = weights[1] if s == 0 else weights[2]
        for i in range(m):
            a = weight * points[s, i]
            for j in range(m):
                covariance[i, j] += a * points[s, j]


def make_spread(n: int, alpha: float, beta: float, kappa: float) -> Spread:
    """The transform of an n-dimensional state."""
    scale = alpha * alpha * (n + kappa)
    central = 1.0 - n / scale
    return Spread(float(np.sqrt(scale)), (central, central + 1.0 - alpha * alpha + beta, 0.5 / scale))


@njit(cache=True, nogil=True, _nrt=False)
def unscented_correct(x, p, deviations, readings, weights, work):
    """Kalman update in place from state ``deviations`` (2n+1,n) and measurement deviations ``readings`` (2n+1,m).

    ``work`` (`direct_kernels.Work`) holds the innovation, and S with the noise in it. Returns the test statistic v' S^-1 v.
    """
    count, n = deviations.shape[0], deviations.shape[1]
    m = readings.shape[1]
    factor, white, root = work.factor, work.white, work.h
    theta = whiten(work.s.reshape((m, m)), work.residual, factor, white)
    root[:] = 0.0
    # root = factor^-1 (cross covariance)', so that P loses root' root: symmetric by construction.
    for s in range(count):
        weight = weights[1] if s == 0 else weights[2]
        for a in range(m):
            for i in range(n):
                root[a, i] += weight * readings[s, a] * deviations[s, i]
    for a in range(m):
        for b in range(a):
            for i in range(n):
                root[a, i] -= factor[a, b] * root[b, i]
        pivot = select(factor[a, a] > 0.0, factor[a, a], np.nan)
        for i in range(n):
            root[a, i] /= pivot
            x[i] += root[a, i] * white[a]
    for i in range(n):
        for j in range(i + 1):
            total = p[i, j]
            for a in range(m):
                total -= root[a, i] * root[a, j]
            p[i, j] = total
            p[j, i] = total
    return theta


@inner
def predict(model, k, dt, part):
    """Carry the filter ``dt`` (s) on within IMU sample ``k``: every sigma point moves."""
    motion, x, p, phi = model.motion, model.state, model.p, model.work.phi
    points, moved = model.points.points, model.points.moved
    step = stretch(model, k, dt, part)
    transition(motion, x, step, phi)
    sigma_points(x, p, model.spread.width, model.points.factor, points)
    for s in range(points.shape[0]):
        advance(motion, points[s], step, moved[s])
    unscented_moments(moved, model.spread.weights, 6, 9, x, p)
    add_process_noise(p, phi, motion.noise, dt)


@inner
def correct(model, k, e):
    """Use fix ``e``, which lies within IMU sample ``k``, with fresh sigma points."""
    x, p, inputs, work, weights = model.state, model.p, model.inputs, model.work, model.spread.weights
    points, readings = model.points.points, model.points.readings
    residual, s, predicted = work.residual, work.s.reshape((MEASUREMENTS, MEASUREMENTS)), work.white
    sigma_points(x, p, model.spread.width, model.points.factor, points)
    for i in range(points.shape[0]):
        antenna(points[i], model.axes.samples[1], model.motion.setting, readings[i])
    unscented_moments(readings, weights, 0, 0, predicted, s)
    for i in range(MEASUREMENTS):
        s[i, i] += inputs.r[e, i]
        residual[i] = inputs.z[e, i] - predicted[i]
    for i in range(points.shape[0]):
        for j in range(N_STATES):
            points[i, j] -= x[j]
    model.theta[e] = unscented_correct(x, p, points, readings, weights, work)
    wrap_angles(x)
    note_update(model.keep, model, e, MEASUREMENTS, 1.0)


steps(Ukf, begin, predict, correct, end)
