"""States that wait: what nothing needs between two measurements is carried over the whole of it at once. Kernels only.

A sensor-error state that neither adds to the IMU nor is integrated (a delay of the atmosphere, an error of a satellite's
range) changes P between measurements only by its own decay and by what the navigation errors do to their covariance with it.
For a filter with many such states the transition of the others is multiplied up from sample to sample, a few columns, and
meets the many when a measurement comes. With F = [[A, 0], [0, K]], K diagonal, the parts of P become A P_er K and K P_rr K + Q:
what `propagate` computes sample by sample, but for rounding. e: eager, the first states, which no sample leaves out; r: the rest.
"""

from __future__ import annotations

import numpy as np
from numba import types
from numba.extending import overload

from estimators.core.propagate import NAV, moved, store_errors
from estimators.core.timeline import INLINED
from testbed.kernels import njit
from testbed.kernels.lanes import WIDTH, load, splat, store


def postpone(p, scratch, coupling, drive, motion, dt):
    """Take note of a step of ``dt`` for the states that wait; arguments as of `propagate` and `add_noise`."""
    raise NotImplementedError("kernels only")


def settle(p, scratch, chain):
    """Bring P up to the present: everything that was postponed."""
    raise NotImplementedError("kernels only")


@overload(postpone)
def _choose_postpone(p, scratch, coupling, drive, motion, dt):
    if isinstance(p, types.Array):
        return lambda p, scratch, coupling, drive, motion, dt: _postpone(p, scratch, coupling, drive, motion, dt)
    return lambda p, scratch, coupling, drive, motion, dt: None  # filters side by side carry all states at once


@overload(settle)
def _choose_settle(p, scratch, chain):
    if isinstance(p, types.Array):
        return lambda p, scratch, chain: _settle(p, scratch, chain)
    return lambda p, scratch, chain: None


@njit(cache=True, nogil=True, _nrt=False)
def _postpone(p, scratch, coupling, drive, motion, dt):
    n, eager, phi, keep, noise = p.shape[0], scratch.columns.shape[0] // 2, scratch.phi, scratch.kept, scratch.noise
    if eager == n:
        return
    states = scratch.transition.shape[0]
    blocks = scratch.transition.shape[1] // WIDTH
    couples = coupling.spans, coupling.accel, coupling.gyro
    for b in range(blocks):
        store_errors(phi, b, blocks, moved(phi, b, blocks, couples, motion, dt))
    for i in range(NAV, states):
        scratch.transition[i, i] *= coupling.keep[i - NAV]
    for i in range(NAV, n):
        keep[i] *= coupling.keep[i - NAV]
    for i in range(eager, n):
        fade = coupling.keep[i - NAV]
        noise[i] = noise[i] * (fade * fade) + drive[i - NAV] * dt
    scratch.pending[0] += dt


@njit(cache=True, nogil=True, _nrt=False)
def _settle(p, scratch, chain):
    since = scratch.pending[0]
    if since == 0.0:
        return
    n, eager, keep, noise = p.shape[0], scratch.columns.shape[0] // 2, scratch.kept, scratch.noise
    table, blocks = scratch.p, p.shape[1] // WIDTH
    for b in range(eager // WIDTH, blocks):
        _cross(scratch, chain, since, b, blocks)
    for i in range(eager, n):
        for b in range(eager // WIDTH, blocks):
            x = load(table, i * blocks + b)
            store(table, i * blocks + b, x * (keep[i] * load(scratch.waited, b)))
        p[i, i] += noise[i]
        noise[i] = 0.0
        for j in range(eager):
            p[i, j] = p[j, i]
    start_waiting(scratch)


@njit(cache=True, nogil=True, _nrt=False, forceinline=True)
def _cross(scratch, chain, since, b, blocks):
    """Rows of the eager states in register ``b`` of columns, of ``blocks``: A P_er K."""
    table, rows, a, keep = scratch.p, scratch.rows, scratch.transition, scratch.kept
    fade, eager = load(scratch.waited, b), scratch.columns.shape[0] // 2
    for i in range(NAV):
        total = splat(0.0)
        for j in range(a.shape[0]):
            total = total + a[i, j] * load(table, j * blocks + b)
        # apart, as the old ones are needed until all nine are made
        store(rows, i, total * fade)
    for i in range(NAV):
        store(table, i * blocks + b, load(rows, i))
    for c in range(chain.shape[0]):
        i, j = (NAV + chain[c, 0]) * blocks + b, (NAV + chain[c, 1]) * blocks + b
        store(table, i, load(table, i) + since * load(table, j))
    for i in range(NAV, eager):
        store(table, i * blocks + b, load(table, i * blocks + b) * (keep[i] * fade))


@njit(cache=True, nogil=True, _nrt=False)
def start_waiting(scratch):
    """Nothing is postponed: the transition is 1."""
    a = scratch.transition
    for i in range(a.shape[0]):
        for j in range(a.shape[1]):
            a[i, j] = 1.0 if i == j else 0.0
    for i in range(scratch.kept.shape[0]):
        scratch.kept[i] = 1.0
    scratch.pending[0] = 0.0


def catch_up(model):
    """`settle` a filter's model; nothing where no state of it waits."""
    raise NotImplementedError("kernels only")


def present_std(model, out):
    """Standard deviations of the first states now, as many as ``out`` takes, also of those that wait."""
    raise NotImplementedError("kernels only")


@overload(catch_up, jit_options=INLINED)
def _choose_catch_up(model):
    if "propagation" in model.fields:
        return lambda model: settle(model.p, model.propagation, model.inputs.chain)
    return lambda model: None


@overload(present_std, jit_options=INLINED)
def _choose_present_std(model, out):
    if "propagation" in model.fields:
        return lambda model, out: _present_std(model.p, model.propagation, model.inputs.eager, out)
    return lambda model, out: _roots(model.p, out, out.shape[0])


@njit(cache=True, nogil=True, _nrt=False, forceinline=True)
def _roots(p, out, count):
    for i in range(count):
        out[i] = np.sqrt(p[i, i])


@njit(cache=True, nogil=True, _nrt=False, forceinline=True)
def _present_std(p, scratch, eager, out):
    count = out.shape[0]
    _roots(p, out, min(eager, count))
    for i in range(eager, count):
        keep = scratch.kept[i]
        out[i] = np.sqrt(p[i, i] * (keep * keep) + scratch.noise[i])
