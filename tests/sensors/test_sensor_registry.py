"""A new sensor is one file: scenario, log, files, catalogue and report take it from there; the old ones are as they were."""

import json
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from synthetic import weaving_flight

from testbed.base.errors import InputError
from testbed.base.schema import validate
from testbed.data.records import SensorLog
from testbed.sensors import list_sensors, sense_flight
from testbed.sensors.config import InitialConfig
from testbed.sensors.registry import SENSORS, SensorsConfig

HERE = Path(__file__).parents[1]
SCENARIO = """
[scenario]
name = "ranged"
[flight]
type = "drive"
initial = { speed_mps = 10.0, alt_m = 123.0 }
manoeuvres = [{ type = "straight", duration_s = 5.0 }]
[sensors.rangefinder]
model = "small"
ground_m = 120.0
noise_m = 0.01
[sensors.gnss]
[[estimators]]
name = "ins"
[monte_carlo]
runs = 1
"""


def test_a_new_sensor_is_one_file(tmp_path):
    """The range finder of tests/plugins, 3 m above ground: scenario, log, tables out and in, catalogue, report."""
    (tmp_path / "sensors").mkdir()
    shutil.copy(HERE / "plugins" / "sensor_rangefinder.py", tmp_path / "sensors" / "rangefinder.py")
    (tmp_path / "scenario.toml").write_text(SCENARIO)
    done = subprocess.run(
        [sys.executable, HERE / "run_with_sensor.py", tmp_path / "sensors", tmp_path], capture_output=True, text=True
    )
    assert done.returncode == 0, done.stderr
    told = json.loads(done.stdout.splitlines()[-1])
    assert told["catalogue"] == {"ideal": "no errors at all", "small": "assumed"}
    assert told["range"] == pytest.approx([3.0, 3.0, 3.0], abs=0.05) and told["count"] == 100
    assert told["loaded"] and told["imported"] and told["sigma"] == [0.01, 0.01]
    assert "### Range finder, small" in told["report"] and "0.0100 m" in told["report"]


def test_the_sensors_of_the_bench():
    assert list(SENSORS) == ["gnss", "mag", "baro", "airspeed", "odometer"]
    assert {"car", "ideal"} <= set(list_sensors()["odometer"]) and "ADIS16405" in list_sensors()["mag"]
    for kind, sensor in SENSORS.items():
        assert sensor.kind == kind == sensor.config.kind == sensor.samples.kind
        for key, field in sensor.config.model_fields.items():
            if sensor.figures and key not in ("model", "file"):
                assert field.description, f"{kind}.{key}"  # documentation is made of it


def test_a_sensor_that_nobody_knows_is_shown_but_not_saved(tmp_path):
    truth = weaving_flight(3.0, 50.0)
    log, _ = sense_flight(SensorsConfig(), InitialConfig(perfect=True), truth, 1)
    (tmp_path / "f").mkdir()
    own = validate(SensorsConfig, {"odometer": {}}, "s")
    odometer = sense_flight(own, InitialConfig(perfect=True), truth, 1)[0].odometer
    mine = SensorLog(log.imu, log.initial, wheel=odometer)
    assert mine.wheel is odometer and list(mine.frames()["wheel"]) == ["time_s", "speed"]
    with pytest.raises(InputError, match="no sensor of the bench is called 'wheel'"):
        mine.save(tmp_path / "log")
    assert not (tmp_path / "log").exists()


def test_random_streams_are_those_of_version_0_1():
    """Samples as version 0.1 drew them (12 digits; libraries differ in the last): one row of each of its sensors."""
    truth = weaving_flight(20.0, 50.0)
    table = {
        "imu": {"model": "ADIS16448"},
        "gnss": {"model": "Garmin16x", "horizontal_markov_sigma_m": 2.0},
        "mag": {"model": "ADIS16405", "misalignment_deg": 1.0},
        "baro": {"model": "ADIS16448"},
    }
    log, errors = sense_flight(validate(SensorsConfig, table, "s"), InitialConfig(), truth, 7, 3)
    row = [*log.imu.gyro[100], *log.imu.accel[100], *log.mag.field[100], log.baro.pressure[20], *log.gnss.v_n[10]]
    row += [*errors.constants["mag_hard_iron"], errors.constants["baro_turn_on_bias"], *log.initial.v_n]
    np.testing.assert_allclose(row, EXPECTED, rtol=1e-11, atol=1e-12)


EXPECTED = [
    0.145211393765928,
    0.0265290046303138,
    0.0202458193231342,
    2.21378259095,
    -0.653515156,
    -13.60128418425,
    20.7,
    -3.3,
    43.4,
    84576.0,
    114.558253268433,
    101.585173181581,
    -7.96602805953562,
    0.15552590119356,
    0.291926005909067,
    -0.324607044732406,
    105.980848911215,
    114.831182155357,
    96.5614681883135,
    0.0110987538641611,
]
"""Recorded with version 0.1 (commit de6d059)."""
