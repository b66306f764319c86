"""Hot paths of the networks: one training epoch and one training beside scipy, closed loop, `kfann` over a whole log."""

from __future__ import annotations

import numpy as np
import pytest

from estimators.learning.networks import mlp_kernels
from estimators.learning.networks.levenberg_marquardt import Training, train
from estimators.learning.networks.mlp import new_mlp
from estimators.learning.networks.narx import train_narx
from testbed.features import lag_curve, rank_mrmr
from tests.benchmarks.arithmetic import normal_equations, triple_products
from tests.synthetic import sensor_log, weaving_flight

pytest.importorskip("pytest_benchmark")
EPOCHS = 30


@pytest.fixture(scope="module")
def rows():
    """800 rows of 8 inputs: the fixes before the outage of the KFANN scenario, inputs NN3 (111 weights)."""
    rng = np.random.default_rng(0)
    x = np.cumsum(rng.standard_normal((800, 8)), axis=0)
    return x, np.sin(x[:, 0] / 10.0) + x[:, 1] * x[:, 2] / 100.0 + 0.1 * rng.standard_normal(800)


@pytest.mark.benchmark(group="network: 30 epochs of Levenberg-Marquardt, 800 x 8, 11 neurons")
def test_train_here(benchmark, rows):
    benchmark(lambda: train(*rows, 11, 0, Training(epochs=EPOCHS, validation_share=0.0, tolerance=0.0)))


@pytest.mark.benchmark(group="network: 30 epochs of Levenberg-Marquardt, 800 x 8, 11 neurons")
def test_train_scipy(benchmark, rows):
    from numba import njit
    from scipy.optimize import least_squares

    @njit
    def jacobian(weights, x):
        out = np.empty((x.shape[0], weights.shape[0]))
        for k in range(x.shape[0]):
            mlp_kernels.gradient_row(weights, 11, x[k], out[k])
        return out

    net = new_mlp(*rows, 11, 0)
    x, y = net.normalise_inputs(rows[0]), net.normalise_outputs(rows[1])
    jacobian(net.weights, x)

    def fit():
        return least_squares(
            lambda w: mlp_kernels.evaluate_all(w, 11, x) - y,
            net.weights,
            lambda w: jacobian(w, x),
            method="lm",
            max_nfev=EPOCHS,
        )

    benchmark(fit)


@pytest.mark.benchmark(group="network: 30 epochs of Levenberg-Marquardt, 800 x 8, 11 neurons")
def test_train_normal_equations(benchmark):
    """What every epoch needs at least: J'J of 800 rows and 111 weights, and one factorization."""
    benchmark(normal_equations, np.random.default_rng(0).standard_normal((800, 111)), EPOCHS)


@pytest.mark.benchmark(group="network: evaluation")
def test_evaluate_800_rows(benchmark, rows):
    net = new_mlp(*rows, 11, 0)
    benchmark(net.predict, rows[0])


@pytest.mark.benchmark(group="network: evaluation")
def test_closed_loop_300_steps(benchmark, rows):
    narx, _ = train_narx([rows], output_lags=3, input_lags=2, neurons=11, how=Training(epochs=5))
    benchmark(narx.closed_loop, rows[0][:302], rows[1][:3])


@pytest.mark.benchmark(group="input selection")
def test_rank_10_candidates_4000_samples(benchmark):
    rng = np.random.default_rng(0)
    x = rng.standard_normal((4000, 10))
    benchmark(rank_mrmr, x, x[:, 0] + x[:, 1] ** 2)


@pytest.mark.benchmark(group="input selection")
def test_lag_curve_2000_samples(benchmark):
    rng = np.random.default_rng(0)
    benchmark(lag_curve, rng.standard_normal(2100), rng.standard_normal(2100))


@pytest.mark.benchmark(group="150 s log at 100 Hz")
@pytest.mark.parametrize("method", ["lkf9", "ann", "kfann"])
def test_whole_log(benchmark, method):
    from estimators.learning.kfann import Ann, Kfann
    from estimators.methods.lkf9 import Lkf9

    log = sensor_log(weaving_flight(), 1, ((80.0, 110.0),), gyro_bias=1e-3)
    benchmark.extra_info["samples"] = len(log.imu.t)
    benchmark({"lkf9": Lkf9(), "ann": Ann(), "kfann": Kfann()}[method].run, log)


@pytest.mark.benchmark(group="150 s log at 100 Hz")
def test_whole_log_triple_product(benchmark):
    benchmark.extra_info["samples"] = 15_000
    benchmark(triple_products, np.eye(9) + 1e-6, np.eye(9), 15_000)
