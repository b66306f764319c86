"""Kalman measurement updates that keep the covariance symmetric and positive: sequential scalars in Joseph form.

Bierman, *Factorization Methods for Discrete Sequential Estimation*, chapter II; Groves, 2nd ed., section 3.2. Kernels
only; the units are those of the states and measurements that the caller hands in.
"""

from __future__ import annotations

from numba import njit


@njit(cache=True)
def update(x, p, residual, h, r, covariance, scratch):
    """Update state ``x`` (n,) and covariance ``p`` (n,n) in place with ``residual`` = z - h(x) (m,), noise var. ``r`` (m,).

    ``h`` (m,n) is the sensitivity. Before anything changes, ``covariance`` (m,m) becomes the innovation covariance
    H P H' + R. The scalars follow one another, which is exact because R is diagonal. ``scratch`` (m+1,n) is overwritten.
    """
    innovation_covariance(p, h, r, covariance, scratch)
    n = x.shape[0]
    gain, product = scratch[0], scratch[1]
    done = scratch[2]
    done[:] = 0.0
    for a in range(residual.shape[0]):
        left = residual[a]
        variance = r[a]
        for i in range(n):
            total = 0.0
            for j in range(n):
                total += p[i, j] * h[a, j]
            product[i] = total
        for i in range(n):
            variance += h[a, i] * product[i]
            left -= h[a, i] * done[i]
        for i in range(n):
            gain[i] = product[i] / variance
            done[i] += gain[i] * left
        joseph(p, gain, product, h[a], r[a], scratch[3])
    for i in range(n):
        x[i] += done[i]


@njit(cache=True)
def innovation_covariance(p, h, r, covariance, scratch):
    """``covariance`` (m,m) = H P H' + diag(r)."""
    m, n = h.shape
    for a in range(m):
        for i in range(n):
            total = 0.0
            for j in range(n):
                total += p[i, j] * h[a, j]
            scratch[0, i] = total
        for b in range(a + 1):
            total = r[a] if a == b else 0.0
            for i in range(n):
                total += h[b, i] * scratch[0, i]
            covariance[a, b] = total
            covariance[b, a] = total


@njit(cache=True)
def joseph(p, gain, product, row, variance, scratch):
    """P = (I - K h) P (I - K h)' + K r K' for one scalar measurement, ``product`` = P h', ``row`` = h; in place."""
    n = gain.shape[0]
    for i in range(n):
        for j in range(n):
            p[i, j] -= gain[i] * product[j]
    for i in range(n):
        total = 0.0
        for j in range(n):
            total += p[i, j] * row[j]
        scratch[i] = total
    for i in range(n):
        for j in range(i + 1):
            value = p[i, j] + (variance * gain[i] - scratch[i]) * gain[j]
            p[i, j] = value
            p[j, i] = value
