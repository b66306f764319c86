"""`tight-kf`: the truth from perfect sensors, honest sigmas, wrong satellites, two systems, mistakes.

Full sizes of the acceptance (100 runs) run with TESTBED_GNSS=1; a smaller number else, with the wider bounds of fewer runs.
"""

import os
from dataclasses import replace

import numpy as np
import pytest
from analytic_flight import analytic_flight
from consistency import errors_of as fifteen_errors
from outages import GYROS_KNOWN, WHITE, errors_of, record
from scipy.stats import chi2

from estimators.core import composition, propagate
from estimators.methods.tight_kf import TightKf
from testbed.base.errors import InputError
from testbed.base.schema import validate
from testbed.data.records import SensorLog
from testbed.data.registry import list_estimators, make_estimator
from testbed.data.satellites import name_of
from testbed.sensors import sense_flight
from testbed.sensors.config import InitialConfig
from testbed.sensors.registry import SensorsConfig

FULL = "TESTBED_GNSS" in os.environ
RUNS = 100 if FULL else 10


def test_perfect_sensors_give_the_truth():
    """1 cm over a minute of 4 g and 1 rad/s with a lever arm: the filter's equations are those of the signals. What is left
    is the linearisation of that motion over 10 ms."""
    flight = analytic_flight(60.0, 100.0)
    off = [*WHITE, "code_noise", "rate_noise", "fading", "clock"]
    gnss = {
        "model": "module-class",
        "mode": "satellites",
        "lever_arm_m": [1.0, 0.5, -0.3],
        "satellites": {"disable": off},
    }
    sensors = validate(SensorsConfig, {"imu": {"model": "ideal"}, "gnss": gnss}, "s")
    log, _ = sense_flight(sensors, InitialConfig(perfect=True), flight, 1)
    for slow in ("white", "states"):
        assert np.abs(errors_of(TightKf(slow_errors=slow, gate=False).run(log), flight)).max() < 0.01, slow


def test_sigmas_are_honest_on_white_errors():
    """Position NEES (3) and NEES of all 17 states, means of the runs at each second, in the central 95 % of chi-square over
    so many runs at 90 % of the times; the mean NIS of a scalar within 3 %."""
    place, whole, nis = [], [], []
    for run in range(RUNS):
        log, truth, drawn = record(run, 120.0 if FULL else 40.0, initial=GYROS_KNOWN)
        solution = TightKf(slow_errors="white", gate=False).run(log)
        e, p = seventeen_errors(solution, truth, drawn), solution.covariance
        place.append(np.einsum("ki,kij,kj->k", e[:, :3], np.linalg.inv(p[:, :3, :3]), e[:, :3]))
        whole.append(np.einsum("ki,kij,kj->k", e, np.linalg.inv(p), e))
        # the first epoch's ranges have set the clock's mean
        nis.append([np.mean((nu.value**2)[50:, 0] / nu.covariance[50:, 0, 0]) for nu in solution.innovations.values()])
    # of few runs the means at all times rise and fall together, so that a tenth of the times says little
    outside = 0.05 if FULL else 0.001
    for values, dof in ((place, 3), (whole, 17)):
        low, high = chi2.ppf([0.5 * outside, 1.0 - 0.5 * outside], RUNS * dof) / RUNS
        inside = (np.mean(values, axis=0) > low) & (np.mean(values, axis=0) < high)
        assert np.mean(inside) >= 0.9, (dof, low, high, np.mean(inside), np.mean(values))
    assert np.mean(nis, axis=0) == pytest.approx([1.0, 1.0], abs=0.03)


def seventeen_errors(solution, truth, drawn):
    """(K,17) at the covariance snapshots: the fifteen of `consistency`, then the clock's bias (m) and drift (m/s)."""
    k = np.searchsorted(solution.t, solution.covariance_t - 1e-6)
    epoch = np.round(solution.covariance_t * 5.0).astype(int) - 1
    clock = [
        solution.estimates[f"gnss_clock_{name}"][k] - drawn.constants[f"gnss_clock_{name}"][epoch]
        for name in ("bias_m", "drift_mps")
    ]
    return np.column_stack([fifteen_errors(solution, truth, drawn), *clock])


def test_the_clock_of_the_start_has_no_weight():
    """The first epoch sets the clock's mean and is used again as a measurement. Twice counted it would count for something:
    a start 30 m and 1 m/s off leaves 1 % of that after an epoch, and as little in height."""
    log, truth, _ = record(3, 20.0)
    raw = log.gnss_raw
    first = raw.t < raw.t[0] + 0.1
    off = replace(raw, pseudorange=raw.pseudorange + 30.0 * first, range_rate=raw.range_rate + first)
    moved = SensorLog(log.imu, log.initial, aiding={**log.aiding, "gnss_raw": off})
    estimator = TightKf(slow_errors="white", gate=False)
    start = estimator.prepared(moved).start
    prepared = estimator.prepared(log)
    assert start[-2:] - prepared.start[-2:] == pytest.approx([30.0, 1.0], abs=0.3)
    solutions = [composition.run(replace(prepared, start=s)) for s in (start, prepared.start)]
    k = np.searchsorted(truth.t, raw.t[0]) + 1
    clock, height = (np.subtract(*(values(s)[k] for s in solutions)) for values in (clock_of, lambda s: s.h))
    assert abs(clock) < 0.3 and abs(height) < 0.3


def clock_of(solution):
    return solution.estimates["gnss_clock_bias_m"]


def test_realistic_errors_are_counted():
    """All errors on: mean position NEES of 3 degrees in 2 to 4.5 with the slow errors as states, and with the same states
    considered; ten times more without."""
    nees = {"states": [], "consider": [], "white": []}
    for run in range(RUNS):
        log, truth, _ = record(run, 100.0, white=False)
        for slow, values in nees.items():
            solution = TightKf(slow_errors=slow).run(log)
            k = np.searchsorted(solution.t, solution.covariance_t - 1e-6)
            e, p = errors_of(solution, truth)[k], solution.covariance[:, :3, :3]
            values.append(np.mean(np.einsum("ki,kij,kj->k", e, np.linalg.inv(p), e)[20:]))
    # a run's NEES hardly changes in it: the mean of so many of 3 degrees
    low, high = (2.0, 4.5) if FULL else chi2.ppf([0.001, 0.999], 3 * RUNS) / RUNS
    for slow in ("states", "consider"):
        assert low <= np.mean(nees[slow]) <= high, slow
        assert np.mean(nees["white"]) > 10.0 * np.mean(nees[slow]), slow


def test_considered_states_are_never_corrected():
    """They keep what the log promises of them, mean and sigma; the clock, which they hide, is known less well than where they
    are estimated, and better than nothing that is told of them: the filter says so."""
    log, _, _ = record(2, 30.0, white=False)
    considered, estimated = (TightKf(slow_errors=slow, gate=False).run(log) for slow in ("consider", "states"))
    slow = [name for name in considered.states if name.startswith(("gnss_iono", "gnss_range", "gnss_tropo"))]
    assert len(slow) > 10 and not any(considered.estimates[name].any() for name in slow)
    k = [considered.states.index(name) for name in slow]
    assert np.allclose(considered.std[-1, k], considered.std[0, k], rtol=1e-3)
    assert (considered.std[-1, :3] > estimated.std[-1, :3]).all()
    with pytest.raises(InputError, match="smooth = true needs states that are estimated"):
        TightKf(slow_errors="consider", smooth=True)
    with pytest.raises(InputError, match="eskf: consider: 'gyro-scale' is none of the states"):
        make_estimator("eskf", consider=["gyro-scale"])


def test_a_wrong_satellite_is_refused():
    """A step of 30 m on one: its pseudoranges are refused, those of the others are not."""
    found, others = [], []
    for run in range(RUNS):
        clean, _, _ = record(run, 40.0, white=False)
        raw = clean.gnss_raw
        # one that is received in the whole second
        code = raw.sv[np.abs(raw.t - 30.5) < 0.6][np.argmax(raw.elevation[np.abs(raw.t - 30.5) < 0.6])]
        fault = {"faults": [{"sv": name_of(code), "start_s": 30.0, "end_s": 31.0, "step_m": 30.0}]}
        log, _, _ = record(run, 40.0, white=False, satellites=fault)
        nu = TightKf().run(log).innovations["pseudorange"]
        at = (nu.t >= 30.0) & (nu.t < 31.0)
        own = log.gnss_raw.sv[: len(nu.t)] == code
        found.append(np.mean(nu.rejected[at & own]))
        others.append(np.mean(nu.rejected[at & ~own]))
    assert np.mean(found) >= 0.99 and np.mean(others) < 0.01


def test_two_systems_have_a_clock_each():
    log, truth, _ = record(1, 40.0, white=False, satellites={"systems": ["gps", "galileo"]})
    solution = TightKf().run(log)
    assert {"gnss_clock_bias_m", "gnss_isb_m", "gnss_iono_m"} <= set(solution.states)
    assert sum(name.startswith("gnss_range_E") for name in solution.states) > 4
    assert np.abs(solution.estimates["gnss_isb_m"][-1]) < 5.0
    assert np.abs(errors_of(solution, truth)[-1]).max() < 15.0
    with pytest.raises(InputError, match="whose clocks differ: add the block 'gnss-isb'"):
        make_estimator("eskf", states=["gnss-clock"], aiding=["pseudorange"]).run(log)


def test_smoothing_agrees_with_the_filter_at_the_end():
    """At its last sample the smoother knows what the filter knows; before, it knows more."""
    log, _, _ = record(1, 30.0)
    forward, both = (TightKf(slow_errors="white", smooth=smooth).run(log) for smooth in (False, True))
    assert np.allclose(both.std[-1], forward.std[-1], rtol=1e-6)
    assert (both.std[1000] < forward.std[1000] * (1.0 + 1e-9)).all()
    drift = forward.states.index("gnss_clock_drift_mps")
    assert both.std[1000, drift] < 0.9 * forward.std[1000, drift]


def test_mistakes_are_told():
    log, _, _ = record(1, 30.0)
    fixes_only = type(log)(log.imu, log.initial, log.gnss)
    with pytest.raises(InputError, match=r'set \[sensors.gnss\] mode = "satellites"'):
        TightKf().run(fixes_only)
    with pytest.raises(InputError, match="slow_errors = 'none', must be one of"):
        TightKf(slow_errors="none")
    with pytest.raises(InputError, match="needs the block 'gnss-clock'"):
        make_estimator("eskf", aiding=["pseudorange"])
    assert "tight-kf" in list_estimators()


def test_ranges_are_as_uncertain_as_stated():
    """All errors on: innovations of ranges have the covariance that the filter says, NIS 1, however large multipath is and
    however long it lasts; with code noise and multipath as white noise of their density it would be 0.1. A run's 2000
    innovations are independent if the model is right, sd of their mean square 3 %; elevations change by degrees meanwhile."""
    street = {"multipath_zenith_m": 0.5, "multipath_horizon_m": 1.5, "multipath_time_s": 5.0}
    for own in ({}, street):
        nis = []
        for run in range(4):
            log, _, _ = record(run, 60.0, white=False, **own)
            solution = TightKf(gate=False).run(log)
            assert not any(name.startswith(("gnss_code", "gnss_multipath")) for name in solution.states)
            nu = solution.innovations["pseudorange"]
            late = nu.t > 10.0
            nis.append(np.mean(nu.value[late, 0] ** 2 / nu.covariance[late, 0, 0]))
        assert np.mean(nis) == pytest.approx(1.0, abs=0.06), own


def test_states_that_wait_are_those_that_every_sample_carries(monkeypatch):
    """Carried from measurement to measurement or from sample to sample: the same but for rounding. Five seconds without a
    satellite lie between two of them, and sigmas of every sample are compared."""
    log, _, _ = record(1, 30.0, keep=0, window=(15.0, 20.0), white=False)
    waiting = TightKf().run(log)
    monkeypatch.setattr(propagate, "POSTPONE_FROM", 99)
    eager = TightKf().run(log)
    assert len(TightKf().prepared(log).states) > 40
    assert np.abs(errors_of(waiting, eager)).max() < 1e-9
    np.testing.assert_allclose(waiting.std, eager.std, rtol=1e-9)
    np.testing.assert_allclose(
        waiting.covariance, eager.covariance, rtol=0.0, atol=1e-9 * np.abs(eager.covariance).max()
    )
