"""Compiled steps of the IMU chain, in place on blocks of rows (n,3); and exact discrete random processes.

Filters: Oppenheim & Schafer, *Discrete-Time Signal Processing*, section 7.1; processes: Groves, 2nd ed., section 3.2.
Units and frame are those of the block (rad/s or m/s², along b).
"""

from __future__ import annotations

import numpy as np

from testbed.kernels import njit


@njit(cache=True)
def apply_matrix(x, m):
    """x[k] = m @ x[k]."""
    for k in range(x.shape[0]):
        a, b, c = x[k, 0], x[k, 1], x[k, 2]
        x[k, 0] = m[0, 0] * a + m[0, 1] * b + m[0, 2] * c
        x[k, 1] = m[1, 0] * a + m[1, 1] * b + m[1, 2] * c
        x[k, 2] = m[2, 0] * a + m[2, 1] * b + m[2, 2] * c


@njit(cache=True)
def add_product(x, m, y):
    """x[k] += m @ y[k]."""
    for k in range(x.shape[0]):
        for i in range(3):
            x[k, i] += m[i, 0] * y[k, 0] + m[i, 1] * y[k, 1] + m[i, 2] * y[k, 2]


@njit(cache=True)
def add_lever_arm(f, w, alpha, arm):
    """f[k] += alpha[k] × arm + w[k] × (w[k] × arm): specific force at a point off the reference point."""
    a, b, c = arm[0], arm[1], arm[2]
    for k in range(f.shape[0]):
        x, y, z = w[k, 0], w[k, 1], w[k, 2]
        u, v, q = y * c - z * b, z * a - x * c, x * b - y * a
        f[k, 0] += alpha[k, 1] * c - alpha[k, 2] * b + y * q - z * v
        f[k, 1] += alpha[k, 2] * a - alpha[k, 0] * c + z * u - x * q
        f[k, 2] += alpha[k, 0] * b - alpha[k, 1] * a + x * v - y * u


@njit(cache=True)
def add_chebyshev(x, amplitude, limit):
    """x += amplitude * T3(x / limit): the largest departure from the best straight line over ±limit is ``amplitude``."""
    for k in range(x.shape[0]):
        for i in range(3):
            u = min(1.0, max(-1.0, x[k, i] / limit))
            x[k, i] += amplitude[i] * (4.0 * u * u - 3.0) * u


@njit(cache=True)
def add_interpolated(x, bias, t, start, step, knots):
    """Add the piecewise linear process ``knots`` (from ``start``, every ``step`` s) to x; keep it in ``bias``."""
    last = knots.shape[0] - 2
    for k in range(x.shape[0]):
        s = (t[k] - start) / step
        i = min(int(s), last)
        s -= i
        for j in range(3):
            value = knots[i, j] + s * (knots[i + 1, j] - knots[i, j])
            bias[k, j] = value
            x[k, j] += value


@njit(cache=True)
def add_scaled(x, gain, noise):
    """x += gain * noise."""
    for k in range(x.shape[0]):
        for i in range(3):
            x[k, i] += gain * noise[k, i]


@njit(cache=True)
def scale_by_temperature(x, coefficient, kelvin):
    """x[k] *= 1 + coefficient * kelvin[k]."""
    for k in range(x.shape[0]):
        for i in range(3):
            x[k, i] *= 1.0 + coefficient[i] * kelvin[k]


@njit(cache=True)
def second_order_filter(x, b, a, state):
    """Transposed direct form II with coefficients b (3), a (3, a[0] = 1); ``state`` (3,2) lives from block to block."""
    b0, b1, b2, a1, a2 = b[0], b[1], b[2], a[1], a[2]
    for i in range(3):
        s0, s1 = state[i, 0], state[i, 1]
        for k in range(x.shape[0]):
            value = x[k, i]
            y = b0 * value + s0
            s0 = b1 * value - a1 * y + s1
            s1 = b2 * value - a2 * y
            x[k, i] = y
        state[i, 0], state[i, 1] = s0, s1


@njit(cache=True)
def saturate(x, limit):
    """Clip to ±limit."""
    for k in range(x.shape[0]):
        for i in range(3):
            x[k, i] = min(limit, max(-limit, x[k, i]))


@njit(cache=True)
def quantise(x, lsb):
    """Round to whole multiples of ``lsb``."""
    inverse = 1.0 / lsb
    for k in range(x.shape[0]):
        for i in range(3):
            x[k, i] = np.rint(x[k, i] * inverse) * lsb


@njit(cache=True)
def markov(x, decay, drive):
    """In place: unit normals x (n,m) to a first-order Gauss-Markov process of sigma 1 (x[0] is its stationary start).

    ``decay`` = exp(-dt/T) and ``drive`` = sqrt(1 - decay²): exact at the sample times.
    """
    for k in range(1, x.shape[0]):
        for i in range(x.shape[1]):
            x[k, i] = decay * x[k - 1, i] + drive * x[k, i]
