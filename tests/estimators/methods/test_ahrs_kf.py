"""`ahrs-kf` against dense algebra, known accelerations and disturbances, and the attitude filters of the package ahrs."""

import numpy as np
import pytest
from ahrs_simulation import body_errors, simulate
from numba import njit
from scipy.stats import chi2

from estimators.methods.ahrs_eskf import AhrsEskf
from estimators.methods.ahrs_kernels import (
    Figures,
    OwnGain,
    Samples,
    inflate,
    kalman_gain,
    make_filter,
    make_work,
    observe,
    predict,
)
from estimators.methods.ahrs_kf import WITHOUT, AhrsKf
from testbed.base.errors import InputError
from testbed.data.records import ATTITUDE_STATES, ImuSamples, MagSamples, SensorLog, Trajectory
from testbed.physics.rotations import attitude_errors, quat_to_matrix, rotvec_to_quat
from testbed.scenario import load_scenario
from testbed.scoring.metrics import error_series

observe, predict = njit(observe), njit(predict)  # the filter has them only inside of its loop
FIGURES = Figures(0.01, 0.02, 0.03, 0.04, 0.5, 0.6, 0.99, 0.9, 0.95, 0.02, 9.8, 0.0, 0.0, 0.1)


def filter_of(state, p, gyro, accel, mag, mag_row):
    """The filter with one IMU sample and one field sample."""
    samples = Samples(gyro[None], accel[None], mag[None], np.array([mag_row]), np.array([20.0, 3.0, 44.0]))
    return make_filter(samples, FIGURES, (state, p), OwnGain(np.zeros(1)), OwnGain(np.zeros(1)))


def skew(v):
    return np.array([[0.0, -v[2], v[1]], [v[2], 0.0, -v[0]], [-v[1], v[0], 0.0]])


@pytest.fixture
def start():
    rng = np.random.default_rng(0)
    root, state = rng.standard_normal((12, 12)), rng.standard_normal(13)
    state[:4] /= np.linalg.norm(state[:4])
    return state, root @ root.T, rng


def test_the_kernel_carries_the_covariance_as_dense_algebra_does(start):
    state, p, rng = start
    gyro = rng.standard_normal(3)
    phi = np.zeros((12, 12))
    phi[:3, :3] = np.array(quat_to_matrix(rotvec_to_quat((gyro - state[4:7]) * 0.02))).T
    phi[:3, 3:6], phi[3:, 3:] = -0.02 * np.eye(3), np.diag(np.repeat([0.99, 0.9, 0.95], 3))
    expected = phi @ p @ phi.T + np.diag(np.repeat([0.01 * 0.02**2, 0.02, 0.03, 0.04], 3))
    predict(filter_of(state, p, gyro, np.zeros(3), np.zeros(3), -1), 0, 0.02, 1.0)
    np.testing.assert_allclose(p, expected, atol=1e-13)  # elements of about 10, sums of about 20 products


@pytest.mark.parametrize("has_mag", [True, False])
def test_the_gain_is_that_of_dense_algebra(start, has_mag):
    state, p, rng = start
    accel, mag = rng.standard_normal(3), rng.standard_normal(3)
    model = filter_of(state, p, np.zeros(3), accel, mag, 0 if has_mag else -1)
    assert observe(model, 0) == has_mag
    seen, k, z = model.work.seen, model.work.k, model.work.z
    h = np.zeros((6, 12))
    h[:3, :3], h[:3, 6:9] = skew(seen[:3]), -np.eye(3)
    if has_mag:
        h[3:, :3], h[3:, 9:] = skew(seen[3:]), np.eye(3)
    innovation = h @ p @ h.T + np.diag([0.5] * 3 + [0.6] * 3)
    gain = p @ h.T @ np.linalg.inv(innovation)
    updated = p - gain @ h @ p
    kalman_gain(p, has_mag, FIGURES, model.work, k)
    np.testing.assert_allclose(k.T, gain, atol=1e-11)  # condition number of S times round-off
    np.testing.assert_allclose(p, updated, atol=1e-10)
    assert np.array_equal(p, p.T)
    if not has_mag:
        assert not k[3:].any() and not z[3:].any()


def test_a_turn_and_a_residual_make_the_adaptive_filter_doubt_the_accelerometer(start):
    """A steady turn about z at 0.2 rad/s says V w along y, 3 m/s² unexplained along x say so along x; nothing along z."""
    state, p, _ = start
    state[4:7], p[:3, :3] = 0.0, 1e-9 * np.eye(3)
    figures, work, before = Figures(*FIGURES[:11], 400.0, 4.0, 0.1), make_work(), p.copy()
    work.seen[2] = 9.8
    for _ in range(200):  # the means have come to rest to 0.9**200
        p[:] = before
        inflate(p, np.array([0.0, 0.0, 0.2]), np.array([3.0, 0.0, -9.8]), state, figures, work)
    added = np.diag(p - before)
    np.testing.assert_allclose(added[6:9], [4.0 * 9.0, 400.0 * 0.04, 0.0], rtol=1e-6)
    assert not added[:6].any() and not added[9:].any()
    inflate(p, np.array([0.0, 0.0, 0.2]), np.array([3.0, 0.0, -9.8]), state, FIGURES, work)
    np.testing.assert_array_equal(np.diag(p - before), added)  # off: nothing more


def test_a_residual_that_doubt_about_the_attitude_explains_is_not_taken_for_acceleration(start):
    """With 0.5 rad of doubt (1 sigma) about roll and pitch, a residual of 3 m/s² is no news: 4.9 are expected."""
    state, p, _ = start
    p[:3, :3] = 0.25 * np.eye(3)
    figures, work, before = Figures(*FIGURES[:11], 0.0, 4.0, 1.0), make_work(), p.copy()
    work.seen[2] = 9.8
    inflate(p, state[4:7], np.array([3.0, 3.0, -9.8]), state, figures, work)
    np.testing.assert_array_equal(p, before)


def test_without_noise_or_motion_the_attitude_stays_exact():
    log, truth, estimator = simulate(0, 20.0, still=True, noise=0.0)
    solution = estimator.run(log)
    assert np.abs(attitude_errors(solution.q_nb, truth)).max() < 1e-9  # nothing to correct: only round-off


def test_consistent_where_accelerations_and_disturbances_are_as_modelled():
    """NEES of attitude, averaged over runs and spread-out times, inside its 99.9 % chi-square bounds."""
    nees = []
    for seed in range(12):
        log, truth, estimator = simulate(seed)
        solution = estimator.run(log)
        rows = np.searchsorted(log.imu.t, solution.covariance_t[[14, 59]] - 1e-6)
        errors = attitude_errors(solution.q_nb[rows], truth[rows])
        covariance = solution.covariance[[14, 59]]
        nees += list(np.einsum("ki,kij,kj->k", errors, np.linalg.inv(covariance), errors))
    low, high = chi2.ppf([0.0005, 0.9995], 3 * len(nees)) / len(nees)
    assert low < np.mean(nees) < high


def test_the_disturbances_are_worth_modelling():
    """Against accelerations of 1 m/s², a filter that takes them for white noise of the sensor is worse."""

    def error(estimator, log, truth):
        return np.sqrt(np.mean(body_errors(estimator.run(log).q_nb[1000:], truth[1000:]) ** 2))

    good, blind = [], []
    for seed in range(4):
        log, truth, estimator = simulate(seed, 40.0)
        good.append(error(estimator, log, truth))
        blind.append(error(AhrsKf(0.02, 0.02, 0.02, 0.02, **WITHOUT), log, truth))
    assert np.mean(good) < 0.5 * np.mean(blind)


def test_gyro_bias_is_found():
    """At rest heading north, the bias about east is seen by the field: half of its prior is gone after two minutes."""
    left = []
    for seed in range(6):
        log, _, estimator = simulate(seed, 120.0, still=True)
        bias = np.mean(log.imu.gyro, axis=0)  # the body does not turn: the mean is the bias, up to 0.05/sqrt(120) °/s
        left.append((estimator.run(log).gyro_bias[-1] - bias)[1])
    assert np.sqrt(np.mean(np.square(left))) < np.radians(0.02) / 2.0


def test_a_slow_magnetometer_is_used_when_it_samples():
    log, truth, estimator = simulate(3, 40.0)
    mag = type(log.mag)(log.mag.t[4::5], log.mag.field[4::5], log.mag.spec)
    solution = estimator.run(SensorLog(log.imu, log.initial, mag=mag))
    used = np.isfinite(solution.innovations["gravity-mag"].value[:, 3:]).all(axis=1)
    assert used.all()  # snapshots once a second fall on its samples
    assert np.degrees(np.abs(attitude_errors(solution.q_nb[-1:], truth[-1:]))).max() < 5.0


def test_position_and_velocity_stand_still_and_are_no_states():
    log, _, estimator = simulate(0, 5.0)
    solution = estimator.run(log)
    assert np.ptp(solution.lat) == 0.0 and np.ptp(solution.v_n) == 0.0
    assert solution.states == ATTITUDE_STATES and solution.std.shape == (len(log.imu.t), 3)


def test_a_log_without_magnetometer_and_a_wrong_parameter_are_refused():
    log = simulate(0, 2.0).log
    with pytest.raises(InputError, match="magnetometer"):
        AhrsKf().run(SensorLog(log.imu, log.initial))
    with pytest.raises(InputError, match="linear_accel_time_s"):
        AhrsKf(linear_accel_time_s=0.0)
    with pytest.raises(InputError, match="turn_speed_mps"):
        AhrsKf(turn_speed_mps=-1.0)
    with pytest.raises(InputError, match="adaption_average_s"):
        AhrsKf(adaption_average_s=0.0)


@pytest.mark.parametrize("name", ["Madgwick", "Mahony", "AhrsEkf"])
def test_a_peer_holds_the_attitude_of_a_swinging_body(name):
    """Without errors in the sensors, and without accelerations, each stays within a few degrees in our frames."""
    pytest.importorskip("ahrs")
    from estimators.peers import ahrs_peers

    log, truth, _ = simulate(0, 30.0, noise=0.0)
    solution = getattr(ahrs_peers, name)().run(log)
    assert (
        np.degrees(np.abs(attitude_errors(solution.q_nb, truth))).max() < 2.0
    )  # a wrong frame or sign costs tens of degrees, the declination 4


@pytest.fixture(scope="module")
def flight():
    from testbed.flight import fly_flight
    from testbed.flight.config import FlightConfig
    from testbed.sensors import sense_flight
    from testbed.sensors.config import InitialConfig
    from testbed.sensors.registry import SensorsConfig

    script = [
        {"type": "straight", "duration_s": 40.0},
        {"type": "loiter", "radius_m": 200.0, "duration_s": 80.0},
        {"type": "straight", "duration_s": 30.0},
    ]
    config = {"aircraft": "aerosonde", "rate_hz": 50.0, "initial": {"speed_mps": 30.0}, "manoeuvres": script}
    trajectory = fly_flight(FlightConfig.model_validate(config | {"wind": {"turbulence": "light"}}), 3)
    sensors = SensorsConfig.model_validate(
        {"imu": {"model": "ahrs-lstm-2022"}, "mag": {"model": "ahrs-lstm-2022", "turn_on_bias_mgauss": 5.0}}
    )
    initial = InitialConfig(yaw_deg=3.0, gyro_bias_dps=0.02, accel_bias_mg=1.0)
    return trajectory, sense_flight(sensors, initial, trajectory, 1)[0]


def roll_pitch_rmse(trajectory: Trajectory, estimator, log) -> float:
    return float(np.sqrt(np.mean(error_series(trajectory, estimator.run(log)).values[:, 6:8] ** 2)))


def row(label):
    """A filter as a row of the scenario has it."""
    (entry,) = [e for e in load_scenario("ahrs-lstm-2022").estimators if e.row == label]
    return AhrsKf(**entry.params)


def test_no_straw_man_on_a_flight_with_a_loiter(flight):
    """As the scenario tunes it, it beats Madgwick and Mahony at their package's gains; data-sheet noise alone does not hold."""
    pytest.importorskip("ahrs")
    from estimators.peers.ahrs_peers import Madgwick, Mahony

    trajectory, log = flight
    ours = roll_pitch_rmse(trajectory, row("KF"), log)
    assert ours < min(roll_pitch_rmse(trajectory, peer, log) for peer in (Madgwick(), Mahony()))
    assert ours < 1.5


def test_knowing_turns_pays_on_a_flight_with_a_loiter(flight):
    """The scenario's adaptive row against the tuned filter: the loiter is half of the flight, and its end is straight."""
    trajectory, log = flight
    assert roll_pitch_rmse(trajectory, row("adaptive KF"), log) < roll_pitch_rmse(trajectory, row("KF"), log)


def test_a_tuner_may_search_around_every_default():
    """Every parameter that is searched lies inside its range, of this filter and of the one beside it."""
    for kind in (AhrsKf, AhrsEskf):
        for key, (low, high, _) in kind.parameter_space.items():
            assert low < getattr(kind(), key) < high, key


def test_a_faster_magnetometer_weighs_no_more():
    """By default a second of field samples tells the same at 50 Hz and at 286 Hz: variance times interval stays."""
    log, told = simulate(0, 4.0, noise=0.0).log, []
    for rate_hz in (50.0, 286.0):
        t = np.arange(1, round(4.0 * rate_hz) + 1) / rate_hz
        imu = ImuSamples(t, np.zeros((len(t), 3)), np.tile([0.0, 0.0, -9.8], (len(t), 1)), log.imu.spec)
        mag = MagSamples(t, np.zeros((len(t), 3)), log.mag.spec)
        told.append(AhrsKf().figures(SensorLog(imu, log.initial, mag=mag)).mag_variance / rate_hz)
    # the specification's own 0.05 uT per sample is a part in 3e6 of 12 uT as a mean over a second
    assert told[0] == pytest.approx(told[1], rel=1e-6)


def test_an_error_of_scale_is_doubted_in_proportion_to_the_turn(start):
    """Over a second at 2 rad/s with a relative error of 1 %: 0.02 rad, 1 sigma, about each axis."""
    state, p, _ = start
    state[4:7], p[:] = 0.0, 0.0
    figures = FIGURES._replace(gyro_variance=0.0, bias_variance=0.0, scale_variance=0.01**2)
    samples = Samples(np.array([[0.0, 0.0, 2.0]]), *(np.zeros((1, 3)),) * 2, np.array([-1]), np.zeros(3))
    model = make_filter(samples, figures, (state, p), OwnGain(np.zeros(1)), OwnGain(np.zeros(1)))
    for _ in range(50):
        predict(model, 0, 0.02, 1.0)
    np.testing.assert_allclose(np.diag(p)[:3], 0.02**2, rtol=2e-4)  # the sine of half a turn of 0.04 rad for its angle
