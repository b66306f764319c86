"""Fixed-interval smoothing: what the state was at each IMU sample, given the whole log. For any composition.

The Rauch-Tung-Striebel smoother in the form of Bryson and Frazier, which needs no inverse: Bierman, *Automatica* 9 (1973);
Gibbs, *JGCD* 34 (2011). An adjoint ``lam`` (n,) and its information ``info`` (n,n) run backwards; at every sample the
smoothed correction is -P lam and the smoothed covariance P - P info P, about the filter's own state. SI units and radians.

Going backwards needs what the filter did. It is kept for one segment of the log at a time: the filter runs once to set
checkpoints, and then again over each segment, the last one first.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from estimators.core.composition import Prepared, make_model, make_recording, make_timeline_of, solution_of
from estimators.core.filter import begin, correct, move, record, retract, spread
from estimators.core.model import INVARIANT, REJECTED, Model
from estimators.core.postponed import catch_up
from estimators.core.propagate import NAV, blocks_of, make_covariance, transition
from estimators.core.timeline import SAME_TIME, Timeline, inner, steps, walk
from testbed.data.records import NavSolution
from testbed.kernels import njit
from testbed.kernels.lanes import WIDTH, aligned
from testbed.physics.rotations import cross

Array = NDArray[np.float64]

PREDICTION, UPDATE, SAMPLE = 0, 1, 2
"""What a step of a `Tape` was."""
ROUNDING = 1e-15
"""Least share of the filter's variance that a smoothed one can have: P - P info P is a difference in double precision."""


class Tape(NamedTuple):
    """All that a filter did over a segment."""

    steps: NDArray[np.int64]
    """(L,) kinds of steps, in order."""
    used: NDArray[np.int64]
    """(4,) predictions, updates, samples and steps on the tape."""
    phi: Array
    """(predictions,9 registers,WIDTH) nine rows of Phi, see `transition`."""
    keep: Array
    """(predictions,k) the rest of its diagonal."""
    dt: Array
    """(predictions,) s, for states that are integrals of others."""
    rows: NDArray[np.int64]
    """(updates,) measurements of an update."""
    h: Array
    """(updates,m,n)"""
    gain: Array
    """(updates,m,n) of the scalars one after the other."""
    scalars: Array
    """(updates,m,2) innovation and variance of each."""
    change: Array
    """(updates,9) by which the errors of position (m), velocity (m/s) and attitude (rad) turned: see `retract`."""
    state: Array
    """(samples,10+k)"""
    p: Array
    """(samples,n,n)"""
    before: Array
    """(n,n) covariance before an update."""
    unit: Array
    """Table of the unit matrix, see `transition`."""


class Taped(NamedTuple):
    """A filter and the tape that it runs beside, for `walk`."""

    model: Model
    tape: Tape


class Adjoint(NamedTuple):
    """What the rest of the log says about the present state, overwritten on the way back."""

    lam: Array
    """(n,)"""
    info: Array
    """(n,n)"""
    scratch: Array
    """(n,n)"""


def smooth(prepared: Prepared, segment: int | None = None) -> NavSolution:
    """Smoothed states, standard deviations and covariances of a prepared log; innovations are those of the filter.

    ``segment``: IMU samples that are filtered and swept at a time. The square root of their number, which is the default,
    makes the memory least: as many covariances in checkpoints as in a segment, a few megabytes for an hour.
    """
    recording, line = make_recording(prepared), make_timeline_of(prepared)
    model = make_model(prepared, recording)
    count, n = len(line.t), len(prepared.states)
    length = segment or math.isqrt(count - 1) + 1
    carried = _carried(model, line)
    starts, checkpoints = range(0, count, length), []
    for first in starts:
        checkpoints.append([array.copy() for array in carried])
        walk(line, model, min(first + length, count))
    taped = Taped(model, _make_tape(prepared, line, length))
    adjoint = Adjoint(np.zeros(n), np.zeros((n, n)), np.zeros((n, n)))
    for first, kept in zip(reversed(starts), reversed(checkpoints), strict=True):
        for array, values in zip(carried, kept, strict=True):
            array[...] = values
        taped.tape.used[:] = 0
        walk(line, taped, min(first + length, count))
        sweep(taped, adjoint, min(first + length, count))
    return solution_of(prepared, recording)


def _carried(model: Model, line: Timeline) -> list[NDArray[Any]]:
    """All that a filter may carry from one sample to the next."""
    waiting = model.propagation
    in_use = (
        *model.blocks[2:],
        *model.coupling[1:],
        *model.work,
        waiting.phi,
        waiting.waited,
        waiting.noise,
        waiting.pending,
    )
    return [model.state, model.p, model.events.memory, *in_use, line.now, line.place]


def _make_tape(prepared: Prepared, line: Timeline, length: int) -> Tape:
    """Room for what happens in ``length`` IMU samples, wherever in the log."""
    bounds = np.searchsorted(line.event_t, line.t[length - 1 :: length] + SAME_TIME, side="right")
    updates = int(np.diff(np.concatenate([[0], bounds, [len(line.event_t)]])).max())
    predictions, k, n = length + updates, len(prepared.drive), len(prepared.states)
    m = max([1, *(len(a.channels) for a in prepared.aidings)])
    registers = NAV * blocks_of(n)
    return Tape(
        steps=np.zeros(predictions + updates + length, dtype=np.int64),
        used=np.zeros(4, dtype=np.int64),
        phi=aligned(predictions * registers).reshape(predictions, registers, WIDTH),
        keep=np.zeros((predictions, k)),
        dt=np.zeros(predictions),
        rows=np.zeros(updates, dtype=np.int64),
        h=np.zeros((updates, m, n)),
        gain=np.zeros((updates, m, n)),
        scalars=np.zeros((updates, m, 2)),
        change=np.zeros((updates, 9)),
        state=np.zeros((length, len(prepared.start))),
        p=np.zeros((length, n, n)),
        before=np.zeros((n, n)),
        unit=make_covariance(np.eye(n))[1].p,
    )


@njit(cache=True, nogil=True, _nrt=False)
def _next(tape, kind):
    """Place of a further step of this kind."""
    place = tape.used[kind]
    tape.steps[tape.used[3]] = kind
    tape.used[kind] += 1
    tape.used[3] += 1
    return place


@njit(cache=True, nogil=True, _nrt=False)
def _begin(taped, k, whole):
    begin(taped.model, k, whole)


@njit(cache=True, nogil=True, _nrt=False)
def _predict(taped, k, dt, part):
    model, tape = taped.model, taped.tape
    motion, middle = move(model, k, dt, part)
    i = _next(tape, PREDICTION)
    transition(tape.unit, tape.phi[i], model.coupling, motion, dt)
    for j in range(tape.keep.shape[1]):
        tape.keep[i, j] = model.coupling.keep[j]
    tape.dt[i] = dt
    spread(model, motion, middle, dt)


@njit(cache=True, nogil=True, _nrt=False)
def _correct(taped, k, e):
    model, tape = taped.model, taped.tape
    before, p, n = tape.before, model.p, tape.before.shape[0]
    catch_up(model)
    for i in range(n):
        for j in range(n):
            before[i, j] = p[i, j]
    correct(model, k, e)
    fading = model.keep.fading[e]
    if fading == REJECTED:
        return
    place, count = _next(tape, UPDATE), model.events.rows[model.events.kind[e]]
    tape.rows[place] = count
    for a in range(count):
        tape.scalars[place, a, 0], tape.scalars[place, a, 1] = model.work.scalars[a, 0], model.work.scalars[a, 1]
        for i in range(n):
            tape.h[place, a, i] = model.work.h[a, i]
    _gains(before, max(fading, 1.0), tape.h[place], tape.scalars[place], tape.gain[place], count)
    for i in range(6):
        # With `PHI` a correction of the position leaves the coordinates of the error as they are.
        tape.change[place, i] = model.work.x[i] if i >= 3 or model.error == INVARIANT else 0.0
    for i in range(6, 9):
        tape.change[place, i] = -0.5 * model.work.x[i] if model.error == INVARIANT else 0.0


@njit(cache=True, nogil=True, _nrt=False)
def _gains(before, fading, h, scalars, gain, count):
    """Gains of scalars that follow one another: P h_a / s_a, where P has lost K_b s_b K_b' to each b before."""
    n = before.shape[0]
    for a in range(count):
        for i in range(n):
            gain[a, i] = 0.0
        for j in range(n):
            if h[a, j] != 0.0:
                for i in range(n):
                    gain[a, i] += fading * before[j, i] * h[a, j]
        for b in range(a):
            share = scalars[b, 1] * _dot(gain[b], h[a])
            for i in range(n):
                gain[a, i] -= gain[b, i] * share
        for i in range(n):
            gain[a, i] /= scalars[a, 1]


@njit(cache=True, nogil=True, _nrt=False)
def _record(taped, k):
    model, tape = taped.model, taped.tape
    catch_up(model)
    i = _next(tape, SAMPLE)
    for j in range(tape.state.shape[1]):
        tape.state[i, j] = model.state[j]
    for a in range(tape.before.shape[0]):
        for b in range(tape.before.shape[0]):
            tape.p[i, a, b] = model.p[a, b]


steps(Taped, _begin, _predict, _correct, _record)


@njit(cache=True, nogil=True, _nrt=False)
def sweep(taped, adjoint, stop):
    """Take the adjoint back over the tape, which ends with IMU sample ``stop`` - 1, and record what is smoothed."""
    tape = taped.tape
    prediction, update, sample = tape.used[0], tape.used[1], tape.used[2]
    k = stop
    for step in range(tape.used[3] - 1, -1, -1):
        kind = tape.steps[step]
        if kind == SAMPLE:
            sample -= 1
            k -= 1
            _smoothed(taped.model, tape.state[sample], tape.p[sample], adjoint)
            record(taped.model, k)
        elif kind == PREDICTION:
            prediction -= 1
            rows = tape.phi[prediction]
            phi = rows.reshape((NAV, rows.shape[0] // NAV * WIDTH))
            _before_integration(adjoint, taped.model.inputs.chain, tape.dt[prediction])
            _before_prediction(adjoint, phi, tape.keep[prediction])
        else:
            update -= 1
            _before_turn(adjoint, tape.change[update])
            for a in range(tape.rows[update] - 1, -1, -1):
                _before_scalar(adjoint, tape.h[update, a], tape.gain[update, a], tape.scalars[update, a])


@inner
def _smoothed(model, state, p, adjoint):
    """The model's state and covariance: those of a sample, ``state`` and ``p``, moved by what came after it."""
    lam, info, product, n = adjoint.lam, adjoint.info, adjoint.scratch, p.shape[0]
    x, out = model.work.x, model.p
    for i in range(state.shape[0]):
        model.state[i] = state[i]
    for i in range(n):
        x[i] = -_dot(p[i], lam)
        for j in range(n):
            product[i, j] = 0.0
        for a in range(n):
            for j in range(n):
                product[i, j] += info[i, a] * p[a, j]
    for i in range(n):
        for j in range(n):
            out[i, j] = p[i, j]
        for a in range(n):
            for j in range(i + 1):
                out[i, j] -= p[i, a] * product[a, j]
        out[i, i] = max(out[i, i], ROUNDING * p[i, i])
        for j in range(i):
            out[j, i] = out[i, j]
    retract(model)


@njit(cache=True, nogil=True, _nrt=False)
def _before_prediction(adjoint, phi, keep):
    """lam = Phi' lam, info = Phi' info Phi; noise that is added to P leaves both as they are."""
    lam, info, product, n = adjoint.lam, adjoint.info, adjoint.scratch, adjoint.lam.shape[0]
    for i in range(n):
        for j in range(NAV):
            product[i, j] = 0.0
        for j in range(NAV, n):
            product[i, j] = info[i, j] * keep[j - NAV]
        for a in range(NAV):
            for j in range(n):
                product[i, j] += info[i, a] * phi[a, j]
    for i in range(n):
        for j in range(n):
            info[i, j] = product[i, j] * keep[i - NAV] if i >= NAV else 0.0
        for a in range(NAV):
            for j in range(n):
                info[i, j] += phi[a, i] * product[a, j]
    for i in range(n):
        for j in range(i):
            info[j, i] = info[i, j]
    for j in range(n - 1, -1, -1):
        total = lam[j] * keep[j - NAV] if j >= NAV else 0.0
        for a in range(NAV):
            total += phi[a, j] * lam[a]
        product[0, j] = total
    for j in range(n):
        lam[j] = product[0, j]


@njit(cache=True, nogil=True, _nrt=False)
def _before_integration(adjoint, chain, dt):
    """lam = A' lam, info = A' info A, where A lets one state gain ``dt`` times another (see `integrate_pairs`)."""
    lam, info, n = adjoint.lam, adjoint.info, adjoint.lam.shape[0]
    for c in range(chain.shape[0]):
        i, j = NAV + chain[c, 0], NAV + chain[c, 1]
        lam[j] += dt * lam[i]
        for a in range(n):
            info[a, j] += dt * info[a, i]
        for a in range(n):
            info[j, a] += dt * info[i, a]


@njit(cache=True, nogil=True, _nrt=False)
def _before_scalar(adjoint, h, gain, scalar):
    """lam = (I - K h)' lam - h v / s, info = (I - K h)' info (I - K h) + h h' / s for one scalar measurement."""
    lam, info, weight, n = adjoint.lam, adjoint.info, adjoint.scratch[0], adjoint.lam.shape[0]
    drop = _dot(gain, lam) + scalar[0] / scalar[1]
    for i in range(n):
        weight[i] = _dot(info[i], gain)
    both = _dot(gain, weight) + 1.0 / scalar[1]
    for i in range(n):
        lam[i] -= h[i] * drop
        for j in range(n):
            info[i, j] += h[i] * h[j] * both - (h[i] * weight[j] + weight[i] * h[j])


@njit(cache=True, nogil=True, _nrt=False)
def _before_turn(adjoint, change):
    """lam = G' lam, info = G' info G, where G lets the errors gain phi x ``change``, attitude last (see `retract`)."""
    lam, info, n = adjoint.lam, adjoint.info, adjoint.lam.shape[0]
    for i in range(n):
        _add_turn(info[i], change)
    for j in range(n):
        _add_turn(info[:, j], change)
    _add_turn(lam, change)


@njit(cache=True, nogil=True, _nrt=False)
def _add_turn(a, change):
    """Attitude's share of an adjoint row gains the three turns x the shares of position, velocity and attitude."""
    by_place = cross((change[0], change[1], change[2]), (a[0], a[1], a[2]))
    by_velocity = cross((change[3], change[4], change[5]), (a[3], a[4], a[5]))
    by_attitude = cross((change[6], change[7], change[8]), (a[6], a[7], a[8]))
    for i in range(3):
        a[6 + i] += by_place[i] + by_velocity[i] + by_attitude[i]


@njit(cache=True, nogil=True, _nrt=False)
def _dot(a, b):
    total = 0.0
    for i in range(a.shape[0]):
        total += a[i] * b[i]
    return total
