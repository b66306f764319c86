"""What a filter of n states does at each step, repeated in compiled loops: for its cost against n."""

from __future__ import annotations

import numpy as np
from numba import njit

from estimators.core.update import update
from estimators.methods.ukf_kernels import sigma_points, unscented_moments


@njit(cache=True)
def updates(n, measurements, count):
    """Updates of n states with so many direct measurements; returns the covariance."""
    x, p, h = np.zeros(n), np.eye(n), np.zeros((measurements, n))
    residual, r = np.zeros(measurements), np.ones(measurements)
    scalars, scratch = np.empty((measurements, 2)), np.empty((4, n))
    for a in range(measurements):
        h[a, a] = 1.0
    for _ in range(count):
        update(x, p, residual, h, r, scalars, scratch)
    return p


@njit(cache=True)
def unscented_transforms(n, count):
    """Sigma points of n states and their moments; returns the covariance."""
    x, p = np.zeros(n), np.eye(n)
    mean, out, factor, points = np.empty(n), np.empty((n, n)), np.empty((n, n)), np.empty((2 * n + 1, n))
    width, weights = np.sqrt(n), (0.0, 0.0, 0.5 / n)
    for _ in range(count):
        sigma_points(x, p, width, factor, points)
        unscented_moments(points, weights, 0, 0, mean, out)
    return out
