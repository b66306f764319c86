"""Alignment at rest: what standing still teaches a filter, how well it knows it, and where the log then begins."""

from __future__ import annotations

import math

import numpy as np
import pytest
from roads import made

from testbed import pipeline
from testbed.base.errors import InputError
from testbed.base.schema import validate
from testbed.physics import earth
from testbed.physics.rotations import attitude_error, quats_to_eulers
from testbed.scenario import load_scenario
from testbed.scenario.windows import resolve_windows
from testbed.sensors import sense_flight
from testbed.sensors.config import InitialConfig
from testbed.sensors.registry import SensorsConfig

RUNS = 60
STAND = {"type": "stop", "duration_s": 62.0}
GO = {"type": "accelerate", "to_speed_mps": 10.0}


@pytest.fixture(scope="module")
def truth():
    return made(STAND, GO, rate_hz=50.0, initial={"heading_deg": 73.0, "lat_deg": 48.0})


def aligned(truth, run=0, imu=None, **keys):
    sensors = {
        "imu": {"model": "ADIS16448"} | (imu or {}),
        "mag": {"model": "ADIS16448"},
        "gnss": {"model": "Garmin16x"},
    }
    initial = validate(InitialConfig, {"align_at_rest_s": 60.0} | keys, "initial")
    return sense_flight(validate(SensorsConfig, sensors, "sensors"), initial, truth, 4, run)


def test_a_standing_vehicle_feels_gravity_and_the_turning_earth(truth):
    """The bench's own at-rest promise: 1e-5 m/s² and 0.01 deg/h, against Somigliana's formula and the rate of the Earth."""
    rest = slice(5, 2900)
    g, rate = earth.gravity(np.radians(48.0), 200.0), np.array(earth.earth_rate_n(np.radians(48.0)))
    assert np.abs(np.linalg.norm(truth.f_b[rest], axis=1) - g).max() < 1e-5
    c, s = np.cos(np.radians(73.0)), np.sin(np.radians(73.0))
    expected = np.array([c * rate[0], -s * rate[0], rate[2]])
    assert np.degrees(np.abs(truth.w_ib_b[rest] - expected).max()) * 3600.0 < 0.01


@pytest.mark.parametrize("heading", ["mag", "given", "unknown"])
def test_the_start_is_as_good_as_it_says(truth, heading):
    """Mean of error² / sigma² over 60 runs, per group: chi-square of 60 to 180 degrees of freedom within its 99.9 % bounds.
    An unknown heading is a uniform one, of which this truth has a single value."""
    from scipy.stats import chi2

    ratios = {"tilt": [], "heading": [], "gyro": [], "accel": []}
    for run in range(RUNS):
        log, errors = aligned(truth, run, align_heading=heading)
        start = log.initial
        row = int(np.argmin(np.abs(truth.t - start.t)))
        q_true = truth.q_nb[row]
        if heading == "unknown":  # the tilt in the vehicle's own axes
            angles = quats_to_eulers(np.array([start.q_nb, q_true]))
            phi = np.array([*(angles[0, :2] - angles[1, :2]), 0.0])
        else:
            phi = np.array(attitude_error(start.q_nb, q_true))
        ratios["tilt"] += list(phi[:2] / start.std[6:8])
        ratios["heading"].append(phi[2] / start.std[8])
        ratios["gyro"] += list((start.gyro_bias - errors.gyro_bias[0]) / start.std[12:15])
        ratios["accel"] += list((start.accel_bias - errors.accel_bias[0]) / start.std[9:12])
    for name, values in ratios.items():
        if (name, heading) == ("heading", "unknown"):
            assert log.initial.std[8] == pytest.approx(math.pi / math.sqrt(3.0))
            continue
        n = len(values)
        low, high = chi2.ppf([0.0005, 0.9995], n)
        assert low < np.square(values).sum() < high, (name, np.mean(np.square(values)))


def test_the_tilt_is_the_bias_over_gravity(truth):
    """A levelled filter takes what its accelerometers err for gravity; without other errors there is nothing else but the
    wander of the bias within the minute: three sigma of 0.38 mg, a tenth of the bias."""
    imu = {
        "model": "ADIS16448",
        "disable": ["misalignment", "nonlinearity", "g_sensitivity", "scale_factor"],
    }
    log, errors = aligned(truth, imu=imu)
    roll, pitch, _ = quats_to_eulers(log.initial.q_nb[None])[0]
    g = earth.gravity(np.radians(48.0), 200.0)
    np.testing.assert_allclose([pitch, roll], errors.accel_bias[0, :2] / g * np.array([1.0, -1.0]), atol=1.2e-3)


def test_the_log_begins_after_the_alignment(truth):
    log, errors = aligned(truth)
    assert log.initial.t == pytest.approx(60.0) and log.imu.t[0] == pytest.approx(60.02)
    assert log.gnss.t[0] > 60.0 and log.mag.t[0] > 60.0 and len(errors.t) == len(log.imu.t)
    assert np.abs(log.initial.v_n).max() == 0.0
    cut = pipeline.truth_at_imu(truth, log)
    assert cut.t[0] == pytest.approx(60.0) and len(cut.t) == len(log.imu.t) + 1
    assert all(len(values) == len(cut.t) for values in cut.extra.values())
    resolve_windows([], cut, ())


@pytest.mark.parametrize(
    ("keys", "message"),
    [
        ({"align_at_rest_s": 64.0}, r"the vehicle moves at t = 62\.\d+ s"),
        ({"align_at_rest_s": 1e4}, "the vehicle moves"),
        ({"roll_pitch_deg": 2.0}, "roll_pitch_deg has no meaning beside align_at_rest_s"),
        ({"align_heading": "mag", "yaw_deg": 1.0}, "yaw_deg has no meaning"),
        ({"align_at_rest_s": None, "align_heading": "mag"}, "align_heading has no meaning without"),
    ],
)
def test_what_cannot_be_is_refused(truth, keys, message):
    with pytest.raises(InputError, match=message):
        aligned(
            truth,
            **{key: value for key, value in keys.items() if value is not None}
            if keys.get("align_at_rest_s", 1)
            else keys,
        )


def test_a_magnetometer_must_be_there(truth):
    sensors = validate(SensorsConfig, {"imu": {"model": "ADIS16448"}}, "sensors")
    initial = validate(InitialConfig, {"align_at_rest_s": 30.0, "align_heading": "mag"}, "initial")
    with pytest.raises(InputError, match=r"align_heading = \"mag\", but the scenario has no \[sensors.mag\]"):
        sense_flight(sensors, initial, truth, 1)


def test_a_filter_runs_from_rest(tmp_path):
    """Through the whole pipeline: aligned for 15 s at the traffic light, driven, scored from there on."""
    keys = {"flight.laps": 1, "sensors.gnss.outages": [], "initial": {"position_m": 3.0, "align_at_rest_s": 15.0}, "windows": [], "claims": []}  # fmt: skip
    scenario = load_scenario("car-drive", overrides=keys)
    truth = pipeline.fly(scenario)
    log, errors = pipeline.sense(scenario, truth)
    from testbed.data.registry import make_estimator

    solution = make_estimator("indirect-kf").run(log)
    table = pipeline.score(scenario, truth, solution, log, errors).set_index("metric")["value"]
    assert table["rmse_position_3d_m"] < 5.0
