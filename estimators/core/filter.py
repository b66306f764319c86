"""The error-state filter: what begins, carries, corrects and records a composition of blocks, aidings and policies.

Groves, 2nd ed., chapters 5 and 14. Kernels only, on floats or lanes, that work on `estimators.core.model.Model`;
`estimators.core.composition` makes one.
"""

from __future__ import annotations

import numpy as np
from numba.extending import overload

from estimators.core.calls import NOTHING, call_couple, call_couple_lanes, call_measure, call_measure_lanes, call_policy
from estimators.core.model import AUX, INVARIANT, REJECTED, Model, attitude, is_single, put_triple, scaled, triple
from estimators.core.nav_errors import coefficients
from estimators.core.postponed import catch_up, postpone
from estimators.core.propagate import (
    NAV,
    add_noise,
    integrate_pairs,
    propagate,
    turn_attitude_errors,
    turn_position_errors,
    turn_velocity_errors,
)
from estimators.core.recording import Recording, note_sample, note_update
from estimators.core.strapdown import advance, compensate, coning_sculling
from estimators.core.timeline import INLINED, inner, steps
from estimators.core.update import innovation_covariance, update_considering
from testbed.kernels import njit
from testbed.kernels.lanes import is_zero
from testbed.physics import earth
from testbed.physics.rotations import (
    cross,
    matrix_rotate,
    quat_multiply,
    quat_normalize,
    quat_to_matrix,
    rotvec_to_quat,
)

SAME_STEP = 1e-11
"""Steps (s) closer than this fade alike: differences of times after half a day are no more exact, and a fast state, of a
tenth of a second, is kept to 1e-10."""


@njit(cache=True, nogil=True, _nrt=False)
def mean_matrix(a, b):
    """Mean of two matrices of nested tuples: C_nb in the middle of a step, to second order."""
    return (
        (0.5 * (a[0][0] + b[0][0]), 0.5 * (a[0][1] + b[0][1]), 0.5 * (a[0][2] + b[0][2])),
        (0.5 * (a[1][0] + b[1][0]), 0.5 * (a[1][1] + b[1][1]), 0.5 * (a[1][2] + b[1][2])),
        (0.5 * (a[2][0] + b[2][0]), 0.5 * (a[2][1] + b[2][1]), 0.5 * (a[2][2] + b[2][2])),
    )


@inner
def begin(model, k, whole):
    """Open IMU sample ``k``: its coupling, and the coning and sculling of its whole interval (s)."""
    clean, before, corrections = model.work.clean, model.work.whole, model.work.corrections
    _couple_blocks(model, k)
    _clean(model, k)
    angle, velocity = scaled(triple(clean, 0), whole), scaled(triple(clean, 3), whole)
    coning, sculling = coning_sculling(angle, velocity, triple(before, 0), triple(before, 3))
    put_triple(before, 0, angle)
    put_triple(before, 3, velocity)
    put_triple(corrections, 0, coning)
    put_triple(corrections, 3, sculling)


@inner
def predict(model, k, dt, part):
    """Carry state and covariance ``dt`` (s) on within IMU sample ``k``, ``part`` of its interval."""
    motion, middle = move(model, k, dt, part)
    spread(model, motion, middle, dt)


@inner
def spread(model, motion, middle, dt):
    """Carry the covariance over a step of ``dt`` that `move` made."""
    eager, drive = model.inputs.eager, model.work.drive
    propagate(model.p, model.propagation, model.coupling, motion, dt)
    integrate_pairs(model.p, eager, model.inputs.chain, dt)
    add_noise(model.p, middle, model.inputs.white, drive[: eager - NAV], dt)
    postpone(model.p, model.propagation, model.coupling, drive, motion, dt)


@inner
def move(model, k, dt, part):
    """The state's share of `predict`: returns the motion as `propagate` takes it, and C_nb in the middle of the step."""
    state, clean, corrections = model.state, model.work.clean, model.work.corrections
    decay, centre, keep, last_dt = model.inputs.decay, model.inputs.centre, model.coupling.keep, model.work.dt
    spans = model.coupling.spans
    _clean(model, k)
    rotation, change = compensate(
        scaled(triple(clean, 0), dt),
        scaled(triple(clean, 3), dt),
        scaled(triple(corrections, 0), part),
        scaled(triple(corrections, 3), part),
    )
    lat, lon, h = triple(state, 0)
    v, q = triple(state, 3), attitude(state)
    rates = coefficients(lat, h, v)
    lat, lon, h, v_end, q_end, force = advance(lat, lon, h, v, q, rotation, change, dt)
    put_triple(state, 0, (lat, lon, h))
    put_triple(state, 3, v_end)
    for i in range(4):
        state[6 + i] = q_end[i]
    if np.abs(dt - last_dt[0]) > SAME_STEP:
        last_dt[0] = dt
        for i in range(decay.shape[0]):
            keep[i] = np.exp(-dt * decay[i])
            # what drives a state loses of itself within the step; errors of the IMU are integrated as they were driven
            faded = -np.expm1(-2.0 * dt * decay[i]) / (2.0 * dt * decay[i]) if decay[i] > 0.0 and i >= spans[3] else 1.0
            model.work.drive[i] = model.inputs.drive[i] * faded
    chain = model.inputs.chain
    for c in range(chain.shape[0]):
        i, j = AUX + chain[c, 0], AUX + chain[c, 1]
        state[i] = state[i] + state[j] * dt
    for i in range(decay.shape[0]):
        state[AUX + i] = centre[i] + keep[i] * (state[AUX + i] - centre[i])
    middle = mean_matrix(quat_to_matrix(q), quat_to_matrix(q_end))
    _turn(middle, model.blocks.accel, model.coupling.accel, spans[0], spans[1])
    _turn(middle, model.blocks.gyro, model.coupling.gyro, spans[2], spans[3])
    return (rates, force, v), middle


@inner
def observe(model, k, e):
    """Residual, H and R of event ``e`` at the present state into the work arrays; returns the number of rows."""
    events = model.events
    kind = events.kind[e]
    count = events.rows[kind]
    residual, h, r = model.work.residual[:count], model.work.h[:count], model.work.r[:count]
    variances = events.r[e]
    _clean(model, k)
    for a in range(count):
        r[a] = variances[a]
        for i in range(h.shape[1]):
            h[a, i] = 0.0
    _measure(model, kind, e, residual, h)
    if events.mix.shape[0]:
        _unmix(events.mix[e], residual, h)
    return count


@njit(cache=True, nogil=True, _nrt=False)
def _unmix(mix, residual, h):
    """Residual and H times L^-1, L = ``mix``: measurements whose noise is independent, in the order of the channels."""
    for a in range(residual.shape[0]):
        for b in range(a):
            share = mix[a, b]
            if not is_zero(share):
                residual[a] = residual[a] - share * residual[b]
                for i in range(h.shape[1]):
                    h[a, i] = h[a, i] - share * h[b, i]


@inner
def correct(model, k, e):
    """Use event ``e`` at the present state, which lies within IMU sample ``k``."""
    x, p, kind = model.work.x, model.p, model.events.kind[e]
    catch_up(model)
    count = observe(model, k, e)
    residual, h, r = model.work.residual[:count], model.work.h[:count], model.work.r[:count]
    fading = _judge(model, kind, residual, h, r)
    if fading != REJECTED:
        for i in range(h.shape[1]):
            x[i] = 0.0
        work = model.work
        update_considering(x, p, residual, h, r, work.scalars, work.scratch, model.inputs.estimated)
        retract(model)
    note_update(model.keep, model, e, count, fading)


@inner
def record(model, k):
    """Keep what is known at the end of IMU sample ``k``."""
    note_sample(model.keep, model, k)


steps(Model, begin, predict, correct, record)


@inner
def retract(model):
    """Add the correction ``x`` to the nominal state and carry P to where that moves it.

    What stays Gaussian while an attitude error of many degrees shrinks is the velocity error without what the attitude
    error makes of the velocity, dv - phi x v (Barrau and Bonnabel, IEEE TAC 2017; python-ins' modified phi-angle model).
    Held fixed over the correction, it lets dv gain phi x (change of v). `PHI` stops there. `INVARIANT` takes the whole
    right-invariant error of SE2(3): position errors likewise gain phi x (change of position), and the correction is the
    group's exponential, so that turning the attitude turns the velocity with it. Its coordinates are those of `PHI` times
    a matrix that follows the trajectory, so propagation and H need no second form. Once a correction x is made, an
    attitude error x + p has become p + x x p / 2 (Sola, arXiv:1711.02508, eq. 287). Without that turn P ties attitude to
    misalignments along axes that have moved, and takes their common rotation, which nothing can observe, for known.
    """
    state, x = model.state, model.work.x
    n = model.work.h.shape[1]
    lat, lon, h = triple(state, 0)
    place, v, turn = triple(x, 0), triple(x, 3), triple(x, 6)
    if model.error == INVARIANT:
        place, v = _exponential(triple(state, 3), place, v, turn)
    per_north, per_east = earth.metres_per_radian(lat, h)
    q = quat_normalize(quat_multiply(rotvec_to_quat(turn), attitude(state)))
    put_triple(state, 0, (lat + place[0] / per_north, lon + place[1] / per_east, h - place[2]))
    for i in range(3):
        state[3 + i] = state[3 + i] + v[i]
    for i in range(4):
        state[6 + i] = q[i]
    for i in range(n - NAV):
        state[AUX + i] = state[AUX + i] + x[NAV + i]
    if model.error == INVARIANT:
        turn_position_errors(model.p, n, place)
    turn_velocity_errors(model.p, n, v)
    if model.error == INVARIANT:
        turn_attitude_errors(model.p, n, scaled(turn, -0.5))
    put_triple(x, 0, place)
    put_triple(x, 3, v)


@njit(cache=True, nogil=True, _nrt=False)
def _exponential(v_n, place, v, turn):
    """Changes of position and velocity by the exponential of SE2(3), its origin at the present position.

    ``place``, ``v``, ``turn``: the correction in the coordinates of `PHI`. The left Jacobian is taken to third order in
    the angle: at 60 degrees it is right to a per cent, which the next update sees as noise.
    """
    tilted = cross(turn, v_n)
    change = (v[0] - tilted[0], v[1] - tilted[1], v[2] - tilted[2])
    m = quat_to_matrix(rotvec_to_quat(turn))
    turned = matrix_rotate(m, v_n)
    push = _jacobian_times(turn, change)
    v_end = (turned[0] - v_n[0] + push[0], turned[1] - v_n[1] + push[1], turned[2] - v_n[2] + push[2])
    return _jacobian_times(turn, place), v_end


@njit(cache=True, nogil=True, _nrt=False)
def _jacobian_times(turn, a):
    """Left Jacobian of SO(3) times a triple: 1 + 1/2 [t x] + (1/6 - t²/120) [t x]² (Sola, arXiv:1711.02508, eq. 145)."""
    once = cross(turn, a)
    twice = cross(turn, once)
    square = turn[0] * turn[0] + turn[1] * turn[1] + turn[2] * turn[2]
    first, second = 0.5 - square * (1.0 / 24.0), 1.0 / 6.0 - square * (1.0 / 120.0)
    return (
        a[0] + first * once[0] + second * twice[0],
        a[1] + first * once[1] + second * twice[1],
        a[2] + first * once[2] + second * twice[2],
    )


@inner
def _clean(model, k):
    """The IMU sample without its estimated errors, into ``work.clean``."""
    spans, clean, state, imu = model.coupling.spans, model.work.clean, model.state, model.inputs.imu[k]
    accel, gyro = model.blocks.accel, model.blocks.gyro
    for i in range(3):
        rate, force = imu[i], imu[3 + i]
        for j in range(spans[2], spans[3]):
            rate = rate - gyro[j, i] * state[AUX + j]
        for j in range(spans[0], spans[1]):
            force = force - accel[j, i] * state[AUX + j]
        clean[i] = rate
        clean[3 + i] = force


@inner
def _estimate_sample(model, k):
    """What the sensors would have felt without errors, into ``work.sample``: errors multiply the truth, not the output.

    Sample ``k`` less what was taken from the one before. At the output, a misalignment would multiply the bias, too.
    """
    sample, clean, imu = model.work.sample, model.work.clean, model.inputs.imu
    for i in range(6):
        taken = (imu[k - 1][i] - clean[i]) if k > 0 else 0.0 * clean[i]
        sample[i] = imu[k][i] - taken


@njit(cache=True, nogil=True, _nrt=False, forceinline=True)
def _turn(m, in_b, in_n, first, last):
    """Couplings of states ``first`` to ``last`` from b to n."""
    for j in range(first, last):
        a = matrix_rotate(m, (in_b[j, 0], in_b[j, 1], in_b[j, 2]))
        for i in range(3):
            in_n[j, i] = a[i]


def _couple_blocks(model, k):
    raise NotImplementedError("kernels only")


def _measure(model, kind, e, residual, h):
    raise NotImplementedError("kernels only")


def _judge(model, kind, residual, h, r):
    raise NotImplementedError("kernels only")


@overload(_couple_blocks, jit_options=INLINED)
def _couple(model, k):
    call = call_couple if is_single(model) else call_couple_lanes

    def couple(model, k):
        blocks = model.blocks
        if blocks.couples.shape[0]:
            _estimate_sample(model, k)
        for b in range(blocks.couples.shape[0]):
            i, j = blocks.places[b, 0], blocks.places[b, 1]
            aux = model.state[AUX + i : AUX + j]
            call(blocks.couples[b], (aux, model.work.sample, blocks.accel[i:j], blocks.gyro[i:j]))

    return couple


@overload(_measure, jit_options=INLINED)
def _take_measure(model, kind, e, residual, h):
    call = call_measure if is_single(model) else call_measure_lanes

    def measure(model, kind, e, residual, h):
        events = model.events
        arguments = (model.state, model.work.clean, events.parameters[kind], events.z[e], residual, h)
        call(events.measures[kind], arguments)

    return measure


@overload(_judge, jit_options=INLINED)
def _call_judge(model, kind, residual, h, r):
    if is_single(model):
        return _judge_single
    return _judge_lanes if model[model.fields.index("keep")].instance_class is Recording else _judge_unseen


def _judge_single(model, kind, residual, h, r):
    """Innovation covariance into ``work.s``; then the policy, which may change R, reject, or fade P."""
    work, events = model.work, model.events
    count = residual.shape[0]
    s = work.s[: count * count].reshape((count, count))
    innovation_covariance(model.p, h, r, s, work.scratch)
    fading = 1.0
    if events.policies[kind] != NOTHING:
        for a in range(count):
            work.scalars[a, 0] = r[a]
        fading = call_policy(events.policies[kind], (events.memory[kind], residual, s, r, h, model.p))
        changed = fading > 1.0
        for a in range(count):
            changed = changed or work.scalars[a, 0] != r[a]
        if fading > 1.0:
            _fade(model.p, h.shape[1], fading)
        if changed and fading != REJECTED:
            innovation_covariance(model.p, h, r, s, work.scratch)
    return fading


def _judge_lanes(model, kind, residual, h, r):
    """Side by side all updates are plain ones."""
    count = residual.shape[0]
    innovation_covariance(model.p, h, r, model.work.s[: count * count].reshape((count, count)), model.work.scratch)
    return 1.0


def _judge_unseen(model, kind, residual, h, r):
    """Nobody keeps the covariance of the innovation."""
    return 1.0


@njit(cache=True, nogil=True, _nrt=False)
def _fade(p, n, factor):
    """P = factor P."""
    for i in range(n):
        for j in range(n):
            p[i, j] *= factor
