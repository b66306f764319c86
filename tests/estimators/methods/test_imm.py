"""Interacting multiple models: identity, probabilities, mode recognition, tables of branches, strong tracking."""

from __future__ import annotations

import numpy as np
import pytest
from test_direct import errors, rms

from estimators.methods import imm_kernels
from estimators.methods.direct import DirectEkf, Rstekf
from estimators.methods.direct_kernels import make_work
from estimators.methods.imm import ImmEkf, ImmRstekf
from estimators.methods.imm_kernels import Aiding
from estimators.methods.motion_models import Setting
from testbed import pipeline
from testbed.base.errors import InputError
from testbed.data.records import SensorLog
from testbed.physics.earth import gravity, metres_per_radian
from testbed.physics.rotations import wrap
from testbed.scenario import load_scenario
from tests.phased_flight import phased_flight, with_biases
from tests.synthetic import sensor_log, weaving_flight


@pytest.fixture(scope="module")
def log() -> SensorLog:
    truth = weaving_flight(40.0, bank=0.7)
    raw = sensor_log(truth, 1, gnss_rate=5.0, position_sigma=3.0, velocity_sigma=0.1, std=(3.0, 0.1, 0.02))
    return with_biases(raw, accel=0.1, gyro=1e-3)


@pytest.mark.parametrize(("bank", "single"), [(ImmEkf, DirectEkf()), (ImmRstekf, Rstekf())])
def test_identical_branches_are_the_single_filter(bank: type, single, log: SensorLog) -> None:
    together, alone = bank(branches=[{"model": "accelerated"}] * 3).run(log), single.run(log)
    north, east = metres_per_radian(log.initial.lat, log.initial.h)
    np.testing.assert_allclose((together.lat - alone.lat) * north, 0.0, atol=1e-6)
    np.testing.assert_allclose((together.lon - alone.lon) * east, 0.0, atol=1e-6)
    np.testing.assert_allclose(together.v_n, alone.v_n, atol=1e-7)
    np.testing.assert_allclose(together.q_nb, alone.q_nb, atol=1e-8)
    np.testing.assert_allclose(together.std, alone.std, rtol=1e-6)
    np.testing.assert_allclose(
        together.innovations["gnss"].covariance, alone.innovations["gnss"].covariance, rtol=1e-6, atol=1e-9
    )


@pytest.mark.parametrize("estimator", [ImmEkf(), ImmRstekf()])
def test_mode_probabilities_sum_to_one(estimator: ImmEkf, log: SensorLog) -> None:
    solution = estimator.run(log)
    _, probability = solution.extras["mode_probability"]
    assert probability.shape == (len(log.gnss.t), 3)
    assert (probability >= 0.0).all()
    np.testing.assert_allclose(probability.sum(axis=1), 1.0, atol=1e-12)
    assert np.isfinite(solution.std).all()


def test_likelihoods_of_any_size_are_compared() -> None:
    # exp(-1e5) is zero in float64: only a logarithm tells these branches apart.
    posterior = np.empty(3)
    imm_kernels.log_probabilities(np.array([0.2, 0.3, 0.5]), np.array([-1e5, -1e5 + np.log(2.0), -2e5]), posterior)
    np.testing.assert_allclose(posterior, [0.25, 0.75, 0.0], atol=1e-12)


def test_headings_are_averaged_on_the_circle() -> None:
    states, covariances = np.zeros((2, 15)), np.zeros((2, 15, 15))
    states[:, 8] = np.radians([179.0, -179.0])
    mean, covariance = np.empty(15), np.empty((15, 15))
    imm_kernels.combine(np.array([0.5, 0.5]), states, covariances, mean, covariance)
    assert wrap(mean[8] - np.pi) == pytest.approx(0.0, abs=1e-12)
    assert covariance[8, 8] == pytest.approx(np.radians(1.0) ** 2, rel=1e-9)


def test_mixing_keeps_mean_and_covariance_of_the_whole() -> None:
    # Total probability: what the bank believes about the state cannot change by regrouping it.
    rng = np.random.default_rng(0)
    states = rng.standard_normal((3, 15)) * 0.1
    roots = rng.standard_normal((3, 15, 15))
    covariances = roots @ roots.transpose(0, 2, 1)
    probability, transition = np.array([0.2, 0.3, 0.5]), np.array([[0.9, 0.1, 0.0], [0.2, 0.7, 0.1], [0.0, 0.3, 0.7]])
    before, after = (np.empty(15), np.empty((15, 15))), (np.empty(15), np.empty((15, 15)))
    imm_kernels.combine(probability, states, covariances, *before)
    predicted = np.empty(3)
    work = (np.empty(3), np.empty_like(states), np.empty_like(covariances))
    imm_kernels.mix(probability, transition, states, covariances, predicted, *work)
    imm_kernels.combine(predicted, states, covariances, *after)
    np.testing.assert_allclose(predicted, probability @ transition, atol=1e-14)
    np.testing.assert_allclose(after[0], before[0], atol=1e-12)
    np.testing.assert_allclose(after[1], before[1], atol=1e-12)


def test_right_mode_is_the_most_probable_in_every_phase() -> None:
    # Modes can be told apart only where their predictions differ by more than the fix's noise, and where the simpler
    # model predicts better: accelerometers shaken by vibration (0.2 m/s²/√Hz) against air so calm that an aircraft holds
    # its velocity within 0.02 m/s/√s, gyros of 1.7 °/√h (turn rate times speed: 0.075 m/s/√s), 0.02 m/s velocity fixes.
    truth = phased_flight()
    hits = np.zeros((2, len(truth.phases)))
    for seed in range(3):
        quiet = sensor_log(
            truth,
            seed,
            gnss_rate=5.0,
            accel_noise=2.0,
            gyro_noise=5e-3,
            position_sigma=3.0,
            velocity_sigma=0.02,
            std=(3.0, 0.02, 0.005),
        )
        tables = [
            {"model": "cv", "velocity_noise": 0.02},
            {"model": "ct", "velocity_noise": 0.02},
            {"model": "accelerated"},
        ]
        t, probability = ImmEkf(branches=tables).run(quiet).extras["mode_probability"]
        best = np.array([table["model"] for table in tables])[probability.argmax(axis=1)]
        for i, phase in enumerate(truth.phases):
            inside = (t > phase.start) & (t <= phase.end)
            hits[:, i] += (best[inside] == phase.name).sum(), inside.sum()
    assert (hits[0] / hits[1] > 0.8).all(), hits[0] / hits[1]


def test_angles_of_the_constant_velocity_branch_are_unbiased_and_valid_only_at_rest() -> None:
    place = np.array([0.9, 500.0, *metres_per_radian(0.9, 500.0)])
    setting = Setting(place, np.zeros(6), np.zeros(2), np.zeros(3))
    aiding = Aiding(1e-4, 1e-4, 0.03, np.radians(2.0), 3.0)
    roll, pitch, yaw, g = 0.1, -0.05, 2.0, float(gravity(0.9, 500.0))
    force = -g * np.array([-np.sin(pitch), np.sin(roll) * np.cos(pitch), np.cos(roll) * np.cos(pitch)])
    velocity = 100.0 * np.array([np.cos(yaw), np.sin(yaw), 0.0])

    def aided(rate: float, scale: float) -> tuple[np.ndarray, np.ndarray]:
        x, p = np.zeros(15), np.diag(np.r_[np.ones(6), np.full(3, 1e2), np.full(6, 1e-12)])
        imu = np.r_[[rate, 0.0, 0.0], scale * force]
        seen = np.r_[np.zeros(3), velocity], np.full(6, 1e-4), imu
        imm_kernels.aid_with_angles(x, p, seen, setting, aiding, make_work())
        return x, p

    x, p = aided(0.0, 1.0)
    np.testing.assert_allclose(x[6:9], [roll, pitch, yaw], atol=1e-4)
    np.testing.assert_allclose(np.sqrt(np.diag(p)[6:9]), 0.01, rtol=0.01)
    for rate, scale in ((0.1, 1.0), (0.0, 1.1)):
        x, p = aided(rate, scale)
        np.testing.assert_array_equal(x, 0.0)


def test_noise_adaptive_bank_follows_an_accelerometer_that_turns_noisy() -> None:
    # A further variant: two accelerated branches, one with 20 times the noise, when vibration sets in half-way.
    truth = weaving_flight(60.0, bank=0.5)
    adaptive = ImmEkf(branches=[{"model": "accelerated"}, {"model": "accelerated", "noise_scale": 20.0}])
    single, bank = [], []
    for seed in range(4):
        raw = sensor_log(truth, seed, gnss_rate=5.0, position_sigma=3.0, velocity_sigma=0.05, std=(3.0, 0.05, 0.01))
        late = raw.imu.t > 30.0
        noise = np.random.default_rng(seed).standard_normal(raw.imu.accel.shape)
        raw.imu.accel[late] += 6.0 * noise[late]
        solution = adaptive.run(raw)
        t, probability = solution.extras["mode_probability"]
        assert probability[(t > 5.0) & (t < 30.0), 0].mean() > 0.5 > probability[t > 32.0, 0].mean()
        bank.append(rms(errors(solution, truth)[3000:, 3:6]))
        single.append(rms(errors(DirectEkf().run(raw), truth)[3000:, 3:6]))
    assert np.mean(bank) < np.mean(single)


def test_singer_branch_follows_a_constant_acceleration() -> None:
    # Without accelerometers, from velocity fixes alone, constant velocity lags behind; the held acceleration does not.
    truth = phased_flight((("cv", 20.0, 0.0, 0.0), ("accelerated", 20.0, 0.0, 2.0)))
    raw = sensor_log(truth, 0, gnss_rate=5.0, position_sigma=3.0, velocity_sigma=0.05, std=(3.0, 0.05, 0.01))
    along = truth.v_n[3001:] / np.linalg.norm(truth.v_n[3001:], axis=1)[:, None]
    lag = {}
    for model in ("cv", "singer"):
        table = {"model": model, "velocity_noise": 0.2, "angle_aiding": False}
        solution = ImmEkf(branches=[table], manoeuvre_time_s=5.0).run(raw)
        lag[model] = -np.mean(np.sum(errors(solution, truth)[3000:, 3:6] * along, axis=1))
    assert lag["cv"] > 0.1
    assert abs(lag["singer"]) < 0.3 * lag["cv"]


@pytest.mark.parametrize(
    ("parameters", "message"),
    [
        ({"branches": [{"model": "accelarated"}]}, "did you mean 'accelerated'"),
        ({"branches": [{"model": "cv", "filter": "stkf"}]}, "did you mean 'stekf'"),
        ({"branches": [{"model": "cv", "noise": 1.0}]}, "no key 'noise'"),
        ({"branches": [{"filter": "ekf"}]}, "key 'model'"),
        ({"branches": []}, "list of tables"),
        ({"branches": [{"model": "cv", "velocity_noise": -1.0}]}, "velocity_noise"),
        ({"stay_probability": 1.2}, "stay_probability"),
        ({"transition_matrix": [[0.5, 0.5], [0.5, 0.5]]}, "3 x 3"),
        ({"initial_probability": [0.5, 0.5, 0.5]}, "sum to 1"),
    ],
)
def test_bad_banks_are_refused(parameters: dict, message: str) -> None:
    with pytest.raises(InputError, match=message):
        ImmEkf(**parameters)


def test_strong_tracking_keeps_its_covariance_through_the_flight_of_its_paper():
    """Sigmas at their ceilings against fixes of metres, thousands of times. With Joseph's form multiplied out into one pass, six
    of these eight runs ended in NaN."""
    scenario = load_scenario("imm-rstekf-2023")
    flight = pipeline.fly(scenario)
    for run in range(8):
        solution = ImmRstekf().run(pipeline.sense(scenario, flight, run=run)[0])
        assert np.isfinite(solution.lat).all() and np.isfinite(solution.std).all(), run
