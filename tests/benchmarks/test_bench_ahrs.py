"""Speed of the attitude filters over 120 s at 50 Hz, beside what they cannot do without and the filters of the packages ahrs and vqf.

The 12-state filter needs a triple product per sample; the LSTM-corrected one needs besides the matrix-vector products of
its network (90 to 200, two layers of 400 to 800, 200 to 72). Printed, never asserted.
"""

from __future__ import annotations

import numpy as np
import pytest

from tests.ahrs_simulation import simulate
from tests.benchmarks.arithmetic import matrix_vector_products, triple_products

SHAPES = ((90, 200), (400, 800), (400, 800), (200, 72))
ESTIMATORS = ("ahrs-kf", "ahrs-eskf", "ahrs-lstm", "vqf", "madgwick", "mahony", "ahrs-ekf")


@pytest.fixture(scope="module")
def log():
    return simulate(0, 120.0).log


@pytest.mark.benchmark(group="attitude filters, 50 Hz")
@pytest.mark.parametrize("name", ESTIMATORS)
def test_bench_ahrs(benchmark, log, name):
    from testbed.data.registry import make_estimator

    if name in ("vqf", "madgwick", "mahony", "ahrs-ekf"):
        pytest.importorskip("vqf" if name == "vqf" else "ahrs")
    # random weights cost what trained ones do
    estimator = make_estimator(name, **({"weights": "untrained"} if name == "ahrs-lstm" else {}))
    benchmark.extra_info["samples"] = len(log.imu.t)
    benchmark.pedantic(estimator.run, (log,), rounds=5, warmup_rounds=1)


@pytest.mark.benchmark(group="attitude filters, 50 Hz")
def test_bench_ahrs_triple_product(benchmark, log):
    benchmark.extra_info["samples"] = len(log.imu.t)
    benchmark(triple_products, np.eye(12) + 1e-6, np.eye(12), len(log.imu.t))


@pytest.mark.benchmark(group="attitude filters, 50 Hz")
def test_bench_ahrs_matrix_vector(benchmark, log):
    rng = np.random.default_rng(0)
    matrices = tuple(rng.standard_normal(shape).astype(np.float32) for shape in SHAPES)
    vectors = tuple(np.ones(shape[0], np.float32) for shape in SHAPES)
    benchmark.extra_info["samples"] = len(log.imu.t)
    benchmark.pedantic(matrix_vector_products, (matrices, vectors, len(log.imu.t)), rounds=5, warmup_rounds=1)
