"""Speed of the direct filters over 150 s at 100 Hz with fixes at 5 Hz, beside the triple product that none can do without.

Printed, never asserted: see the ``samples`` and ``us_per_sample`` columns.
"""

from __future__ import annotations

import numpy as np
import pytest
from numba import njit

from estimators.direct import DirectEkf, Rstekf, Stekf
from estimators.direct_ukf import DirectUkf
from estimators.imm import ImmEkf, ImmRstekf
from tests.synthetic import sensor_log, weaving_flight

ESTIMATORS = [DirectEkf(), DirectUkf(), Stekf(), Rstekf(), ImmEkf(), ImmRstekf()]


@pytest.fixture(scope="module")
def log():
    return sensor_log(weaving_flight(150.0), 1, gnss_rate=5.0, position_sigma=3.0, velocity_sigma=0.1)


@pytest.mark.parametrize("estimator", ESTIMATORS, ids=[estimator.name for estimator in ESTIMATORS])
def test_bench_direct_filter(benchmark, log, estimator) -> None:
    estimator.run(log)
    benchmark.group = "filters, 15000 samples"
    benchmark(estimator.run, log)
    benchmark.extra_info["us_per_sample"] = benchmark.stats.stats.median / len(log.imu.t) * 1e6


def test_bench_triple_product(benchmark) -> None:
    phi, p = np.eye(15) + 1e-3, np.eye(15)
    _triple(phi, p, 2)
    benchmark.group = "filters, 15000 samples"
    benchmark(_triple, phi, p, 15000)


@njit
def _triple(phi, p, count):
    for _ in range(count):
        q = phi @ p @ phi.T
    return q
