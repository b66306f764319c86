"""Eight runs side by side in vector lanes, beside the same filter's single run on one of them (`test_bench_direct`).

150 s at 100 Hz with fixes at 5 Hz; samples are those of all runs. Printed, never asserted.
"""

from __future__ import annotations

import pytest

from estimators.methods.direct import DirectEkf
from estimators.methods.direct_ukf import DirectUkf
from estimators.methods.imm import ImmRstekf
from estimators.methods.indirect_kf import IndirectKf
from testbed.kernels.lanes import WIDTH
from tests.synthetic import sensor_log, weaving_flight

ESTIMATORS = [IndirectKf(), DirectEkf(), DirectUkf(), ImmRstekf()]


@pytest.fixture(scope="module")
def logs():
    flight = weaving_flight(150.0)
    return [sensor_log(flight, seed, gnss_rate=5.0, position_sigma=3.0, velocity_sigma=0.1) for seed in range(WIDTH)]


@pytest.mark.benchmark(group="direct filters, 100 Hz")
@pytest.mark.parametrize("estimator", ESTIMATORS, ids=[estimator.name for estimator in ESTIMATORS])
def test_bench_side_by_side_runs(benchmark, logs, estimator) -> None:
    benchmark.extra_info["samples"] = sum(len(log.imu.t) for log in logs)
    benchmark(estimator.run_many, logs)
