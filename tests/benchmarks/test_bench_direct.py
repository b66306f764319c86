"""Speed of the direct filters over 150 s at 100 Hz with fixes at 5 Hz, beside what none can do without and filterpy's UKF.

Printed, never asserted. The triple product and the sigma points are those of `arithmetic`; a filter with three branches
needs three of the former. filterpy runs on a few samples: its cost is linear in them.
"""

from __future__ import annotations

import numpy as np
import pytest

from estimators.methods.direct import DirectEkf, Rstekf, Stekf
from estimators.methods.direct_ukf import DirectUkf
from estimators.methods.imm import ImmEkf, ImmRstekf
from estimators.methods.indirect_kf import IndirectKf
from tests.benchmarks.arithmetic import sigma_point_sums, strapdown_steps, triple_products
from tests.benchmarks.python_peers import filterpy_ukf
from tests.synthetic import sensor_log, weaving_flight

ESTIMATORS = [IndirectKf(), DirectEkf(), DirectUkf(), Stekf(), Rstekf(), ImmEkf(), ImmRstekf()]
PEER_SAMPLES = 300
SIGMA_POINTS = 30
GROUP = "direct filters, 100 Hz"


@pytest.fixture(scope="module")
def log():
    return sensor_log(weaving_flight(150.0), 1, gnss_rate=5.0, position_sigma=3.0, velocity_sigma=0.1)


@pytest.mark.benchmark(group=GROUP)
@pytest.mark.parametrize("estimator", ESTIMATORS, ids=[estimator.name for estimator in ESTIMATORS])
def test_bench_direct_filter(benchmark, log, estimator) -> None:
    benchmark.extra_info["samples"] = len(log.imu.t)
    benchmark(estimator.run, log)


@pytest.mark.benchmark(group=GROUP)
def test_bench_direct_triple_product(benchmark, log) -> None:
    benchmark.extra_info["samples"] = len(log.imu.t)
    benchmark(triple_products, np.eye(15) + 1e-6, np.eye(15), len(log.imu.t))


@pytest.mark.benchmark(group=GROUP)
def test_bench_sigma_points(benchmark, log) -> None:
    """Cholesky factor, points and sums of one prediction, and every point through the least of a strapdown step."""
    n = len(log.imu.t)
    turns, pushes = np.tile(log.imu.gyro, (SIGMA_POINTS, 1)), np.tile(log.imu.accel, (SIGMA_POINTS, 1))

    def both():
        sigma_point_sums(np.eye(15), n)
        strapdown_steps(turns, pushes, 0.01)

    benchmark.extra_info["samples"] = n
    benchmark.pedantic(both, rounds=5, warmup_rounds=1)


@pytest.mark.benchmark(group=GROUP)
def test_bench_filterpy_ukf(benchmark, log) -> None:
    pytest.importorskip("filterpy")
    benchmark.extra_info["samples"] = PEER_SAMPLES
    states = benchmark.pedantic(filterpy_ukf, (log, PEER_SAMPLES), rounds=3, warmup_rounds=1)
    ours = DirectUkf().run(log)
    # the same model and noise, other times of the fixes within a sample: metres per second agree to a centimetre or two
    assert np.abs(states[-1, 3:6] - ours.v_n[PEER_SAMPLES - 1]).max() < 0.1
