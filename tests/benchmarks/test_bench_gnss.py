"""Cost of GNSS down to the satellites: simulation and receiver per epoch, `tight-kf` per IMU sample.

Run with ``make bench``; timings are printed, never asserted. The sky has the 24 satellites of nominal GPS, or for the filter
GPS and Galileo of which the twelve highest are kept.
"""

from __future__ import annotations

import numpy as np
import pytest

from estimators.methods.tight_kf import TightKf
from testbed.base.schema import validate
from testbed.data.records import SensorLog, Trajectory
from testbed.gnss.config import SatellitesConfig
from testbed.gnss.receiver import solve
from testbed.gnss.sense import Antenna, corrected, sense_satellites, signals_of, space_of
from testbed.sensors import sense_flight
from testbed.sensors.config import GnssConfig, InitialConfig
from testbed.sensors.draws import Draws
from testbed.sensors.registry import SensorsConfig

SECONDS, RATE_HZ, EPOCHS_HZ = 200.0, 100.0, 5.0
EPOCHS = int(SECONDS * EPOCHS_HZ)
HOUR = 3600.0
"""A simulation opens its random streams once, which takes as long as a thousand epochs."""
GPS = SatellitesConfig()
TWELVE = {"systems": ["gps", "galileo"], "keep": [{"start_s": 0.0, "end_s": SECONDS, "highest": 12}]}


def flight(seconds: float = SECONDS, rate_hz: float = RATE_HZ) -> Trajectory:
    n = int(seconds * rate_hz) + 1
    t, zero = np.arange(n) / rate_hz, np.zeros((n, 3))
    level = np.tile([1.0, 0.0, 0.0, 0.0], (n, 1))
    return Trajectory(t, 0.8 + 0.0 * t, 0.2 + 0.0 * t, 500.0 + 0.0 * t, zero, level, zero - [0.0, 0.0, 9.8], zero)


@pytest.mark.benchmark(group="GNSS down to the satellites, per epoch")
class TestEpochs:
    def test_bench_normals_of_an_epoch(self, benchmark):
        """What a simulation draws at least: six errors of 24 satellites."""
        benchmark.extra_info["epochs"] = EPOCHS
        benchmark(lambda: np.random.default_rng(0).standard_normal((EPOCHS, 24, 6)))

    def test_bench_satellites(self, benchmark):
        spec = validate(GnssConfig, {"mode": "satellites", "model": "module-class"}, "bench").spec()
        antenna = antenna_of(flight(HOUR, 10.0))
        benchmark.extra_info["epochs"] = len(antenna.moments)
        benchmark(lambda: sense_satellites(GPS, spec, antenna, Draws(1)))

    @pytest.mark.parametrize("count", [8, 12, 24])
    def test_bench_receiver(self, benchmark, count):
        """Position, velocity and the test for a wrong satellite."""
        received = epochs_of(count)
        benchmark.extra_info["epochs"] = EPOCHS
        fixes = benchmark(solve, received)
        assert np.isfinite(fixes.place).all()


def antenna_of(trajectory: Trajectory) -> Antenna:
    epochs = int(trajectory.t[-1] * EPOCHS_HZ)
    return Antenna(trajectory, np.zeros(3), np.arange(1, epochs + 1) / EPOCHS_HZ, np.zeros(epochs, dtype=bool))


def epochs_of(count):
    """``EPOCHS`` epochs of ``count`` satellites: those of a simulated sky, repeated from other sides where it has fewer."""
    config = SatellitesConfig(systems=["gps", "galileo"], expanded=True)
    spec = validate(GnssConfig, {"mode": "satellites", "model": "module-class", "mask_deg": 0.0}, "bench").spec()
    spec = type(spec)(**{**vars(spec), "space": space_of(config), "signals": signals_of(config, spec.signals)})
    received = corrected(sense_satellites(config, spec, antenna_of(flight()), Draws(1))[0])
    per = np.diff(received.first)
    # rows of each epoch in turn until there are enough: a satellite twice is two measurements
    rows = np.concatenate([received.first[k] + np.arange(count) % per[k] for k in range(EPOCHS)])
    return type(received)(np.arange(EPOCHS + 1) * count, *(values[rows] for values in received[1:]))


@pytest.fixture(scope="module")
def log() -> SensorLog:
    table = {
        "imu": {"model": "ADIS16448"},
        "gnss": {"model": "module-class", "mode": "satellites", "satellites": TWELVE},
    }
    made, _ = sense_flight(validate(SensorsConfig, table, "bench"), InitialConfig(), flight(), 1)
    return made


@pytest.mark.benchmark(group="tightly coupled filter, 100 Hz, 12 satellites at 5 Hz")
@pytest.mark.parametrize("slow_errors", ["white", "inflate", "states"])
def test_bench_tight(benchmark, log, slow_errors):
    benchmark.extra_info["samples"] = len(log.imu.t)
    benchmark(TightKf(slow_errors=slow_errors).run, log)
