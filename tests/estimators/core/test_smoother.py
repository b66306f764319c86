"""The smoother against a dense Rauch-Tung-Striebel smoother in numpy, and against its own filter."""

import tracemalloc
from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from filter_steps import begin, correct, move, record, retract, spread
from scipy.stats import t as student
from synthetic import sensor_log, weaving_flight

from estimators.core import smoother
from estimators.core.composition import make_model, make_recording, make_timeline_of
from estimators.core.model import AUX, REJECTED
from estimators.core.propagate import make_covariance, transition
from estimators.core.timeline import SAME_TIME
from estimators.methods.eskf import Eskf
from testbed.base.errors import InputError
from testbed.kernels.lanes import aligned
from testbed.physics import earth
from testbed.physics.rotations import attitude_error, attitude_errors, quat_multiply, rotvec_to_quat

STEP = np.repeat([50.0, 1.0, 1e-4, 1e-2, 1e-4], 3)
"""For differences: m, m/s, rad, m/s², rad/s."""


@cache
def truth(duration_s=20.0):
    return weaving_flight(duration_s, bank=0.6)


@cache
def biased_log(duration_s=4.0):
    """Unknown biases, a gap of the fixes, and two fixes that are 20 sigma off."""
    log = sensor_log(truth(), 3, outages=((1.5, 2.5),), gyro_bias=2e-3, std=(10.0, 1.0, 0.01), gnss_rate=5.0)
    rows, seen = log.imu.t <= duration_s, log.gnss.t <= duration_s
    imu = replace(log.imu, t=log.imu.t[rows], gyro=log.imu.gyro[rows], accel=log.imu.accel[rows])
    h = log.gnss.h[seen]
    h[[3, 9]] += 200.0
    # Fixes between the samples of the IMU, so that a sample takes two steps.
    gnss = replace(
        log.gnss,
        t=log.gnss.t[seen] - 0.004,
        lat=log.gnss.lat[seen],
        lon=log.gnss.lon[seen],
        h=h,
        v_n=log.gnss.v_n[seen],
    )
    std = np.concatenate([log.initial.std[:9], np.repeat([0.05, 2e-3], 3)])
    return replace(log, imu=imu, gnss=gnss, initial=replace(log.initial, std=std))


def moved(state, errors):
    """The state displaced by errors (15,)."""
    out = state.copy()
    north, east = earth.metres_per_radian(state[0], state[2])
    out[:3] += errors[0] / north, errors[1] / east, -errors[2]
    out[3:6] += errors[3:6]
    out[6:10] = quat_multiply(rotvec_to_quat(tuple(errors[6:9])), tuple(state[6:10]))
    out[AUX:] += errors[9:]
    return out


def difference(a, b):
    """Errors (15,) that carry state b to a."""
    north, east = earth.metres_per_radian(b[0], b[2])
    place = [(a[0] - b[0]) * north, (a[1] - b[1]) * east, b[2] - a[2]]
    return np.concatenate([place, a[3:6] - b[3:6], attitude_error(a[6:10], b[6:10]), a[AUX:] - b[AUX:]])


def numeric_phi(model, k, dt, part):
    """Phi (15,15) of a step by central differences of the mechanization itself."""
    base, phi = model.state.copy(), np.empty((15, 15))
    for j in range(15):
        ends = []
        for sign in (1.0, -1.0):
            model.state[:] = moved(base, sign * STEP[j] * np.eye(15)[j])
            move(model, k, dt, part)
            ends.append(model.state.copy())
        phi[:, j] = difference(*ends) / (2.0 * STEP[j])
    model.state[:] = base
    return phi


def linear_phi(model, motion, dt):
    """Phi (15,15) as the filter's covariance takes it."""
    rows = aligned(18)
    transition(make_covariance(np.eye(15))[1].p, rows, model.coupling, motion, dt)
    return np.vstack([rows.reshape(9, 16)[:, :15], np.hstack([np.zeros((6, 9)), np.diag(model.coupling.keep)])])


def turned(invariant, change):
    """G (15,15): what the errors become where a correction ``change`` moved the state (see `retract`)."""
    g = np.eye(15)
    place, turn = (change[:3], -0.5 * change[6:9]) if invariant else (np.zeros(3), np.zeros(3))
    for first, gained in ((0, place), (3, change[3:6]), (6, turn)):
        for j in range(3):
            g[first : first + 3, 6 + j] += np.cross(np.eye(3)[j], gained)
    return g


def textbook(estimator, log, numeric):
    """Smoothed states (N,16) and covariances (N,15,15) by RTS with dense matrices and inverses."""
    prepared = estimator.prepared(log)
    recording, line = make_recording(prepared), make_timeline_of(prepared)
    model = make_model(prepared, recording)
    invariant, nodes, now, e = estimator.error == "invariant", [], line.now[0], 0
    p = lambda: model.p[:, :15].copy()  # noqa: E731
    for k, end in enumerate(line.t):
        whole = end - now
        begin(model, k, whole)
        while True:
            event = e < len(line.event_t) and line.event_t[e] <= end + SAME_TIME
            dt = (min(line.event_t[e], end) if event else end) - now
            if dt > SAME_TIME:
                before, phi = p(), numeric_phi(model, k, dt, dt / whole) if numeric else None
                motion, middle = move(model, k, dt, dt / whole)
                phi = linear_phi(model, motion, dt) if phi is None else phi
                spread(model, motion, middle, dt)
                nodes.append(("predict", before, phi, p()))
                now += dt
            if not event:
                break
            before, old = p(), model.state.copy()
            correct(model, k, e)
            if recording.fading[e] != REJECTED:
                h, fading = model.work.h[:6], recording.fading[e]
                x = fading * before @ h.T @ np.linalg.solve(recording.innovation_covariance[e], recording.innovation[e])
                change = difference(model.state, old)
                nodes.append(("update", before, (x, turned(invariant, change), fading), p()))
            e += 1
        now = end
        record(model, k)
        nodes.append(("sample", p(), model.state.copy(), None))
    delta, covariance, states, covariances = np.zeros(15), p(), [], []
    for kind, before, what, after in reversed(nodes):
        if kind == "predict":
            gain = before @ what.T @ np.linalg.inv(after)
            delta, covariance = gain @ delta, before + gain @ (covariance - after) @ gain.T
        elif kind == "update":
            x, g, fading = what
            back = np.linalg.inv(g)
            delta, covariance = x + back @ delta, back @ covariance @ back.T
            # A faded P is a step of Phi = 1 and Q = (fading - 1) P.
            delta, covariance = delta / fading, before + (covariance - fading * before) / fading**2
        else:
            model.state[:], model.work.x[:] = what, delta
            retract(model)  # for the exponential of the invariant error
            change = difference(model.state, what)
            g = turned(invariant, change)
            states.append(model.state.copy())
            covariances.append(g @ covariance @ g.T)
    return np.array(states[::-1]), np.array(covariances[::-1])


@pytest.mark.parametrize("policy", ["plain", "gate", "strong-tracking", "sage-husa"])
@pytest.mark.parametrize("error", ["phi", "invariant"])
def test_equals_the_textbook(error, policy):
    """400 samples, 14 fixes, one gap, two fixes far off; with the filter's own Phi nothing but rounding differs.

    The textbook inverts P in its own units, of condition 1e10: 1e-16 becomes 1e-6 of a sigma.
    """
    assert max(textbook_differences(error, policy, numeric=False)) < 1e-6


def test_equals_the_textbook_with_differences_of_the_mechanization():
    """Phi is of second order in a step, and the body turns 3e-3 rad in it: 1e-5 of an entry, 1e-3 over 200 steps of a gap."""
    assert max(textbook_differences("phi", "plain", numeric=True)) < 1e-3


def textbook_differences(error, policy, numeric):
    """Largest difference of states, in smoothed sigmas, and of sigmas, as a share."""
    estimator = Eskf(error=error, policy=policy)
    found = replace(estimator, smooth=True).run(biased_log())
    states, covariances = textbook(estimator, biased_log(), numeric)
    std = np.sqrt(np.einsum("kii->ki", covariances))
    mine = [found.lat, found.lon, found.h, found.v_n, found.q_nb, found.accel_bias, found.gyro_bias]
    off = max(np.abs(difference(*row) / s).max() for *row, s in zip(np.column_stack(mine), states, std, strict=True))
    np.testing.assert_array_equal(np.sqrt(np.einsum("kii->ki", found.covariance)), found.std[99::100])
    return off, np.abs(found.std / std - 1.0).max()


@pytest.mark.parametrize("policy", ["sage-husa", "gate"])
def test_segments_change_nothing(policy):
    """Neither their number nor where they end: the filter goes on from a checkpoint as if it had not stopped."""
    prepared = Eskf(policy=policy, states=("gyro-scale", "gyro-bias")).prepared(biased_log())
    whole = smoother.smooth(prepared, segment=10**6)
    for segment in (1, 7, 399):
        part = smoother.smooth(prepared, segment=segment)
        for key in ("lat", "lon", "h", "v_n", "q_nb", "std", "covariance"):
            np.testing.assert_array_equal(getattr(part, key), getattr(whole, key))
        np.testing.assert_array_equal(part.innovations["gnss"].value, whole.innovations["gnss"].value)


def errors(solution, reference):
    north, east = earth.metres_per_radian(reference.lat[1:], reference.h[1:])
    return np.column_stack(
        [
            (solution.lat - reference.lat[1:]) * north,
            (solution.lon - reference.lon[1:]) * east,
            reference.h[1:] - solution.h,
            solution.v_n - reference.v_n[1:],
            attitude_errors(solution.q_nb, reference.q_nb[1:]),
        ]
    )


RUNS = 30
OUTAGE = (20.0, 50.0)


@cache
def runs(error):
    """Errors and sigmas (RUNS,N,9) of filter and smoother on draws of the filter's own model, with an outage of 30 s."""
    flight, out = weaving_flight(80.0, rate=25.0, bank=0.6), []
    for seed in range(RUNS):
        log = sensor_log(
            flight,
            seed,
            (OUTAGE,),
            std=(10.0, 1.0, 0.02),
            accel_noise=0.1,
            gyro_noise=2e-3,
            gnss_rate=5.0,
            position_sigma=3.0,
        )
        both = [Eskf(states=(), error=error, smooth=smooth).run(log) for smooth in (False, True)]
        out.append([(errors(solution, flight), solution.std) for solution in both])
    return flight.t[1:], np.array(out)


@pytest.mark.parametrize("error", ["phi", "invariant"])
def test_better_than_its_filter(error):
    """In every channel over the flight; the position in an outage, which has two ends instead of one, by half at least.

    The integral of a velocity's random walk over T has variance T³ / 3; where both ends are known it is at most T³ / 192,
    an eighth in sigmas, to which what the fixes leave at the ends is added.
    """
    t, found = runs(error)
    rmse = np.sqrt((found[:, :, 0] ** 2).mean(axis=(0, 2)))
    assert (rmse[1] < rmse[0]).all()
    gap = (t > OUTAGE[0]) & (t < OUTAGE[1])
    place = np.sqrt((found[:, :, 0, gap, :3] ** 2).sum(axis=-1).mean(axis=(0, 2)))
    assert place[1] < 0.5 * place[0]


@pytest.mark.parametrize("first", [0, 3, 6])
def test_smoothed_errors_are_as_large_as_stated(first):
    """Time average of NEES / 3 per run: its 99 % t-interval over the runs contains 1; data are drawn from the model."""
    _, found = runs("phi")
    values = ((found[:, 1, 0] / found[:, 1, 1])[:, :, first : first + 3] ** 2).mean(axis=(1, 2))
    half = student.ppf(0.995, RUNS - 1) * values.std(ddof=1) / np.sqrt(RUNS)
    assert abs(values.mean() - 1.0) < half and half < 0.5


def test_memory_is_bounded(monkeypatch):
    """42 states, 60,000 samples: all covariances would take 850 MB.

    2 sqrt(N) of them are 8 MB; Phi and gains of a segment, what else a checkpoint carries, and the filter's own copy of the
    IMU (3 MB) double that.
    """
    flight = weaving_flight(1.0, rate=100.0)
    log, count = sensor_log(flight, gnss_rate=5.0), 60_000
    t = 0.01 * np.arange(1, count + 1)
    rows = np.arange(count) % 100
    log = replace(log, imu=replace(log.imu, t=t, gyro=log.imu.gyro[rows], accel=log.imu.accel[rows]))
    every = 0.2 * np.arange(1, count // 20)
    fixes = {key: np.resize(getattr(log.gnss, key), len(every)) for key in ("lat", "lon", "h")}
    log = replace(log, gnss=replace(log.gnss, t=every, v_n=np.zeros((len(every), 3)), **fixes))
    states = [f"{triad}-{kind}" for triad in ("accel", "gyro") for kind in ("bias", "scale", "misalignment")]
    prepared = Eskf(states=(*states, "g-sensitivity")).prepared(log)
    assert len(prepared.states) == 42
    # Memory is all taken before the kernels run, so they need not.
    for name in ("walk", "sweep", "solution_of"):
        monkeypatch.setattr(smoother, name, lambda *_: None)
    tracemalloc.start()
    try:
        recording = smoother.make_recording(prepared)
        kept = tracemalloc.get_traced_memory()[0]
        del recording
        tracemalloc.reset_peak()
        smoother.smooth(prepared)
        peak = tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()
    assert 4e6 < peak - kept < 20e6


def test_smoothing_is_not_done_step_by_step():
    with pytest.raises(InputError, match="eskf: smooth = true needs the whole log"):
        Eskf(smooth=True).start(biased_log())
