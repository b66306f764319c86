"""Speed of the sensors: one hour of a 200 Hz IMU beside numpy's drawing of the same count of normals."""

from __future__ import annotations

import numpy as np
import pytest

from testbed.base.schema import validate
from testbed.data.records import Trajectory
from testbed.sensors import sense_flight, static_log
from testbed.sensors.config import InitialConfig
from testbed.sensors.registry import SensorsConfig

HOUR = 3600.0


@pytest.mark.benchmark(group="sensing: 1 h at 200 Hz")
def test_numpy_normals(benchmark):
    benchmark.extra_info["flight_s"] = HOUR
    benchmark(lambda: np.random.default_rng(0).standard_normal((int(200 * HOUR), 6)))


@pytest.mark.benchmark(group="sensing: 1 h at 200 Hz")
@pytest.mark.parametrize("model", ["ADIS16405", "ADIS16448", "ahrs-lstm-2022"])
def test_imu(benchmark, model):
    static_log(model, 200.0, 1.0)
    benchmark.extra_info["flight_s"] = HOUR
    benchmark(static_log, model, 200.0, HOUR)


@pytest.mark.benchmark(group="sensing: all sensors of a 300 s flight at 200 Hz")
def test_flight(benchmark):
    n = 60_001
    t, zero = np.arange(n) / 200.0, np.zeros((n, 3))
    level = np.tile([1.0, 0.0, 0.0, 0.0], (n, 1))
    flight = Trajectory(t, 0.7 + 0.0 * t, 0.1 + 0.0 * t, 500.0 + 0.0 * t, zero, level, zero - [0.0, 0.0, 9.8], zero)
    table = {"imu": {"model": "ADIS16405"}, "gnss": {"model": "Garmin16x"}, "mag": {"model": "ADIS16405"}, "baro": {}}
    sensors = validate(SensorsConfig, table, "bench")
    sense_flight(sensors, InitialConfig(), flight, 0)
    benchmark.extra_info["flight_s"] = 300.0
    benchmark(sense_flight, sensors, InitialConfig(), flight, 0)
