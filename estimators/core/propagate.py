"""P = Phi P Phi' + Q in place, for nine navigation errors and any number of sensor-error states. Kernels only.

A sensor-error state fades by ``keep`` over the step and adds to specific force or angular rate through a column of
``accel`` or ``gyro`` (k,3), in n. Only nine rows of Phi have structure, so P takes two passes of `nav_errors`: nine rows of
Phi P, then nine columns of (Phi P) Phi'; all else follows from symmetry. A single filter takes eight columns of P as lanes;
filters that run side by side take a lane each.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from numba import types
from numba.extending import overload
from numpy.typing import NDArray

from estimators.core.nav_errors import nav_errors
from testbed.kernels import njit
from testbed.kernels.lanes import WIDTH, aligned, load, splat, store
from testbed.kernels.tables import side_by_side

NAV = 9
"""Errors of position, velocity and attitude, which every covariance begins with."""

Array = NDArray[np.float64]


class Coupling(NamedTuple):
    """How the sensor-error states reach the navigation errors in this step."""

    spans: NDArray[np.int64]
    """(4,) first and last + 1 of the states that add to specific force, then of those that add to angular rate."""
    accel: Array
    """(k,3) what one unit of a state adds to specific force in n."""
    gyro: Array
    """(k,3) the same for angular rate."""
    keep: Array
    """(k,) exp(-dt/tau) of each state."""


class Scratch(NamedTuple):
    """Tables that a propagation overwrites."""

    p: Array
    """The covariance itself as a table of lanes."""
    rows: Array
    """Nine rows of Phi P."""
    columns: Array
    """The same transposed, (n,2 WIDTH); unused where filters run side by side."""
    keep: Array
    """``keep`` of every column of P; unused likewise."""
    phi: Array
    """Of `estimators.core.postponed`, as all below: how the states that wait are reached since they were last carried."""
    transition: Array
    """``phi`` as a matrix."""
    waited: Array
    """What every state has kept since then, by columns of P."""
    kept: Array
    """``waited`` as a vector."""
    noise: Array
    """(n,) what their variances have gained."""
    pending: Array
    """(1,) how long that is, s."""


POSTPONE_FROM = 3
"""Registers of columns that must be spared: to multiply a transition up costs two, or three with many couplings."""


def eager_states(n: int, tied: int) -> int:
    """How many of ``n`` states are carried over each sample, of which the first ``tied`` have to be: whole registers."""
    return blocks_of(tied) * WIDTH if blocks_of(n) - blocks_of(tied) >= POSTPONE_FROM else n


def blocks_of(n: int) -> int:
    """Vector registers that a row of n floats fills."""
    return (n + WIDTH - 1) // WIDTH


def make_covariance(p0: Array, eager: int | None = None, coupled: int = 0) -> tuple[Array, Scratch]:
    """Covariance (n, whole registers) that starts as ``p0`` (n,n), and its scratch.

    ``eager``: how many states each sample carries, all by default; of those ``coupled`` add to the IMU.
    """
    n, blocks = len(p0), blocks_of(len(p0))
    eager = n if eager is None else eager
    table = aligned(n * blocks)
    p = table.reshape(n, blocks * WIDTH)
    p[:, :n] = p0
    keep = aligned(blocks)
    keep[:] = 1.0
    return p, Scratch(
        table,
        aligned(NAV * blocks_of(eager)),
        aligned(2 * eager),
        keep,
        *_waiting(n, NAV + coupled if eager < n else 0),
    )


def _waiting(n: int, states: int) -> tuple[Array, ...]:
    """What `Scratch` keeps of the states that wait, of ``n``; ``states`` reach them, 0 where none waits."""
    blocks = blocks_of(states)
    phi, waited = aligned(max(states * blocks, 1)), aligned(blocks_of(n))
    transition = phi[: states * blocks].reshape(states, blocks * WIDTH)
    transition[:, :states] = np.eye(states)
    waited[:] = 1.0
    return phi, transition, waited, waited.reshape(-1), np.zeros(n), np.zeros(1)


def make_covariances(p0: Sequence[Array]) -> tuple[Any, Scratch]:
    """Covariances of filters side by side that start as each of ``p0`` (n,n), and their scratch."""
    p, n = side_by_side(p0), len(p0[0])
    table = p.array.reshape(n * n, WIDTH)
    return p, Scratch(table, aligned(NAV * n), aligned(1), aligned(1), *_waiting(n, 0))


def propagate(p, scratch, coupling, motion, dt):
    """Carry P over a step of ``dt``; ``motion`` as `nav_errors` takes it. Kernels only."""
    raise NotImplementedError("kernels only")


@overload(propagate)
def _propagate(p, scratch, coupling, motion, dt):
    if isinstance(p, types.Array):
        return lambda p, scratch, coupling, motion, dt: _columns_as_lanes(p, scratch, coupling, motion, dt)
    return lambda p, scratch, coupling, motion, dt: _filters_as_lanes(p, scratch, coupling, motion, dt)


@njit(cache=True, nogil=True, _nrt=False, forceinline=True)
def _triple(table, row, step):
    return load(table, row), load(table, row + step), load(table, row + 2 * step)


@njit(cache=True, nogil=True, _nrt=False, forceinline=True)
def store_errors(table, row, step, errors):
    r, u, p = errors
    for i in range(3):
        store(table, row + i * step, r[i])
        store(table, row + (3 + i) * step, u[i])
        store(table, row + (6 + i) * step, p[i])


@njit(cache=True, nogil=True, _nrt=False, forceinline=True)
def _added(source, first, step, weights, start, stop):
    """Triple of sums over states ``start`` to ``stop`` of their weights times rows ``first + step * state``."""
    a, b, c = splat(0.0), splat(0.0), splat(0.0)
    for k in range(start, stop):
        x = load(source, first + (NAV + k) * step)
        a = a + weights[k, 0] * x
        b = b + weights[k, 1] * x
        c = c + weights[k, 2] * x
    return a, b, c


@njit(cache=True, nogil=True, _nrt=False, forceinline=True)
def moved(source, first, step, coupling, motion, dt):
    """The nine errors in rows ``first + step * state`` after the step; ``coupling`` = (spans, accel, gyro)."""
    spans, accel, gyro = coupling
    force = _added(source, first, step, accel, spans[0], spans[1])
    rate = _added(source, first, step, gyro, spans[2], spans[3])
    three = 3 * step
    errors = (
        _triple(source, first, step),
        _triple(source, first + three, step),
        _triple(source, first + 2 * three, step),
    )
    return nav_errors(errors, rate, force, motion, dt)


@njit(cache=True, nogil=True, _nrt=False)
def transition(unit, rows, coupling, motion, dt):
    """Nine rows of Phi, (9, whole registers) in the table ``rows``; ``unit``: the scratch of a covariance that is 1.

    Further rows of Phi are ``keep`` on the diagonal.
    """
    blocks = rows.shape[0] // NAV
    couples = coupling.spans, coupling.accel, coupling.gyro
    for b in range(blocks):
        store_errors(rows, b, blocks, moved(unit, b, blocks, couples, motion, dt))


@njit(cache=True, nogil=True, _nrt=False)
def _columns_as_lanes(p, scratch, coupling, motion, dt):
    moved_rows, moved_columns = scratch.rows, scratch.columns
    n, keep, table, fade = moved_columns.shape[0] // 2, coupling.keep, scratch.p, scratch.keep
    blocks, own = p.shape[1] // WIDTH, moved_rows.shape[0] // NAV
    rows, columns = moved_rows.reshape(NAV, own * WIDTH), moved_columns.reshape(n, 2 * WIDTH)
    couples = coupling.spans, coupling.accel, coupling.gyro
    for b in range(own):
        store_errors(moved_rows, b, own, moved(table, b, blocks, couples, motion, dt))
    for j in range(n):
        for i in range(NAV):
            columns[j, i] = rows[i, j]
    for i in range(NAV, n):
        fade[i // WIDTH, i % WIDTH] = keep[i - NAV]
    for i in range(NAV, n):
        for b in range(1, own):
            store(table, i * blocks + b, load(table, i * blocks + b) * (keep[i - NAV] * load(fade, b)))
    for b in range(2):
        store_errors(table, b, blocks, moved(moved_columns, b, 2, couples, motion, dt))
    for i in range(NAV):
        for j in range(i):
            p[i, j] = p[j, i]
    for j in range(NAV, n):
        for i in range(NAV):
            x = columns[j, i] * keep[j - NAV]
            p[j, i] = x
            p[i, j] = x


@njit(cache=True, nogil=True, _nrt=False)
def _filters_as_lanes(p, scratch, coupling, motion, dt):
    n, keep, table, rows = p.shape[0], coupling.keep, scratch.p, scratch.rows
    couples = coupling.spans, coupling.accel, coupling.gyro
    for j in range(n):
        # By symmetry of P a row serves as column.
        store_errors(rows, j, n, moved(table, n * j, 1, couples, motion, dt))
    for i in range(NAV):
        store_errors(table, n * i, 1, moved(rows, n * i, 1, couples, motion, dt))
    for i in range(NAV):
        for j in range(i):
            store(table, n * i + j, load(table, n * j + i))
        for j in range(NAV, n):
            x = load(rows, n * i + j) * keep[j - NAV]
            store(table, n * i + j, x)
            store(table, n * j + i, x)
    for i in range(NAV, n):
        for j in range(NAV, n):
            store(table, n * i + j, load(table, n * i + j) * (keep[i - NAV] * keep[j - NAV]))


@njit(cache=True, nogil=True, _nrt=False, forceinline=True)
def integrate_pairs(p, n, chain, dt):
    """P, of n states, after sensor-error state ``chain[c, 0]`` has gained ``dt`` times ``chain[c, 1]``; numbers or lanes.

    Such states keep their value over a step (no ``decay``), so that this and `propagate` may follow one another.
    """
    for c in range(chain.shape[0]):
        i, j = NAV + chain[c, 0], NAV + chain[c, 1]
        for a in range(n):
            p[i, a] = p[i, a] + p[j, a] * dt
        for a in range(n):
            p[a, i] = p[a, i] + p[a, j] * dt


@njit(cache=True, nogil=True, _nrt=False)
def add_noise(p, m, white, drive, dt):
    """Add the noise of one step of ``dt`` to P, ``m`` = C_nb; numbers or lanes.

    ``white`` (6,): spectral densities along b of accelerometer noise ((m/s²)²/Hz) and gyro noise ((rad/s)²/Hz); ``drive``
    (k,): those that drive the sensor-error states. Velocity noise reaches the position within the step (van Loan to third
    order); all other cross terms are below dt² of what they join.
    """
    for i in range(3):
        for j in range(i, 3):
            accel = _density(m, white, 0, i, j) * dt
            _add(p, i, j, accel * (dt * dt / 3.0))
            _add(p, i, 3 + j, accel * (0.5 * dt))
            if i != j:
                _add(p, j, 3 + i, accel * (0.5 * dt))
            _add(p, 3 + i, 3 + j, accel)
            _add(p, 6 + i, 6 + j, _density(m, white, 3, i, j) * dt)
    for i in range(drive.shape[0]):
        _add(p, NAV + i, NAV + i, drive[i] * dt)


@njit(cache=True, nogil=True, _nrt=False, forceinline=True)
def _density(m, white, first, i, j):
    """Entry (i,j) of C diag(white) C'."""
    total = m[i][0] * m[j][0] * white[first] + m[i][1] * m[j][1] * white[first + 1]
    return total + m[i][2] * m[j][2] * white[first + 2]


@njit(cache=True, nogil=True, _nrt=False, forceinline=True)
def _add(p, i, j, value):
    """Add to entry (i,j), and to (j,i)."""
    p[i, j] = p[i, j] + value
    if i != j:
        p[j, i] = p[i, j]


@njit(cache=True, nogil=True, _nrt=False)
def turn_velocity_errors(p, n, change):
    """P, of n states, after the velocity errors have gained phi x ``change`` (m/s); numbers or lanes."""
    _gain(p, n, 3, change)


@njit(cache=True, nogil=True, _nrt=False)
def turn_position_errors(p, n, change):
    """P, of n states, after the position errors have gained phi x ``change`` (m); numbers or lanes."""
    _gain(p, n, 0, change)


@njit(cache=True, nogil=True, _nrt=False)
def turn_attitude_errors(p, n, change):
    """P, of n states, after the attitude errors have gained phi x ``change`` (rad); numbers or lanes."""
    _gain(p, n, 6, change)


@njit(cache=True, nogil=True, _nrt=False, forceinline=True)
def _gain(p, n, first, change):
    """Rows, then columns ``first`` to ``first`` + 2 of P gain phi x ``change``."""
    for j in range(n):
        north, east, down = p[6, j], p[7, j], p[8, j]
        p[first, j] = p[first, j] + (east * change[2] - down * change[1])
        p[first + 1, j] = p[first + 1, j] + (down * change[0] - north * change[2])
        p[first + 2, j] = p[first + 2, j] + (north * change[1] - east * change[0])
    # of the columns only those that meet these rows: all others are rows already
    for j in range(first, first + 3):
        north, east, down = p[j, 6], p[j, 7], p[j, 8]
        p[j, first] = p[j, first] + (east * change[2] - down * change[1])
        p[j, first + 1] = p[j, first + 1] + (down * change[0] - north * change[2])
        p[j, first + 2] = p[j, first + 2] + (north * change[1] - east * change[0])
    for i in range(first, first + 3):
        for j in range(n):
            p[j, i] = p[i, j]
