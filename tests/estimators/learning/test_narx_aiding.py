"""NNCKF and NNAKF: two copies of one filter, what the networks are taught, what they cannot see."""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import numpy as np
import pytest
from report_studies import study
from synthetic import sensor_log, weaving_flight

from estimators.learning import pretrained
from estimators.learning.narx_aiding import Nnakf, Nnckf
from estimators.learning.narx_flight import NarxFlight
from estimators.learning.narx_networks import DriftNetworks, Structure
from estimators.learning.networks.levenberg_marquardt import Training
from estimators.methods.direct import DirectEkf
from estimators.methods.direct_ukf import DirectUkf
from estimators.methods.ins import Ins
from testbed.base.errors import InputError
from testbed.data.records import GnssFixes
from testbed.physics import earth
from testbed.physics.rotations import quat_to_euler, wrap

OUTAGE = (129.9, 159.9)
SHORT = {
    "filter": "ekf",
    "longest_outage_s": 30.0,
    "settle_s": 10.0,
    "output_lags": 1,
    "input_lags": 1,
    "neurons": 3,
    "epochs": 20,
}
SCHEMES = [Nnckf(**SHORT), Nnakf(**SHORT)]


@pytest.fixture(scope="module")
def flight():
    return weaving_flight(200.0, rate=50.0, speed=40.0, bank=0.6)


def fly_log(flight, seed=1, outages=(OUTAGE,), **keys):
    return sensor_log(
        flight, seed, outages, gnss_rate=5.0, position_sigma=0.5, velocity_sigma=0.1, std=(1.0, 0.1, 0.002), **keys
    )


@pytest.fixture(scope="module")
def log(flight):
    return fly_log(flight)


@pytest.fixture(scope="module")
def lesson_log(flight):
    return fly_log(flight, seed=2, outages=())


def position_error(flight, solution, window=OUTAGE):
    place = earth.position_difference(
        solution.lat, solution.lon, solution.h, flight.lat[1:], flight.lon[1:], flight.h[1:]
    )
    rows = (solution.t > window[0]) & (solution.t <= window[1])
    return np.linalg.norm(np.column_stack(place)[rows], axis=1)


@pytest.mark.parametrize("kind", ["ekf", "ukf"])
def test_a_copy_run_in_stretches_is_the_filter_run_at_once(log, kind):
    """To the last bit: a stretch begins where the one before it ended, coning and sculling of its first sample included."""
    whole = (DirectUkf() if kind == "ukf" else DirectEkf()).run(log)
    flight = NarxFlight(Nnckf(**SHORT | {"filter": kind}), log)
    for row in (37, 1000, 1051, 6000, len(log.imu.t)):
        flight.main.run_to(row, flight.fixes)
    assert_same_answer(flight.solution([], []), whole)


def assert_same_answer(ours, theirs):
    np.testing.assert_array_equal(ours.h, theirs.h)
    np.testing.assert_array_equal(ours.v_n, theirs.v_n)
    np.testing.assert_array_equal(ours.covariance, theirs.covariance)
    np.testing.assert_array_equal(ours.innovations["gnss"].value, theirs.innovations["gnss"].value)


def test_a_second_copy_starts_where_the_first_is_and_leaves_it_alone(log):
    flight = NarxFlight(Nnckf(**SHORT), log)
    flight.main.run_to(1000, flight.fixes)
    before = flight.main.x.copy()
    free = flight.main.fork()
    free.run_to(2500)
    np.testing.assert_array_equal(flight.main.x, before)
    assert flight.main.row == 1000 and free.row == 2500
    assert np.trace(free.p[:3, :3]) > 10 * np.trace(flight.main.p[:3, :3])  # nothing told it where it is


def test_the_free_copy_needs_no_covariance(log):
    """`coast_to` is the mean of `run_to` without fixes, to the last bit."""
    flight = NarxFlight(Nnckf(**SHORT), log)
    flight.main.run_to(1037, flight.fixes)
    with_covariance, without = flight.main.fork(), flight.main.fork()
    states, _ = with_covariance.run_to(2537)
    mean = without.coast_to(2537)
    assert without.row == with_covariance.row == 2537
    np.testing.assert_array_equal(mean, states)
    np.testing.assert_array_equal(without.x, mean[-1])


def test_networks_that_do_not_learn_in_flight_take_no_lessons(log, lesson_log):
    """Once trained, ``online_epochs = 0`` leaves the filter alone until the outage, with the same answer in it."""
    still, learning = (Nnckf(**SHORT, online_epochs=epochs) for epochs in (0, 5))
    for scheme in (still, learning):
        scheme.fit([(lesson_log, None)])
    filters, quiet, moved = DirectEkf().run(log), still.run(log), learning.run(log)
    rows = quiet.t < OUTAGE[0] - 0.2  # the last fix before it, from which on the networks speak
    np.testing.assert_array_equal(quiet.v_n[rows], filters.v_n[rows])
    assert not np.array_equal(quiet.extras["network_output"][1], moved.extras["network_output"][1])


def test_the_filter_of_a_scheme_may_be_tuned_as_the_filter_alone(lesson_log):
    scales = {"gyro_noise_scale": 300.0, "accel_noise_scale": 30.0}
    tuned, alone = Nnckf(**SHORT, **scales).run(lesson_log), DirectEkf(**scales).run(lesson_log)
    assert_same_answer(tuned, alone)
    assert not np.array_equal(tuned.h, DirectEkf().run(lesson_log).h)


def test_an_ins_2_that_gnss_corrects_keeps_its_own_attitude(flight):
    """Re-set in position and velocity alone: they are the filter's, its Euler angles those of an INS that nobody corrects.

    The two INSs turn alike but for the rate of transport: 100 m/s of velocity error over the radius, 1.6e-5 rad/s, 2e-3 rad
    in 130 s. The gyro bias of 1e-3 rad/s, which the filter finds, makes 0.1 rad by then.
    """
    log = fly_log(flight, gyro_bias=1e-3)
    free = Ins().run(log)
    run = NarxFlight(Nnakf(**SHORT, resets="position-velocity"), log)
    whole = NarxFlight(Nnakf(**SHORT), log)
    drifts = []
    for stretch in run.plan():
        if stretch.kind == "outage":
            break
        for each in (run, whole):
            start = each.main.x[:6].copy()
            if stretch.kind == "lesson":
                drifts.append(each.lesson(stretch))
                np.testing.assert_array_equal(each.free_states[0, :6], start)
            else:
                each.pass_over(stretch)
    assert run.own.row == run.main.row and len(drifts) == 6
    row = run.own.row - 1
    turned = [
        abs(np.linalg.norm(wrap(np.array(quat_to_euler(free.q_nb[row])) - x[6:9]))) for x in (run.own.x, whole.main.x)
    ]
    assert turned[0] < 4e-3 < 0.05 < turned[1]
    assert np.isnan(drifts[-2].variance).all() and np.isfinite(drifts[-1].variance).all()
    # 0.1 rad of tilt is 1 m/s^2, 440 m in 30 s where it stays; the turns leave a part of it
    assert np.linalg.norm(drifts[-2].y[-1, :3]) > max(100.0, 2.0 * np.linalg.norm(drifts[-1].y[-1, :3]))


def test_lessons_do_not_overlap_and_keep_clear_of_the_outage(log):
    plan = list(NarxFlight(SCHEMES[0], log).plan())
    lessons = [(s.t[0], s.t[-1]) for s in plan if s.kind == "lesson"]
    assert len(lessons) == 3 and lessons[0] == pytest.approx((10.0, 40.0))
    for (_, end), (start, _) in zip(lessons, lessons[1:], strict=False):
        assert start >= end - 1e-9
    (outage,) = (s for s in plan if s.kind == "outage")
    assert outage.t[0] == pytest.approx(129.8) and outage.t[-1] < 160.0
    assert plan[-1].end == len(log.imu.t)


@pytest.mark.parametrize("scheme", SCHEMES, ids=lambda s: s.name)
def test_without_an_outage_the_answer_is_the_filters(lesson_log, scheme):
    ours, filters = scheme.run(lesson_log), DirectEkf().run(lesson_log)
    assert_same_answer(ours, filters)
    assert "network_output" not in ours.extras


@pytest.mark.parametrize("scheme", SCHEMES, ids=lambda s: s.name)
def test_nothing_of_gnss_reaches_the_networks_in_an_outage(log, scheme):
    """Every fix after the outage moved by 1 km and 10 m/s: not one bit changes before the first of them."""
    gnss = log.gnss
    later = gnss.t > OUTAGE[0]
    moved = GnssFixes(
        gnss.t, gnss.lat, gnss.lon, gnss.h + 1e3 * later, gnss.v_n + 10.0 * later[:, None], gnss.spec, gnss.outages
    )
    as_it_was, changed = scheme.run(log), scheme.run(replace(log, gnss=moved))
    rows = as_it_was.t < 159.99
    assert "network_output" in as_it_was.extras
    np.testing.assert_array_equal(as_it_was.lat[rows], changed.lat[rows])
    np.testing.assert_array_equal(as_it_was.v_n[rows], changed.v_n[rows])
    assert not np.array_equal(as_it_was.h[~rows], changed.h[~rows])


def test_closed_loop_does_not_look_at_the_targets(lesson_log):
    """GNSS and truth are in ``y`` alone; as NaN they change nothing."""
    drifts = list(SCHEMES[1].lessons(lesson_log))
    networks = DriftNetworks(SCHEMES[1].structure(drifts)).train(drifts, Training(epochs=5))
    blind = replace(drifts[0], y=np.full_like(drifts[0].y, np.nan))
    np.testing.assert_array_equal(networks.closed_loop(blind)[0], networks.closed_loop(drifts[0])[0])


@pytest.mark.parametrize("scheme", SCHEMES, ids=lambda s: s.name)
def test_outages_at_either_end_of_a_log(flight, scheme):
    """Before the first lesson the filter coasts alone; an outage that never ends is bridged to the last sample."""
    log = fly_log(flight, outages=((4.9, 9.9), (150.0, 201.0)))
    solution = scheme.run(log)
    assert np.isfinite(solution.lat).all() and np.isfinite(solution.std).all()
    starts, _ = solution.extras["network_limited"]
    assert starts == pytest.approx([149.8])
    filters = DirectEkf().run(log)
    rows = solution.t < 149.0
    np.testing.assert_allclose(solution.v_n[rows], filters.v_n[rows], atol=1e-4)


def test_a_log_without_gnss_is_refused(log):
    with pytest.raises(InputError, match="nnckf"):
        SCHEMES[0].run(replace(log, gnss=None))


class Oracle(DriftNetworks):
    """Networks that know the truth."""

    answer: np.ndarray = np.zeros((0, 6))

    def closed_loop(self, drift):
        return self.answer, 0


@pytest.mark.parametrize("scheme", SCHEMES, ids=lambda s: s.name)
def test_perfect_networks_bring_the_filter_through(flight, scheme):
    """With the free copy's true drift as network output what is left is the interpolation between epochs and R."""
    log = fly_log(flight, gyro_noise=2e-3, accel_noise=0.2)
    run = NarxFlight(scheme, log)
    for stretch in run.plan():
        if stretch.kind == "outage":
            break
        run.main.run_to(stretch.end, run.fixes)
    drift = run.free_drift(stretch)
    rows = np.searchsorted(flight.t, stretch.t)
    north, east, down = earth.position_difference(
        flight.lat[rows], flight.lon[rows], flight.h[rows], *run.task.reference
    )
    truth = np.column_stack([north, east, down, flight.v_n[rows]])
    answer = truth - drift.u[:, :6]
    answer[0] = 0.0
    oracle = Oracle(Structure((("t",),) * 6, ((1, 1),) * 6), std=np.full(6, 0.1))
    object.__setattr__(oracle, "answer", answer)
    scheme.bridge(run, stretch, drift, answer, oracle)
    run.main.run_to(len(log.imu.t), run.fixes)
    bridged = position_error(flight, run.solution([], []))
    coasted = position_error(flight, DirectEkf().run(log))
    assert coasted[-1] > 3.0
    assert bridged[-1] < 0.2 * coasted[-1]


def test_named_networks_are_trained_once_and_missed_when_absent(log, lesson_log, tmp_path, monkeypatch):
    class Flights(NamedTuple):
        digest: str

        def fly(self):
            return [(lesson_log, None)]

    monkeypatch.setenv("TESTBED_CACHE", str(tmp_path))
    scheme = Nnckf(**SHORT, networks="test", online_epochs=0)
    with pytest.raises(InputError, match="'test'"):
        scheme.run(log)
    scheme.learn(Flights("first"))
    path = pretrained.weights_path(scheme, log)
    written = path.stat().st_mtime_ns
    scheme.learn(Flights("first"))
    assert path.stat().st_mtime_ns == written
    taught = Nnckf(**SHORT, online_epochs=0)
    taught.fit([(lesson_log, None)])
    np.testing.assert_array_equal(scheme.run(log).lat, taught.run(log).lat)
    scheme.learn(Flights("second"))  # another training flight: the old networks are stale
    assert path.stat().st_mtime_ns != written


def test_statistics_set_the_measurement_noise(log, lesson_log):
    """Networks that know nothing, and say so by a large R, leave the filter to coast: within 20 % of it."""
    scheme = Nnakf(**SHORT, online_epochs=0, tune_p=False)
    scheme.fit([(lesson_log, None)])
    object.__setattr__(scheme, "_trained", replace(scheme._trained, std=np.full(6, 1e4)))
    coasting, ours = DirectEkf().run(log), scheme.run(log)
    np.testing.assert_allclose(ours.h, coasting.h, atol=0.05)
    np.testing.assert_allclose(ours.v_n, coasting.v_n, atol=0.05)


@pytest.mark.parametrize(
    ("keys", "message"),
    [
        ({"filter": "kf"}, "filter"),
        ({"inputs": "some"}, "inputs"),
        ({"neurons": 0}, "neurons"),
        ({"output_lags": 0}, "input_lags"),
        ({"held_back": "some"}, "held_back"),
        ({"gyro_noise_scale": 0.0}, "gyro_noise_scale"),
        ({"longest_outage_s": float("nan")}, "longest_outage_s"),
    ],
)
def test_wrong_parameters_are_refused(keys, message):
    with pytest.raises(InputError, match=message):
        Nnckf(**keys)


def test_a_wrong_re_set_is_refused():
    with pytest.raises(InputError, match="resets"):
        Nnakf(resets="velocity")


def test_unknown_input_names_are_refused(lesson_log):
    with pytest.raises(InputError, match="yaw"):
        Nnckf(**SHORT | {"inputs": ["yaww"]}).fit([(lesson_log, None)])


@pytest.fixture(scope="module")
def short_scenario():
    """Flight 1 for 220 s, two windows of 60 s to learn from."""
    from testbed.scenario import load_scenario

    shorter = {"extra.training.flight.duration_s": 220.0, "flight.duration_s": 120.0, "sensors.gnss.outages": []}
    return load_scenario("narx-ukf-2021", overrides=shorter)


def test_features_ranks_the_candidates_and_draws_the_lag_curve(short_scenario, tmp_path):
    import pandas as pd

    from testbed.features.command import features

    said = []
    folder = features(short_scenario, tmp_path / "out", "NNAKF", tell=said.append)
    ranking, lags = pd.read_csv(folder / "ranking.csv"), pd.read_csv(folder / "lags.csv")
    assert len(ranking) == 60 and set(ranking["input"]) >= {"lat", "yaw", "t"}
    for _, rows in ranking.groupby("target"):
        assert rows["score"].is_monotonic_decreasing
        np.testing.assert_allclose(rows["score"], rows["relevance"] - rows["redundancy"], atol=1e-5)
    assert (lags.groupby("target")["chosen"].sum() == 1).all()
    assert (folder / "lags.png").read_bytes()[:4] == b"\x89PNG"
    assert any("v_north" in line for line in said)


def test_features_of_a_row_without_networks_is_refused(short_scenario, tmp_path):
    from testbed.features.command import features

    with pytest.raises(InputError, match="NNCKF"):
        features(short_scenario, tmp_path / "out", "EKF")
    assert not (tmp_path / "out").exists()


def test_training_flights_are_another_flight_with_gnss_throughout(short_scenario):
    """The same unit (its drawn constants), other noise, no outage; the digest follows the flight, not the outages."""
    from testbed import pipeline
    from testbed.training.flights import FIRST_RUN, training_digest, training_flights, training_scenario

    ((log, trajectory),) = training_flights(short_scenario)
    assert trajectory.t[-1] == pytest.approx(220.0) and log.gnss.outages == ()
    assert np.diff(log.gnss.t).max() < 0.21
    lesson = training_scenario(short_scenario)
    first, other = (pipeline.sense(lesson, trajectory, run=run)[1] for run in (FIRST_RUN, 0))
    np.testing.assert_array_equal(first.constants["gyro_scale_factor"], other.constants["gyro_scale_factor"])
    moved = short_scenario.model_copy(update={"sensors": lesson.sensors})
    assert training_digest(moved) == training_digest(short_scenario)


def test_distance_between_two_answers(flight, log):
    """One answer moved up by 3 m is 3 m away at any time."""
    distance_at = study("outage_growth").distance_at

    solution = DirectEkf().run(log)
    np.testing.assert_allclose(
        distance_at(solution, replace(solution, h=solution.h + 3.0), [50.0, 159.9]), 3.0, rtol=1e-9
    )


def test_the_parts_of_an_outage_add_up(flight):
    """Started where the filter was, a free run ends where the filter's coasting ends; from the truth, with perfect
    sensors, it ends at the truth."""
    from testbed.data.records import SensorErrors

    GROUPS, growth = study("outage_growth").GROUPS, study("outage_growth").growth

    log = fly_log(flight, gyro_noise=2e-3, accel_noise=0.2)
    solution = DirectEkf().run(log)
    zero = np.zeros((len(log.imu.t), 3))
    parts = growth(flight, log, SensorErrors(log.imu.t, zero, zero), solution)["error_m"][0]
    assert parts[GROUPS.index("all of it")] == pytest.approx(position_error(flight, solution)[-1], rel=0.02)
    perfect = replace(log, imu=replace(log.imu, gyro=flight.w_ib_b[1:], accel=flight.f_b[1:]))
    parts = growth(flight, perfect, SensorErrors(log.imu.t, zero, zero), solution)["error_m"][0]
    assert parts[GROUPS.index("sensor errors in the outage")] < 0.01
