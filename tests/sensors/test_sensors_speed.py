"""Odometer and airspeed sensor: what they should read, and errors of the stated size."""

import numpy as np
import pytest
from roads import TOWN, made

from testbed.base.errors import InputError
from testbed.base.schema import validate
from testbed.data.records import SensorLog
from testbed.formats import export_log
from testbed.sensors import sense_flight
from testbed.sensors.config import InitialConfig
from testbed.sensors.registry import SensorsConfig

ROAD = [{"type": "straight", "duration_s": 400.0}]


@pytest.fixture(scope="module")
def town():
    return made(*TOWN)


def sense(truth, seed=1, run=0, imu=None, **sensors):
    config = validate(SensorsConfig, {"imu": imu or {}} | sensors, "test")
    return sense_flight(config, InitialConfig(perfect=True), truth, seed, run)


def test_an_ideal_odometer_reads_the_speed(town):
    """Mean speed over 0.1 s against the speed in its middle: they differ by v'' dt² / 24. Accelerations of 3 m/s² that
    build up within 4.7 s have v'' below pi a / (T / 2) = 4.1 m/s³: 1.7 mm/s."""
    log, _ = sense(town, odometer={})
    truth = np.interp(log.odometer.t, town.t, town.extra["speed_mps"])
    assert np.abs(log.odometer.speed - truth).max() < 2e-3
    assert log.odometer.t[0] == pytest.approx(0.05) and len(log.odometer.t) == int(town.t[-1] * 10)


def test_a_wheel_beside_the_axis_turns_with_the_body(town):
    """A wheel 0.8 m to the right rolls slower by 0.8 times the yaw rate in a right turn; IMU and wheel arms add."""
    imu, arm = {"lever_arm_m": [0.0, 0.3, 0.0]}, {"lever_arm_m": [0.0, 0.5, 0.0], "rate_hz": 50.0}
    log, _ = sense(town, imu=imu, odometer=arm)
    yaw_rate = np.interp(log.odometer.t, town.t - 0.5 * town.dt, town.w_ib_b[:, 2])
    speed = np.interp(log.odometer.t, town.t, town.extra["speed_mps"])
    assert np.ptp(yaw_rate) > 1.0
    # beside the Earth's rate, and what linear interpolation of speed and rate leaves of 0.8 m times 10 rad/s³ dt² / 8
    assert np.abs(log.odometer.speed - (speed - 0.8 * yaw_rate)).max() < 5e-3


def test_scale_noise_and_mounting_have_their_size():
    """1 % scale over 300 vehicles, noise over 4000 samples, both within 4 sigma of sampling; mounting turns speed by cosines."""
    road = made(*ROAD, initial={"speed_mps": 20.0})
    short = made({"type": "straight", "duration_s": 1.0}, initial={"speed_mps": 20.0})
    scales = [
        float(np.mean(log.odometer.speed)) / 20.0 - 1.0
        for log, _ in (sense(short, run=run, odometer={"scale_factor_pct": 1.0}) for run in range(300))
    ]
    assert np.std(scales) == pytest.approx(0.01, rel=4.0 / np.sqrt(600.0))
    log, errors = sense(road, odometer={"noise_mps": 0.1, "misalignment_deg": 5.0})
    up, side = errors.constants["odometer_misalignment"]
    size = np.hypot(up, side)
    assert log.odometer.speed.mean() == pytest.approx(20.0 * np.cos(size), abs=4.0 * 0.1 / np.sqrt(4000.0))
    assert log.odometer.speed.std() == pytest.approx(0.1, rel=4.0 / np.sqrt(8000.0))


def test_pulses_are_counted_and_none_is_lost(town):
    """Samples are whole pulses per interval; their sum is the way, to one pulse at each end."""
    log, _ = sense(town, odometer={"pulse_mm": 50.0, "latency_s": 0.05})
    counts = log.odometer.speed / (0.05 * 10.0)
    np.testing.assert_allclose(counts, np.rint(counts), atol=1e-9)
    way = np.sum(np.diff(town.t) * 0.5 * (town.extra["speed_mps"][1:] + town.extra["speed_mps"][:-1]))
    missing = (town.t[-1] - log.odometer.t[-1]) * town.extra["speed_mps"][-1]
    assert 0.05 * counts.sum() == pytest.approx(way - missing, abs=0.11)
    assert log.odometer.t[0] == pytest.approx(0.1)  # stamped when its interval ends


def test_the_stated_sigma_is_that_of_the_errors():
    """Over all speeds from 5 to 25 m/s: neighbours share an end of their intervals, which makes 4000 of them count as about
    2400; 4 sigma of the spread of so many."""
    road = made(
        {"type": "accelerate", "to_speed_mps": 25.0, "acceleration_mps2": 0.1}, initial={"speed_mps": 5.0}, rate_hz=50.0
    )
    log, _ = sense(road, odometer={"pulse_mm": 30.0, "noise_mps": 0.05})
    error = log.odometer.speed - np.interp(log.odometer.t, road.t, road.extra["speed_mps"])
    assert len(error) == 4000
    assert np.std(error) == pytest.approx(log.odometer.spec.measurement_std(), rel=4.0 / np.sqrt(2.0 * 2400))


def test_adding_an_odometer_changes_no_other_stream(town):
    alone, _ = sense(town, imu={"model": "ADIS16448"}, gnss={"model": "Garmin16x"})
    both, _ = sense(town, imu={"model": "ADIS16448"}, gnss={"model": "Garmin16x"}, odometer={"model": "car"})
    assert np.array_equal(alone.imu.gyro, both.imu.gyro) and np.array_equal(alone.gnss.lat, both.gnss.lat)


def test_airspeed_is_that_of_the_air():
    """From the column of the flight, with wind in it; scale and noise within 4 sigma of sampling; below 5 m/s nothing."""
    road = made(*ROAD, initial={"speed_mps": 20.0})
    road.extra["airspeed_mps"] = road.extra["speed_mps"] + 4.0 * np.sin(0.1 * road.t)
    log, errors = sense(road, airspeed={"model": "pitot", "noise_mps": 0.2})
    scale = 1.0 + errors.constants["airspeed_scale_factor"]
    residual = log.airspeed.speed - scale * (20.0 + 4.0 * np.sin(0.1 * log.airspeed.t))
    assert residual.std() == pytest.approx(0.2, rel=4.0 / np.sqrt(8000.0))
    assert residual.mean() == pytest.approx(0.0, abs=4.0 * 0.2 / np.sqrt(4000.0))
    road.extra["airspeed_mps"][:] = 3.0
    assert not sense(road, airspeed={"model": "pitot"})[0].airspeed.speed.any()


def test_logs_with_them_are_saved_and_read(town, tmp_path):
    log, _ = sense(town, odometer={"model": "car", "lever_arm_m": [1.0, 0.0, 0.5]}, gnss={})
    log.save(tmp_path / "log")
    loaded = SensorLog.load(tmp_path / "log")
    np.testing.assert_array_equal(loaded.odometer.speed, log.odometer.speed)
    assert loaded.odometer.spec == log.odometer.spec and list(loaded.aiding) == ["gnss", "odometer"]


def test_a_log_says_what_it_lacks(town, tmp_path):
    log, _ = sense(town, odometer={})
    assert log.gnss is None and log.airspeed is None
    with pytest.raises(InputError, match="'navego' has no place for odometer"):
        export_log(log, tmp_path / "mat", "navego")
    assert not (tmp_path / "mat").exists()
    with pytest.raises(AttributeError, match="has no 'odometr'; this one has imu, odometer"):
        _ = log.odometr
    with pytest.raises(InputError, match="no odometer named 'lorry'"):
        sense(town, odometer={"model": "lorry"})
    with pytest.raises(InputError, match="scale_factor_pct"):
        sense(town, odometer={"scale_factor": 1.0})
