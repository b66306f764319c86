"""Cost of the NARX schemes beside the filter that they sit on: 310 s at 200 Hz, 5 Hz fixes, one outage, learning on line.

Printed, never asserted. The thesis's flight 2 is ten times as long.
"""

from __future__ import annotations

import pytest

from estimators.learning.narx_aiding import Nnakf, Nnckf
from estimators.methods.direct import DirectEkf
from estimators.methods.direct_ukf import DirectUkf
from tests.synthetic import sensor_log, weaving_flight

ESTIMATORS = {
    "direct-ekf": DirectEkf(),
    "direct-ukf": DirectUkf(),
    "nnckf-ekf": Nnckf(filter="ekf"),
    "nnakf-ekf": Nnakf(filter="ekf"),
    "nnakf-ukf": Nnakf(),
}


@pytest.fixture(scope="module")
def log():
    flight = weaving_flight(310.0, rate=200.0, speed=40.0, bank=0.6)
    return sensor_log(flight, 1, ((239.9, 299.9),), gnss_rate=5.0, position_sigma=0.5, velocity_sigma=0.1)


@pytest.mark.parametrize("name", ESTIMATORS)
def test_bench_narx(benchmark, log, name) -> None:
    estimator = ESTIMATORS[name]
    estimator.run(log)
    benchmark.group = "NARX aiding, 62000 samples"
    benchmark.pedantic(estimator.run, (log,), rounds=3)
    benchmark.extra_info["us_per_sample"] = benchmark.stats.stats.median / len(log.imu.t) * 1e6
