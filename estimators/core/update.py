"""Kalman measurement updates that keep the covariance symmetric and positive: sequential scalars in Joseph form.

Bierman, *Factorization Methods for Discrete Sequential Estimation*, chapter II; Groves, 2nd ed., section 3.2. Kernels only,
on floats or lanes (`testbed.kernels.lanes`); the units are those of the states and measurements that the caller hands in.
"""

from __future__ import annotations

import numpy as np

from testbed.kernels import njit
from testbed.kernels.lanes import is_zero, select


@njit(cache=True, nogil=True, _nrt=False)
def innovation_covariance(p, h, r, s, scratch):
    """``s`` (m,m) = H P H' + diag(r): ``p`` (n,n or wider), ``h`` (m,n), ``r`` (m,); ``scratch`` (1 or more,n)."""
    m, n = h.shape[0], h.shape[1]
    for a in range(m):
        _product(p, h, a, scratch, 0)
        for b in range(a + 1):
            total = r[a] if a == b else 0.0 * r[a]
            for i in range(n):
                if not is_zero(h[b, i]):
                    total = total + h[b, i] * scratch[0, i]
            s[a, b] = total
            s[b, a] = total


@njit(cache=True, nogil=True, _nrt=False)
def update(x, p, residual, h, r, scalars, scratch):
    """Add to ``x`` (n,) and take from ``p`` (n,n or wider), in place, what ``residual`` = z - h(x) (m,) tells.

    ``h`` (m,n) is the sensitivity, ``r`` (m,) the noise variances. The scalars follow one another, which is exact because R
    is diagonal; ``scalars`` (m,2) becomes what each of them added to what was known, and its variance, so that the sum of
    log variance + square / variance is log det S + v' S^-1 v. ``scratch`` (4,n) is overwritten.
    """
    update_considering(x, p, residual, h, r, scalars, scratch, None)


@njit(cache=True, nogil=True, _nrt=False)
def update_considering(x, p, residual, h, r, scalars, scratch, estimated):
    """`update` that leaves states alone whose ``estimated`` (n,) is 0: they are considered, not estimated (Schmidt 1966).

    Their gain is zero; Joseph's form is right for any gain, so that the others' covariance counts what is not known of them.
    ``estimated`` may be None: all are.
    """
    m, n = h.shape[0], h.shape[1]
    for i in range(n):
        scratch[3, i] = 0.0
    for a in range(m):
        variance, left = r[a], residual[a]
        _product(p, h, a, scratch, 0)
        for i in range(n):
            if not is_zero(h[a, i]):
                variance = variance + h[a, i] * scratch[0, i]
                left = left - h[a, i] * scratch[3, i]
        scalars[a, 0] = left
        scalars[a, 1] = variance
        for i in range(n):
            gain = scratch[0, i] / variance
            if estimated is not None:
                gain = gain * estimated[i]
            scratch[1, i] = gain
            scratch[3, i] = scratch[3, i] + gain * left
        _joseph(p, h, a, r[a], scratch)
    for i in range(n):
        x[i] = x[i] + scratch[3, i]


@njit(cache=True, nogil=True, _nrt=False, forceinline=True)
def _product(p, h, a, scratch, row):
    """Row ``row`` of scratch = P h_a'; P is symmetric, so its rows serve as columns."""
    n = h.shape[1]
    for i in range(n):
        scratch[row, i] = 0.0
    for j in range(n):
        weight = h[a, j]
        if not is_zero(weight):
            for i in range(n):
                scratch[row, i] = scratch[row, i] + weight * p[j, i]


@njit(cache=True, nogil=True, _nrt=False, forceinline=True)
def _joseph(p, h, a, variance, scratch):
    """P = (I - K h) P (I - K h)' + K r K' for one scalar measurement, whatever the gain K; scratch: P h', K, then free.

    In two passes, the second over what the first left of P h'. Multiplied out into one, P - K c' - c K', the rounding of
    what cancels stays in P, and a strongly tracking filter, whose fixes take off seven digits, loses its positivity.
    """
    n = h.shape[1]
    for i in range(n):
        gain = scratch[1, i]
        for j in range(n):
            p[i, j] = p[i, j] - gain * scratch[0, j]
    for i in range(n):
        scratch[2, i] = 0.0
    for j in range(n):
        weight = h[a, j]
        if not is_zero(weight):
            for i in range(n):
                scratch[2, i] = scratch[2, i] + weight * p[i, j]
    for i in range(n):
        rest = variance * scratch[1, i] - scratch[2, i]
        for j in range(i + 1):
            value = p[i, j] + rest * scratch[1, j]
            p[i, j] = value
            p[j, i] = value


@njit(cache=True, nogil=True, _nrt=False)
def cholesky(s, factor):
    """Lower ``factor`` (m,m) with factor factor' = S, for a positive semidefinite S: a column without variance is zero."""
    n = s.shape[0]
    for j in range(n):
        for i in range(j):
            factor[i, j] = 0.0
        pivot = s[j, j]
        for k in range(j):
            pivot -= factor[j, k] * factor[j, k]
        # a pivot that is not a number is none, so that a filter that has diverged says so
        root = select((pivot > 1e-14 * s[j, j]) | (pivot != pivot), np.sqrt(abs(pivot)), 0.0)
        factor[j, j] = root
        divisor = select(root != 0.0, root, np.inf)
        for i in range(j + 1, n):
            total = s[i, j]
            for k in range(j):
                total -= factor[i, k] * factor[j, k]
            factor[i, j] = total / divisor


@njit(cache=True, nogil=True, _nrt=False)
def whiten(covariance, residual, factor, white):
    """``factor`` (m,m) the lower Cholesky factor of S = ``covariance`` (m,m), and ``white`` (m,) = factor^-1 residual.

    Returns v' S^-1 v; not a number where S is not positive definite, as in a filter that has diverged.
    """
    square = 0.0 * residual[0]
    cholesky(covariance, factor)
    for i in range(residual.shape[0]):
        left = residual[i]
        for k in range(i):
            left -= factor[i, k] * white[k]
        white[i] = left / select(factor[i, i] > 0.0, factor[i, i], np.nan)
        square += white[i] * white[i]
    return square
