"""The receiver: position, velocity and time from pseudoranges and range rates, and the test for a wrong one among them.

Weighted least squares by Gauss-Newton (Groves, 2nd ed., sections 9.4 and 9.2.8), one clock per system. Fault detection
and exclusion: the weighted sum of squared residuals is chi-square (section 17.4.1); a subset without the satellite at
fault passes. Computed in e, given in n; SI units and radians.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from testbed.kernels import njit
from testbed.physics.ecef import ecef_to_geodetic, north_east_down
from testbed.physics.ranging import range_rate, sight

Array = NDArray[np.float64]
Integers = NDArray[np.int64]

UNKNOWNS = 5
"""Position, and a clock for each of two systems."""
ROUNDS = 8
CONVERGED_M = 1e-4
MOST_EXCLUDED = 2
WORST_GDOP = 30.0
UNUSED, USED, EXCLUDED = 0, 1, 2
"""What the receiver made of an observation."""


class Received(NamedTuple):
    """Observations of all epochs, M rows in the order of time, corrected by what the broadcast message says."""

    first: Integers
    """(E + 1,) first row of each epoch, and M"""
    system: Integers
    """(M,) 1 GPS, 2 Galileo"""
    x: Array
    """(M,3) satellites at transmission, in the e of reception, m"""
    v: Array
    """(M,3) m/s"""
    pseudorange: Array
    """(M,) plus satellite clock, minus delays, m"""
    rate: Array
    """(M,) plus the rate of the satellite's clock, m/s"""
    sigma: Array
    """(M,) m"""
    rate_sigma: Array
    """(M,) m/s"""


class Fixes(NamedTuple):
    """What the receiver makes of them, in the order of the epochs; rows of an epoch without a fix are not numbers."""

    place: Array
    """(E,3) latitude, longitude, height"""
    v_n: Array
    """(E,3) m/s"""
    std: Array
    """(E,6) m north, east, down; m/s"""
    correlation: Array
    """(E,6) north with east, north with down, east with down, of position and of velocity"""
    clock: Array
    """(E,3) clocks against both systems (m), drift (m/s)"""
    dop: Array
    """(E,3) horizontal, vertical, time"""
    test: Array
    """(E,2) sum of squares before any exclusion, its degrees of freedom"""
    used: Integers
    """(M,)"""
    residual: Array
    """(M,) observed minus fitted, m; not a number without a fix"""


def solve(received: Received, false_alarm: float = 1e-3) -> Fixes:
    """Fixes of all epochs. ``false_alarm``: chance that the test rejects an epoch without a fault; 0: no test."""
    from scipy.special import chdtri

    dof = np.arange(1, 65)
    threshold = np.concatenate([[np.inf], chdtri(dof, false_alarm) if false_alarm else np.full(len(dof), np.inf)])
    epochs, rows = len(received.first) - 1, len(received.sigma)

    def nothing(width: int) -> Array:
        return np.full((epochs, width), np.nan)

    fixes = Fixes(
        nothing(3),
        nothing(3),
        nothing(6),
        nothing(6),
        nothing(3),
        nothing(3),
        nothing(2),
        np.zeros(rows, dtype=np.int64),
        np.full(rows, np.nan),
    )
    _solve(received, threshold, fixes)
    return fixes


class _Work(NamedTuple):
    normal: Array
    right: Array
    inverse: Array
    x: Array
    """(6,) position, clocks; the sum of squares"""
    trial: Array
    alive: NDArray[np.bool_]
    """(64,) rows of the epoch that are in use"""


@njit(cache=True, nogil=True)
def _solve(received, threshold, fixes):
    n = UNKNOWNS
    work = _Work(
        np.zeros((n, n)), np.zeros(n), np.zeros((n, n)), np.zeros(n + 1), np.zeros(n + 1), np.zeros(64, dtype=np.bool_)
    )
    for epoch in range(received.first.shape[0] - 1):
        first, last = received.first[epoch], min(received.first[epoch + 1], received.first[epoch] + 64)
        work.alive[:] = True
        unknowns = _fit(received, first, last, work, work.x)
        dof = last - first - unknowns
        if dof < 0 or unknowns == 0:
            continue
        fixes.test[epoch, 0], fixes.test[epoch, 1] = work.x[n], dof
        if dof > 0 and work.x[n] > threshold[dof] and not _exclude(received, first, last, threshold, work):
            continue
        unknowns = _fit(received, first, last, work, work.x)
        if unknowns > 0:
            _report(received, first, last, epoch, work, fixes)


@njit(cache=True, nogil=True)
def _fit(received, first, last, work, x):
    """Least squares of the rows in use, from and into ``x``; returns the number of unknowns, 0 where there is no answer."""
    count, gps, galileo = 0, 0, 0
    for k in range(first, last):
        if work.alive[k - first]:
            count += 1
            gps += received.system[k] == 1
            galileo += received.system[k] == 2
    unknowns = 3 + (gps > 0) + (galileo > 0)
    if count < unknowns:
        return 0
    for _ in range(ROUNDS):
        _normal_equations(received, first, last, work, x)
        if not _invert(work):
            x[:] = 0.0
            return 0
        change = 0.0
        for i in range(UNKNOWNS):
            step = 0.0
            for j in range(UNKNOWNS):
                step += work.inverse[i, j] * work.right[j]
            x[i] += step
            if i < 3:
                change += step * step
        if change < CONVERGED_M * CONVERGED_M:
            x[UNKNOWNS] = _sum_of_squares(received, first, last, work.alive, x)
            return unknowns
    x[:] = 0.0
    return 0


@njit(cache=True, nogil=True)
def _normal_equations(received, first, last, work, x):
    """H' W H and H' W residual at ``x``; the clock of a system without satellites keeps a unit on the diagonal."""
    normal, right = work.normal, work.right
    normal[:], right[:] = 0.0, 0.0
    for k in range(first, last):
        if not work.alive[k - first]:
            continue
        s, w = received.x[k], 1.0 / (received.sigma[k] * received.sigma[k])
        distance, u = sight((s[0], s[1], s[2]), (x[0], x[1], x[2]))
        clock = 2 + received.system[k]
        left = w * (received.pseudorange[k] - distance - x[clock])
        _add_line(normal, u, clock, w)
        for i in range(3):
            right[i] -= u[i] * left
        right[clock] += left
    _fill(normal)


@njit(cache=True, nogil=True)
def _invert(work):
    """``inverse`` of ``normal`` by elimination without pivots, which a positive definite matrix does not need."""
    a, b, n = work.normal, work.inverse, UNKNOWNS
    for i in range(n):
        for j in range(n):
            b[i, j] = 1.0 if i == j else 0.0
    for i in range(n):
        pivot = a[i, i]
        if not pivot > 1e-14:
            return False
        for j in range(n):
            a[i, j] /= pivot
            b[i, j] /= pivot
        for k in range(n):
            if k != i and a[k, i] != 0.0:
                factor = a[k, i]
                for j in range(n):
                    a[k, j] -= factor * a[i, j]
                    b[k, j] -= factor * b[i, j]
    return True


@njit(cache=True, nogil=True)
def _sum_of_squares(received, first, last, alive, x):
    total = 0.0
    for k in range(first, last):
        if alive[k - first]:
            s = received.x[k]
            distance, _ = sight((s[0], s[1], s[2]), (x[0], x[1], x[2]))
            left = (received.pseudorange[k] - distance - x[2 + received.system[k]]) / received.sigma[k]
            total += left * left
    return total


@njit(cache=True, nogil=True)
def _exclude(received, first, last, threshold, work):
    """Leave out the satellite without which the rest agrees best, and once more; whether a subset passes the test."""
    for _ in range(MOST_EXCLUDED):
        best, least, dof_left = -1, np.inf, 0
        for k in range(last - first):
            if not work.alive[k]:
                continue
            work.alive[k] = False
            work.trial[:] = work.x
            unknowns = _fit(received, first, last, work, work.trial)
            dof = np.sum(work.alive[: last - first]) - unknowns
            if unknowns > 0 and dof > 0 and work.trial[UNKNOWNS] < least:
                best, least, dof_left = k, work.trial[UNKNOWNS], dof
            work.alive[k] = True
        if best < 0:
            return False
        work.alive[best] = False
        if least <= threshold[dof_left]:
            return True
    return False


@njit(cache=True, nogil=True)
def _report(received, first, last, epoch, work, fixes):
    """Position, velocity, their deviations and the dilution at the solution, unless the geometry is hopeless."""
    x = work.x
    lat, lon, h = ecef_to_geodetic(x[0], x[1], x[2])
    axes = north_east_down(lat, lon)
    north_down = np.zeros(3)
    _normal_equations(received, first, last, work, x)
    if not _invert(work):
        return
    _state(work.inverse, axes, fixes.std[epoch, :3], fixes.correlation[epoch, :3])
    _dilution(received, first, last, work, x)
    if not _invert(work):
        return
    _variances(work.inverse, axes, north_down)
    time = work.inverse[3, 3] if np.any(received.system[first:last] == 1) else work.inverse[4, 4]
    if np.sqrt(north_down.sum() + time) > WORST_GDOP:
        return
    v = _velocity(received, first, last, work, x)
    if not v[4] > 0.0:
        return
    fixes.place[epoch, 0], fixes.place[epoch, 1], fixes.place[epoch, 2] = lat, lon, h
    _state(work.inverse, axes, fixes.std[epoch, 3:], fixes.correlation[epoch, 3:])
    for i in range(3):
        row = axes[i]
        fixes.v_n[epoch, i] = row[0] * v[0] + row[1] * v[1] + row[2] * v[2]
    fixes.clock[epoch, 0], fixes.clock[epoch, 1], fixes.clock[epoch, 2] = x[3], x[4], v[3]
    fixes.dop[epoch, 0] = np.sqrt(north_down[0] + north_down[1])
    fixes.dop[epoch, 1], fixes.dop[epoch, 2] = np.sqrt(north_down[2]), np.sqrt(time)
    for k in range(first, last):
        s = received.x[k]
        distance, _ = sight((s[0], s[1], s[2]), (x[0], x[1], x[2]))
        fixes.residual[k] = received.pseudorange[k] - distance - x[2 + received.system[k]]
        fixes.used[k] = USED if work.alive[k - first] else EXCLUDED


@njit(cache=True, nogil=True)
def _variances(inverse, axes, out):
    """Diagonal of the covariance's position part in n."""
    for i in range(3):
        out[i] = _in_n(inverse, axes[i], axes[i])


@njit(cache=True, nogil=True)
def _in_n(inverse, a, b):
    """Covariance along two axes of n."""
    total = 0.0
    for j in range(3):
        for k in range(3):
            total += a[j] * inverse[j, k] * b[k]
    return total


@njit(cache=True, nogil=True)
def _state(inverse, axes, std, correlation):
    """Deviations north, east, down and their correlations."""
    for i in range(3):
        std[i] = np.sqrt(_in_n(inverse, axes[i], axes[i]))
    correlation[0] = _in_n(inverse, axes[0], axes[1]) / (std[0] * std[1])
    correlation[1] = _in_n(inverse, axes[0], axes[2]) / (std[0] * std[2])
    correlation[2] = _in_n(inverse, axes[1], axes[2]) / (std[1] * std[2])


@njit(cache=True, nogil=True)
def _dilution(received, first, last, work, x):
    """The normal equations without weights."""
    normal = work.normal
    normal[:] = 0.0
    for k in range(first, last):
        if work.alive[k - first]:
            s = received.x[k]
            _, u = sight((s[0], s[1], s[2]), (x[0], x[1], x[2]))
            _add_line(normal, u, 2 + received.system[k], 1.0)
    _fill(normal)


@njit(cache=True, nogil=True)
def _add_line(normal, u, clock, w):
    """What one satellite adds to the upper triangle of H' W H."""
    for i in range(3):
        for j in range(i, 3):
            normal[i, j] += w * u[i] * u[j]
        normal[i, clock] -= w * u[i]
    normal[clock, clock] += w


@njit(cache=True, nogil=True)
def _fill(normal):
    """The lower triangle; and a unit for an unknown that no line has."""
    for i in range(normal.shape[0]):
        if normal[i, i] == 0.0:
            normal[i, i] = 1.0
        for j in range(i):
            normal[i, j] = normal[j, i]


@njit(cache=True, nogil=True)
def _velocity(received, first, last, work, x):
    """Velocity in e and clock drift by weighted least squares; last the number of satellites, 0 where there is no answer.

    The rate is linear in the velocity but for the change of the light time, which a second round takes in.
    """
    normal, right = work.normal, work.right
    v = np.zeros(5)
    for _ in range(2):
        normal[:], right[:] = 0.0, 0.0
        for k in range(first, last):
            if not work.alive[k - first]:
                continue
            s, sv = received.x[k], received.v[k]
            place, speed = (s[0], s[1], s[2]), (sv[0], sv[1], sv[2])
            w = 1.0 / (received.rate_sigma[k] * received.rate_sigma[k])
            _, u = sight(place, (x[0], x[1], x[2]))
            left = w * (received.rate[k] - range_rate(u, place, speed, (v[0], v[1], v[2])) - v[3])
            _add_line(normal, u, 3, w)
            for i in range(3):
                right[i] -= u[i] * left
            right[3] += left
        _fill(normal)
        if not _invert(work):
            return np.zeros(5)
        for i in range(4):
            for j in range(4):
                v[i] += work.inverse[i, j] * right[j]
    v[4] = 1.0
    return v


def dilution(lines: Array, system: Integers) -> tuple[float, float, float, float]:
    """Horizontal, vertical, time and position dilution of lines of sight (K,3) in n, a clock for each system (K,).

    Raises LinAlgError where the geometry has no answer.
    """
    clocks = (system[:, None] == np.unique(system)[None, :]).astype(float)
    inverse = np.linalg.inv(_gram(np.hstack([-lines, clocks])))
    d = np.diag(inverse)
    return float(np.sqrt(d[0] + d[1])), float(np.sqrt(d[2])), float(np.sqrt(d[3])), float(np.sqrt(d[:3].sum()))


def _gram(h: Array) -> Array:
    return h.T @ h
